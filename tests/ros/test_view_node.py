"""The node of the live view as a real process."""

import importlib.util
import os
import signal
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from ngo_msgs.msg import Trajectory
from sensor_msgs.msg import Image, LaserScan
from visualization_msgs.msg import MarkerArray

from tests.unit.ngo_estimator.view.free_ports import free_ports

from .processes import LATCHED, TIMEOUT_S, NodeProcess, Probe

pytestmark = pytest.mark.processes


def test_without_rerun_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    absent = "raise ModuleNotFoundError(\"No module named 'rerun'\", name='rerun')\n"
    (tmp_path / "rerun.py").write_text(absent)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    with NodeProcess("ngo_estimator", "view_node") as node:
        assert node.wait() == 2
        (line,) = node.lines
    assert "requirements/view.txt" in line


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun is an extra: requirements/view.txt")
def test_it_shows_a_graph() -> None:
    web, data = free_ports(2)
    topics = {
        "map": (OccupancyGrid, LATCHED),
        "image": (Image, 10),
        "scan": (LaserScan, 10),
        "odom": (Odometry, 10),
        "ground_truth": (Odometry, 10),
        "ngo/trajectory": (Trajectory, 10),
        "ngo/pose": (PoseWithCovarianceStamped, 10),
        "ngo/loops": (MarkerArray, 10),
    }
    settings = {"web_port": web, "data_port": data, "open_browser": False, "rate_hz": 50.0}
    with Probe() as probe, NodeProcess("ngo_estimator", "view_node", settings) as node:
        publishers = {name: probe.node.create_publisher(kind, name, qos) for name, (kind, qos) in topics.items()}
        node.wait_for_log("ready: /view_node, open http://127.0.0.1:")
        with urllib.request.urlopen(f"http://127.0.0.1:{web}/", timeout=TIMEOUT_S) as page:
            assert b"Rerun" in page.read()
        probe.spin_until(
            lambda: all(publisher.get_subscription_count() == 1 for publisher in publishers.values()), "the view"
        )
        trajectory = Trajectory(stamps_ns=[1, 2], x=[0.0, 1.0], y=[0.0, 0.0], yaw=[0.0, 0.0], moved=[0.0, 0.0])
        publishers["ngo/trajectory"].publish(trajectory)
        grid = OccupancyGrid(data=np.zeros(6, np.int8))
        grid.info.width, grid.info.height, grid.info.resolution = 3, 2, 0.05
        publishers["map"].publish(grid)
        publishers["image"].publish(Image(encoding="yuv"))  # the last one, and one that cannot be shown
        node.wait_for_log("picture is not shown: .*yuv")
        node.send(signal.SIGINT)
        assert node.wait() == 0
        assert "Traceback" not in node.log and node.log.count("is not shown") == 1, node.log
