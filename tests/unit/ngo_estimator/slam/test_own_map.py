"""A robot that was carried while it saw nothing is found again in the map that it made, and nowhere else."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_covariance import position_std
from ngo_estimator.geometry.se2 import compose
from ngo_estimator.loops.place_evidence import PlaceEvidence
from ngo_estimator.loops.scan_settings import ScanGraphConfig, ScanLoopConfig
from ngo_estimator.nodes.trajectory_report import TrajectoryReport
from ngo_estimator.slam.own_map import OwnMap
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate
from tests.unit.ngo_estimator.lidar_steps import HOUSE, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.loops.buildings import HALLWAY, ROUND, between, outline, scan_at, way
from tests.unit.ngo_estimator.ray_casting import fan
from tests.unit.ngo_estimator.ray_casting import scan_at as cast_scan

FIRST = way(*ROUND, ROUND[0], (4.0, 1.0))
BACK = way((1.0, 6.0), ROUND[0], *ROUND[1:])  # another corner, from which it drives on
OTHER = np.concatenate((outline((0, 0), (7, 0), (7, 11), (0, 11)), outline((2, 3), (5, 3), (5, 8), (3.5, 8), (2, 6))))
ALIKE = way((1.0, 6.0), (1.0, 1.0), (6.0, 1.0), (6.0, 10.0))  # the second corridor fits another one of the hallway
COVARIANCE = np.diag((0.01, 0.01, 0.004)) ** 2
NOTHING = np.zeros(0, np.float32)


def steps(walls: np.ndarray, poses: np.ndarray, hallways: int = 1) -> tuple[RelativeStep, ...]:
    """The way round each hallway, then, in a segment of its own, the one among ``walls``; odometry goes straight on."""
    random, round_all = np.random.default_rng(1), np.concatenate([FIRST + (40.0 * x, 0, 0) for x in range(hallways)])
    true, begin = np.concatenate((round_all, poses)), len(round_all)
    seen = [scan_at(HALLWAY, FIRST[k % len(FIRST)], random) for k in range(begin)]
    seen += [scan_at(walls, pose, random) for pose in poses]
    seen = [replace(scan, stamp_ns=k * 10**9) for k, scan in enumerate(seen)]
    relative = between(true[:-1], true[1:]) + random.normal(0.0, (0.003, 0.003, 0.001), (len(true) - 1, 3))
    relative[begin - 1] = 0.0
    odometry = [true[0]]
    for step in relative:
        odometry.append(compose(odometry[-1], step))
    found = []
    for k, step in enumerate(relative, 1):
        key = KeyScanStep(seen[k], seen[k - 1].stamp_ns, step, COVARIANCE)
        stamps, odom = (seen[k].stamp_ns, seen[k - 1].stamp_ns), odometry[k]
        origin = seen[0] if k == 1 else None
        found.append(
            RelativeStep(
                *stamps, step, COVARIANCE, 0, odom, NOTHING, NOTHING, key=key, origin_scan=origin,
                segment=k == begin,
            )
        )  # fmt: skip
    return tuple(found)


@cache
def carried_back() -> tuple[RelativeStep, ...]:
    return steps(HALLWAY, BACK)


def driven(some: tuple[RelativeStep, ...], core: ScanTrajectory) -> list[TrajectoryUpdate]:
    return [core.update(step) for step in some]


def test_a_robot_that_was_carried_is_lost_until_it_is_found_in_its_own_map() -> None:
    core = ScanTrajectory()
    updates = driven(carried_back(), core)
    begin = len(FIRST) - 1
    assert all(update.lost_since_ns is None for update in updates[:begin])
    lost = [update for update in updates[begin:] if update.lost_since_ns is not None]
    report = TrajectoryReport()
    report.updated(lost[-1])
    assert report.problems() == [f"not localised in the map since {len(FIRST)}.000000000"]
    assert 10 < len(lost) < 50 and updates[-1].lost_since_ns is None
    for update in lost:
        assert update.lost_since_ns == len(FIRST) * 10**9
        assert position_std(update.covariance) > 50.0
    np.testing.assert_allclose(lost[0].pose_xyyaw, updates[begin - 1].pose_xyyaw)
    core.finish()
    trajectory = core.trajectory()
    assert trajectory is not None
    off = trajectory.poses_xyyaw - between(FIRST[:1], np.concatenate((FIRST, BACK)))
    assert np.abs(off[:, :2]).max() < 0.1
    assert position_std(updates[-1].covariance) < 0.1


def test_a_robot_that_drives_the_other_way_is_found() -> None:
    poses = way((1.0, 2.0), (1.0, 7.0), (4.0, 7.0))
    core = ScanTrajectory()
    newest = driven(steps(HALLWAY, poses), core)[-1]
    assert newest.lost_since_ns is None
    off = between(between(FIRST[:1], poses[-1:]), newest.pose_xyyaw[None])[0]
    assert np.hypot(off[0], off[1]) < 0.1


def joining_loops(core: ScanTrajectory) -> int:
    segment = core.back_end.used_loops.pairs >= len(FIRST)
    return int((segment[:, 0] != segment[:, 1]).sum())


def test_a_robot_in_another_building_is_not_found() -> None:
    core = ScanTrajectory()
    updates = driven(steps(OTHER, ALIKE), core)
    assert all(update.lost_since_ns is not None for update in updates[len(FIRST) - 1 :])
    assert joining_loops(core) == 0


def test_a_robot_in_one_of_two_parts_that_are_alike_is_not_found() -> None:
    updates = driven(steps(HALLWAY, BACK, hallways=2), ScanTrajectory())
    assert all(update.lost_since_ns is not None for update in updates[2 * len(FIRST) - 1 :])


def test_a_claim_that_later_scans_contradict_is_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(OwnMap, "_evidence", lambda *_: PlaceEvidence(99))
    core = ScanTrajectory()
    updates = driven(steps(OTHER, ALIKE), core)
    lost = np.array([update.lost_since_ns is not None for update in updates[len(FIRST) - 1 :]])
    assert lost[0] and not lost.all(), "without evidence it is found where it is not"
    assert lost[-1] and joining_loops(core) == 0
    assert position_std(updates[-1].covariance) > 50.0


def test_a_key_scan_that_begins_a_segment_leaves_map_from_odom_as_it_was() -> None:
    core = ScanTrajectory()
    updates = driven(carried_back()[: len(FIRST) + 3], core)
    before = updates[len(FIRST) - 2].map_from_odom_xyyaw
    for update in updates[len(FIRST) - 1 :]:
        carried = between(before[None], update.map_from_odom_xyyaw[None])[0]
        assert np.abs(carried).max() < 1e-9


def test_a_state_that_was_saved_while_it_was_lost_goes_on_to_the_last_bit() -> None:
    all_steps, core = carried_back(), ScanTrajectory()
    driven(all_steps[: len(FIRST) + 9], core)
    other = ScanTrajectory().restored(core.state())
    for step in all_steps[len(FIRST) + 9 : len(FIRST) + 40]:
        mine, its = core.update(step), other.update(step)
        np.testing.assert_array_equal(mine.pose_xyyaw, its.pose_xyyaw)
        assert mine.lost_since_ns == its.lost_since_ns


@pytest.mark.parametrize("wrong", [None, (0.6, 0.3, 0.2), (0.0, 0.0, 0.35)], ids=["right", "moved", "turned"])
def test_a_step_that_was_sure_and_wrong_is_noticed_by_its_scans_and_the_robot_found_again(
    wrong: tuple[float, float, float] | None,
) -> None:
    """In the second round, where the map is known, a step says something else than was driven."""
    true, random = loop_way(2.4), np.random.default_rng(0)
    odometry, slip = drifted(true, (0.01, 0.005, 0.004)), int(len(true) * 1.6 / 2.4)
    if wrong is not None:
        odometry[slip:] = compose(
            compose(odometry[slip], np.array(wrong)), se2.between(odometry[slip], odometry[slip:])
        )

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return cast_scan(HOUSE, true[k], stamp_ns, fan(181, 270.0), noise=(0.01, random))

    core = ScanTrajectory(ScanGraphConfig(loops=ScanLoopConfig(every=4)))
    updates = [core.update(step) for step in lidar_steps(odometry, scan)]
    lost = [k for k, update in enumerate(updates, 1) if update.lost_since_ns is not None]
    if wrong is None:
        assert not lost
    else:
        assert slip < lost[0] < slip + 60 and lost[-1] < len(true) - 30
        since = updates[lost[0] - 1].lost_since_ns
        assert since is not None
        assert slip - 20 < list(core.log.stamps_ns.values).index(since) <= lost[0]
        assert updates[lost[0]].covariance[0, 0] > 1e3
    last = core.newest().pose_xyyaw
    assert np.hypot(*(last - true[-1])[:2]) < 0.3 and 3.0 * position_std(core.newest().covariance) < 1.0
