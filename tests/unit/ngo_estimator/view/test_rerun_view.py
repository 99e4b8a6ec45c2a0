"""The canvas that rerun serves; skipped where this extra is not installed."""

import urllib.request

import numpy as np
import pytest

pytest.importorskip("rerun", reason="rerun is an extra: requirements/view.txt")

from ngo_estimator.view.rerun_view import RerunView, ViewError
from ngo_estimator.view.shapes import Window
from tests.unit.ngo_estimator.view.free_ports import free_ports


def test_everything_is_drawn_and_the_page_is_served(capfd: pytest.CaptureFixture[str]) -> None:
    web, data, other = free_ports(3)
    view = RerunView(web, data, 64, open_browser=False)
    assert view.url.startswith(f"http://127.0.0.1:{web}/") and str(data) in view.url
    with urllib.request.urlopen(f"http://127.0.0.1:{web}/", timeout=60) as page:
        assert b"Rerun" in page.read()
    view.at(1.5)
    view.look_at(Window(1.0, 2.0, 5.0))
    for name in ("truth", "odometry", "corrected"):
        view.path(name, np.zeros((4, 2)))
    view.loops(np.zeros((2, 2, 2)), np.array(((0.1, 0.5, 0.9, 0.0), (0.9, 0.1, 0.1, 1.0))))
    view.loops(np.zeros((0, 2, 2)), np.zeros((0, 4)))
    view.frontiers(np.zeros((3, 2)), np.array(((0.1, 0.3, 1.0), (0.1, 0.8, 0.2), (0.9, 0.1, 0.1))))
    view.frontiers(np.zeros((0, 2)), np.zeros((0, 3)))
    view.plan(np.zeros((5, 2)))
    view.plan(np.zeros((0, 2)))
    view.robot(np.array([1.0, 2.0, 0.5]), np.zeros((8, 2)), 0.3)
    view.scan(np.zeros((7, 2)))
    view.grid(np.full((3, 5), -1, np.int8), 0.05, np.array([-1.0, -2.0, 0.1]))
    view.picture(np.zeros((4, 6, 3), np.uint8))
    view.picture(np.zeros((4, 6, 1), np.uint8))
    view.error("odometry", 0.5)
    view.text("**3 frames**")
    view.close()
    with pytest.raises(ViewError, match=f"port {data} is in use"):
        RerunView(other, data, 64, open_browser=False)
    assert "ERROR" not in capfd.readouterr().err
