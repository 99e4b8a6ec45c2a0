"""Robots that meet have one map, one in a building that looks alike has its own, and no silence or restart costs it."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ngo_estimator.data.relative_step import DuplicateStep, LateStep, RejectedStep, RelativeStep
from ngo_estimator.geometry.planar_covariance import position_std
from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.graph.robust import Robust
from ngo_estimator.slam.fleet import Fleet, FleetUpdate
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.loops.buildings import between
from tests.unit.ngo_estimator.slam.test_own_map import ALIKE, BACK, FIRST, OTHER, carried_back, steps

COUNT = len(FIRST)


def own_odometry(some: tuple[RelativeStep, ...]) -> tuple[RelativeStep, ...]:
    """Those of the second way, with an odometry of its own that begins there."""
    first, *others = some[COUNT - 1 :]
    assert first.key is not None
    begin = replace(others[0], origin_scan=first.key.scan)
    return tuple(replace(step, origin_stamp_ns=first.stamp_ns) for step in (begin, *others[1:]))


@cache
def robots() -> dict[str, tuple[RelativeStep, ...]]:
    """Two in the hallway from different corners, and one in a building whose corridor fits one of the hallway."""
    some = carried_back()
    return {"red": some[: COUNT - 1], "blue": own_odometry(some), "green": own_odometry(steps(OTHER, ALIKE))}


def drive(fleet: Fleet, robot: str, some: Iterable[RelativeStep]) -> list[FleetUpdate]:
    found = []
    for step in some:
        found.append(fleet.update(robot, step))
        fleet.correct()
    return found


def off_m(fleet: Fleet, robot: str, begin: np.ndarray, truth: np.ndarray) -> float:
    """How far a robot's poses are from the true ones, as its map has them, which begins at a pose."""
    whole = fleet.trajectory(robot)
    assert whole is not None and (np.diff(whole.stamps_ns) > 0).all()
    return float(np.abs(whole.poses_xyyaw - between(begin[None], truth))[:, :2].max())


def test_robots_that_meet_share_a_map_and_one_elsewhere_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet = Fleet(ScanTrajectory(), list(robots()))
    told: dict[str, list[FleetUpdate]] = {robot: [] for robot in robots()}
    for k in range(60):
        for robot, some in robots().items():
            told[robot] += drive(fleet, robot, some[k : k + 1])
    assert all(update.map_of is None for update in told["red"])
    assert all(update.map_of == "green" for update in told["green"])
    own = [update.map_of == "blue" for update in told["blue"]]
    met = own.index(False)
    assert 5 < met < 45 and not any(own[met:])
    np.testing.assert_allclose(told["blue"][0].update.pose_xyyaw[:2], between(BACK[:1], BACK[1:2])[0, :2], atol=0.02)
    assert fleet.core.back_end.fault == ""
    fleet.finish()
    assert off_m(fleet, "red", FIRST[0], FIRST[:61]) < 0.1
    assert off_m(fleet, "blue", FIRST[0], BACK[:61]) < 0.1
    assert off_m(fleet, "green", ALIKE[0], ALIKE[: len(told["green"]) + 1]) < 0.1
    graph = fleet.planar_graph()
    assert graph is not None
    of_red = graph.ids[fleet.core.back_end.graph.stream_of(graph.ids) == 0][:61]
    np.testing.assert_allclose(graph.poses[of_red], between(FIRST[:1], FIRST[:61]), atol=0.1)
    for robot in robots():
        pose, covariance = fleet.pose(robot)
        assert 1e-3 < position_std(covariance) < 0.4
        np.testing.assert_allclose(told[robot][-1].update.pose_xyyaw, pose, atol=0.05)
    # A loop that is taken out leaves what the others join, though nothing is optimised.
    monkeypatch.setattr(Robust, "correct", lambda *_: 1 / 0)
    whole = fleet.core.trajectory()
    assert whole is not None and fleet.core.remove_loops(*whole.loops[0].tolist()) == 1
    assert "division by zero" in fleet.core.fault
    for step in robots()["red"][60:62]:
        assert fleet.update("red", step, optimize=False).map_of is None
    assert [fleet.map_of(robot) for robot in robots()] == [None, None, "green"]


def test_a_robot_that_starts_anew_is_found_again_and_lost_steps_cost_nothing() -> None:
    fleet, anew = Fleet(ScanTrajectory(), ["red"]), robots()["blue"][:60]
    drive(fleet, "red", robots()["red"])
    before = fleet.trajectory("red")
    assert before is not None
    lost = drive(fleet, "red", anew[:12])
    assert len(fleet.core.back_end._own_maps) == 1  # none of the stream that ended
    assert lost[0].begins and not any(update.begins for update in lost[1:])
    assert all(update.map_of == "red" and not update.update.restarted for update in lost)
    whole = fleet.core.trajectory()
    assert whole is not None
    np.testing.assert_array_equal(whole.poses_xyyaw[:COUNT], before.poses_xyyaw)
    found = drive(fleet, "red", anew[17:])  # a burst behind a silence, of which five were lost
    assert found[0].update.gap and found[-1].map_of is None
    fleet.finish()
    truth = np.concatenate((FIRST, np.delete(BACK[:61], range(13, 18), axis=0)))
    assert off_m(fleet, "red", FIRST[0], truth) < 0.1


@pytest.mark.parametrize("blue_first", [False, True])
def test_the_map_of_all_begins_anew_with_the_first_robot_where_it_had_hardly_begun(blue_first: bool) -> None:
    fleet, red = Fleet(ScanTrajectory(), ["red", "blue"]), robots()["red"]
    if blue_first:
        drive(fleet, "blue", robots()["blue"][:3])
    drive(fleet, "red", red[:2])
    for k in (2, 4):  # twice
        begin = replace(red[k], origin_scan=red[k - 1].key.scan)  # type: ignore[union-attr]
        again = [replace(step, origin_stamp_ns=step.from_stamp_ns + k) for step in (begin, red[k + 1])]
        again[1] = replace(again[1], origin_stamp_ns=again[0].origin_stamp_ns)
        told = drive(fleet, "red", again)
        assert [update.map_of for update in told] == [None, None] and told[0].begins
    np.testing.assert_allclose(told[0].update.pose_xyyaw, red[4].relative_xyyaw, atol=0.02)
    whole = fleet.trajectory("red")
    assert whole is not None and len(whole.stamps_ns) == 3
    blue = drive(fleet, "blue", robots()["blue"][3:5] if blue_first else robots()["blue"][:3])
    assert blue[-1].map_of == "blue"
    assert fleet.core.newest().frames == (6 + 9 if blue_first else 3 + 4)


def test_one_robot_alone_is_a_trajectory() -> None:
    fleet, core = Fleet(ScanTrajectory(), ["red"]), ScanTrajectory()
    for told, step in zip(drive(fleet, "red", robots()["red"][:30]), robots()["red"], strict=False):
        expected = core.update(step)
        core.correct()
        for name in ("pose_xyyaw", "covariance", "map_from_odom_xyyaw"):
            np.testing.assert_allclose(getattr(told.update, name), getattr(expected, name), atol=1e-12)


def test_nothing_is_optimised_while_corrections_pause() -> None:
    fleet, red = Fleet(ScanTrajectory(), ["red", "blue"]), robots()["red"]
    for step in red[:-1]:
        assert not fleet.update("red", step, optimize=False).update.optimized
    loops = len(fleet.core.back_end.used_loops)
    assert loops > 0 and not len(fleet.core.back_end.closed)
    fleet.update("blue", robots()["blue"][0], optimize=False)
    fleet.update("red", replace(red[-1], key=None), optimize=False)
    fleet.update("red", own_odometry(carried_back())[0], optimize=False)  # it begins anew
    fleet.correct()
    assert not len(fleet.core.back_end.closed)


def test_steps_wait_for_a_key_scan_and_are_answered_by_odometry() -> None:
    fleet = Fleet(ScanTrajectory(), ["red", "blue"])
    drive(fleet, "red", robots()["red"][:3])
    drive(fleet, "blue", robots()["blue"][:3])
    frames = fleet.core.newest().frames
    fourth, fifth = (replace(step, key=None) for step in robots()["red"][3:5])
    at = fleet.pose("red")[0]
    for step in (fourth, fifth):
        told = fleet.update("red", step)
        at = compose(at, step.relative_xyyaw)
        np.testing.assert_allclose(told.update.pose_xyyaw, at, atol=1e-9)
    assert told.update.frames == frames
    whole = fleet.update("red", robots()["red"][5])
    assert whole.update.frames == frames + 3
    np.testing.assert_allclose(whole.update.pose_xyyaw, compose(at, robots()["red"][5].relative_xyyaw), atol=1e-6)


def test_a_robot_that_is_carried_is_in_a_map_of_its_own() -> None:
    """The map of all stays with the others, whoever is carried away from it."""
    fleet = Fleet(ScanTrajectory(), ["red", "blue"])
    red = [*robots()["red"][:3], replace(robots()["red"][3], segment=True), *robots()["red"][4:6]]
    told = drive(fleet, "red", red)
    assert [update.map_of for update in told] == [None] * 3 + ["red"] * 3
    np.testing.assert_allclose(told[3].update.pose_xyyaw, np.zeros(3), atol=1e-9)
    np.testing.assert_allclose(told[4].update.pose_xyyaw, red[4].relative_xyyaw, atol=0.02)


def test_a_robot_that_went_impossibly_far_begins_anew_and_costs_the_others_nothing() -> None:
    fleet = Fleet(ScanTrajectory(), ["red", "blue"])
    for robot in ("red", "blue"):
        drive(fleet, robot, robots()[robot][:3])
    away = [replace(step, odom_xyyaw=step.odom_xyyaw + (1e8, 0.0, 0.0)) for step in robots()["red"][4:7]]
    told = drive(fleet, "red", [replace(away[0], key=None), *away[1:]])
    assert [update.begins for update in told] == [False, True, False]
    assert told[-1].map_of is None and fleet.trajectory("red") is not None  # the map had hardly begun
    assert fleet.core.newest().frames == 4 + 4 + 2


def test_steps_that_cannot_be_used_leave_all_as_it_is() -> None:
    fleet = Fleet(ScanTrajectory(), ["red", "blue"])
    red, blue = robots()["red"], robots()["blue"]
    drive(fleet, "red", red[:3])
    with pytest.raises(DuplicateStep):
        fleet.update("red", red[2])
    with pytest.raises(LateStep, match="at 3000000000 ns already"):
        fleet.update("red", replace(red[2], stamp_ns=red[2].stamp_ns - 1, key=None))
    with pytest.raises(RejectedStep, match="has no key scan"):
        fleet.update("blue", replace(blue[0], key=None, origin_scan=None))
    assert fleet.trajectory("blue") is None and fleet.core.newest().frames == 4
    assert drive(fleet, "blue", blue[:1])[0].map_of == "blue"
    with pytest.raises(ValueError, match="different names"):
        Fleet(ScanTrajectory(), ["red", "red"])
