"""Sessions of one place become one map; one of another place is left out; nothing is lost."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.nodes import join_sessions
from ngo_estimator.nodes.join_sessions import Arguments
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.session import Session
from ngo_estimator.slam.session_union import replayed_steps, united
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection
from ngo_estimator.slam.trajectory_update import Trajectory
from tests.golden.drives import WEIGHTS
from tests.unit.ngo_estimator.loops.buildings import between, way
from tests.unit.ngo_estimator.slam.test_own_map import BACK, FIRST, OTHER, carried_back, steps

COUNT = len(FIRST)
ABROAD = way((1.0, 1.0), (6.0, 1.0), (6.0, 10.0), (1.0, 10.0), (1.0, 2.0))


@cache
def session(which: str) -> ScanTrajectory:
    """The robot in its hallway, in the same from another corner, and elsewhere: each with an odometry of its own."""
    if which == "first":
        return driven(carried_back()[: COUNT - 1])
    found = carried_back() if which == "back" else steps(OTHER, ABROAD)
    first, *others = found[COUNT - 1 :]
    assert first.key is not None
    begin = replace(others[0], origin_scan=first.key.scan)
    return driven([replace(step, origin_stamp_ns=first.stamp_ns) for step in (begin, *others[1:])])


def driven(some: tuple[RelativeStep, ...] | list[RelativeStep]) -> ScanTrajectory:
    core = ScanTrajectory.load(WEIGHTS / "scan", "scan")
    for step in some:
        core.update(step)
    core.finish()
    return core


def whole(core: ScanTrajectory) -> Trajectory:
    trajectory = core.trajectory()
    assert trajectory is not None
    return trajectory


def test_a_session_is_driven_again_as_it_was() -> None:
    first, *others = replayed_steps(session("first"))
    assert first.key is not None and not first.segment
    again = driven([replace(others[0], origin_scan=first.key.scan), *others[1:]])
    np.testing.assert_allclose(whole(again).poses_xyyaw, whole(session("first")).poses_xyyaw, atol=1e-6)


def test_sessions_that_meet_become_one_map_and_another_place_is_left_out() -> None:
    before = whole(session("first")).poses_xyyaw.copy()
    union = united([session("first"), session("abroad"), session("back")])
    assert list(union.left_out) == [1] and list(union.later_ns) == [0, 0, 0]
    off = whole(union.trajectory).poses_xyyaw - between(FIRST[:1], np.concatenate((FIRST, BACK)))
    assert np.abs(off[:, :2]).max() < 0.1
    np.testing.assert_array_equal(whole(session("first")).poses_xyyaw, before)
    # The other way round the stamps have to follow.
    turned = united([session("back"), session("first")])
    assert not turned.left_out and turned.later_ns[1] > 0
    assert len(whole(turned.trajectory).poses_xyyaw) == len(FIRST) + len(BACK)
    assert (np.diff(whole(turned.trajectory).stamps_ns) > 0).all()


def test_too_few_or_empty_sessions_are_refused() -> None:
    for wrong in ([session("first")], [session("first"), ScanTrajectory()]):
        with pytest.raises(ValueError, match="expected two or more with frames"):
            united(wrong)


def test_the_command_writes_a_state_that_can_be_loaded_and_the_same_bytes_again(tmp_path: Path) -> None:
    blank = Session("scan", driven(()), MapOrigin.of_first_pose(np.zeros(3)), SmoothedCorrection(0.0))
    folders = []
    for name in ("first", "abroad", "back"):
        saved = replace(blank, core=session(name))
        saved.write(tmp_path / name, saved.state())
        folders.append(tmp_path / name)
    console = Console(record=True, width=200)
    out = tmp_path / "all"
    assert join_sessions.run(Arguments(tuple(folders), out, WEIGHTS / "scan"), console) == [tmp_path / "abroad"]
    assert "abroad is left out" in console.export_text()
    assert blank.loaded(out).core.newest().frames == len(FIRST) + len(BACK)
    again = tmp_path / "again"
    join_sessions.run(Arguments(tuple(folders), again, WEIGHTS / "scan"), console)
    written = [{path.name: path.read_bytes() for path in folder.iterdir()} for folder in (out, again)]
    assert written[0] == written[1]
    with pytest.raises(ValueError, match="is there already"):
        join_sessions.run(Arguments(tuple(folders), out), console)
    with pytest.raises(ValueError, match="nothing was written"):
        join_sessions.run(Arguments(tuple(folders[:2]), tmp_path / "none", WEIGHTS / "scan"), console)
