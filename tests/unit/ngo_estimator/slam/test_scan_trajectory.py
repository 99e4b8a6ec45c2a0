"""The online trajectory of a lidar: loops, gaps, restarts, hostile steps, and what memory it keeps."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ngo_estimator.data.relative_step import DuplicateStep, LateStep, RejectedStep, RelativeStep
from ngo_estimator.geometry.key_scan import KeyScan, no_scan
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.graph.normal_equations import NormalEquations
from ngo_estimator.graph.robust import Robust
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.lidar_steps import HOUSE, STEP_COVARIANCE, STEP_NS, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import HALLWAY, fan, scan_at

ANGLES = fan(181, 270.0)
DRIFT = (0.01, 0.005, 0.004)


@lru_cache
def loop_drive() -> tuple[np.ndarray, np.ndarray, tuple[RelativeStep, ...]]:
    """Truth, odometry and steps of a robot that goes round a block nearly one and a half times."""
    true = loop_way(1.4)
    odometry, generator = drifted(true, DRIFT), np.random.default_rng(0)

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return scan_at(HOUSE, true[k], stamp_ns, ANGLES, noise=(0.01, generator))

    return true, odometry, tuple(lidar_steps(odometry, scan))


def straight(count: int, scan: Callable[[int, int], KeyScan] | None = None, **more: Any) -> list[RelativeStep]:
    poses = np.zeros((count, 3))
    poses[:, 0] = 0.1 * np.arange(count)
    return list(lidar_steps(poses, scan or (lambda _, stamp_ns: no_scan(stamp_ns)), **more))


def errors(trajectory: ScanTrajectory, true: np.ndarray) -> np.ndarray:
    whole = trajectory.trajectory()
    assert whole is not None
    apart: np.ndarray = np.linalg.norm((whole.poses_xyyaw - true[: len(whole.poses_xyyaw)])[:, :2], axis=1)
    return apart


def state(trajectory: ScanTrajectory) -> list[bytes]:
    whole = trajectory.trajectory()
    return [] if whole is None else [np.ascontiguousarray(value).tobytes() for value in vars(whole).values()]


def test_loops_take_the_drift_out_and_the_deviation_shrinks_there() -> None:
    true, odometry, steps = loop_drive()
    trajectory, deviations, optimized = ScanTrajectory(), [], []
    for step in steps:
        update = trajectory.update(step)
        assert update.fault == ""
        deviations.append(math.sqrt(update.covariance[:2, :2].trace()))
        optimized.append(update.optimized)
    first = optimized.index(True)
    keyless = [after - before for before, after in zip(deviations[:first], deviations[1:first], strict=False)]
    assert min(keyless) > -0.05 and deviations[first - 1] > 3.0 * deviations[5]  # grows, but for keys
    assert min(deviations[first:]) < 0.5 * max(deviations[:first])
    trajectory.finish()
    assert errors(trajectory, true).max() < 0.25 * np.linalg.norm((odometry - true)[:, :2], axis=1).max()


def test_the_same_steps_give_the_same_bytes() -> None:
    _, _, steps = loop_drive()
    results = []
    for _ in range(2):
        trajectory = ScanTrajectory(iterations_per_step=1)
        for step in steps:
            trajectory.update(step)
        trajectory.finish()
        results.append(state(trajectory))
    assert results[0] == results[1]


def test_the_step_after_an_optimisation_tells_that_poses_moved() -> None:
    _, _, steps = loop_drive()
    trajectory, last, moved = ScanTrajectory(iterations_per_step=1), np.zeros((1, 3)), 0
    for step in steps:
        update = trajectory.update(step)
        now = trajectory.trajectory()
        assert now is not None
        off = float(np.abs(now.poses_xyyaw[: len(last)] - last).max())
        assert update.optimized == (off > 1e-12)
        moved += update.optimized
        if update.optimized:
            assert now.moved_m[: len(last)] == pytest.approx(
                np.linalg.norm((now.poses_xyyaw[: len(last)] - last)[:, :2], axis=1), abs=1e-6
            )
        last = now.poses_xyyaw
    assert moved > 3


def test_without_loops_the_path_is_the_odometry_and_the_covariance_grows() -> None:
    trajectory, last = ScanTrajectory(), 0.0
    for step in straight(100, key_m=0.39):
        update = trajectory.update(step)
        if step.key is not None:  # between keys it is that of single steps, which do not share their errors
            assert update.covariance[1, 1] > last
            last = update.covariance[1, 1]
        np.testing.assert_allclose(update.pose_xyyaw, step.odom_xyyaw, atol=1e-9)
        np.testing.assert_allclose(update.map_from_odom_xyyaw, 0.0, atol=1e-9)
    assert trajectory.finish() is None and trajectory.fault == ""


def test_a_steps_covariance_is_kept_along_its_own_axes() -> None:
    """A robot drives along y in a corridor that says nothing along: only the map's y becomes unsure."""
    poses = np.stack((np.zeros(50), 0.1 * np.arange(50), np.full(50, math.pi / 2.0)), axis=1)
    trajectory = ScanTrajectory()
    covariance = np.diag((0.1, 0.001, 0.0001)) ** 2
    for step in lidar_steps(poses, lambda _, stamp_ns: no_scan(stamp_ns), covariance=covariance):
        update = trajectory.update(step)
    assert update.pose_xyyaw == pytest.approx((4.9, 0.0, 0.0), abs=1e-9)  # the map begins along the first pose
    assert update.covariance[0, 0] > 50.0 * update.covariance[1, 1]


@pytest.mark.parametrize("lost", [range(20, 26), range(60, 61), range(3, 150)])
def test_lost_relative_poses_and_key_scans_are_bridged(lost: range) -> None:
    _, odometry, steps = loop_drive()
    trajectory, gaps = ScanTrajectory(), 0
    for k, step in enumerate(steps):
        if k not in lost:
            update = trajectory.update(step)
            gaps += update.gap
            assert update.fault == ""
    assert gaps == 1
    whole = trajectory.trajectory()
    assert whole is not None and len(whole.stamps_ns) == len(steps) + 1 - len(lost)
    kept = [0, *(k + 1 for k in range(len(steps)) if k not in lost)]
    np.testing.assert_allclose(whole.odometry_xyyaw, odometry[kept], atol=1e-6)


def test_a_key_scan_over_a_gap_has_the_covariance_of_the_whole_way() -> None:
    steps = straight(60)
    whole, gapped = ScanTrajectory(), ScanTrajectory()
    for k, step in enumerate(steps):
        all_there = whole.update(step)
        if not 10 <= k < 40:
            bridged = gapped.update(step)
    assert bridged.covariance[0, 0] > all_there.covariance[0, 0]
    assert bridged.pose_xyyaw == pytest.approx(all_there.pose_xyyaw, abs=1e-9)


def test_a_first_step_without_the_first_scan() -> None:
    """The node started later than its source: the map begins where it does, and loops are found to later keys."""
    true, _, steps = loop_drive()
    trajectory = ScanTrajectory()
    for step in steps[40:]:
        update = trajectory.update(step)
        assert update.fault == ""
    trajectory.finish()
    whole = trajectory.trajectory()
    assert whole is not None and (whole.loop_weights > 0.5).sum() > 3
    expected = np.array([between(true[40], pose) for pose in true[40:]])
    assert np.linalg.norm((whole.poses_xyyaw - expected)[:, :2], axis=1).max() < 0.4


def test_a_new_origin_begins_a_new_trajectory() -> None:
    first, second = straight(30), straight(20, begin_ns=10**12 + 10**11)
    trajectory = ScanTrajectory()
    for step in first:
        trajectory.update(step)
    update = trajectory.update(second[0])
    assert update.restarted and update.frames == 2
    for step in second[1:]:
        update = trajectory.update(step)
        assert not update.restarted
    fresh = ScanTrajectory()
    for step in second:
        fresh.update(step)
    assert state(trajectory) == state(fresh)


def test_a_robot_that_stands_adds_frames_alone() -> None:
    true, _, steps = loop_drive()
    trajectory = ScanTrajectory()
    for step in steps[:50]:
        trajectory.update(step)
    last = steps[49]
    for k in range(1, 10_001):
        update = trajectory.update(
            replace(
                last,
                stamp_ns=last.stamp_ns + k * STEP_NS,
                from_stamp_ns=last.stamp_ns + (k - 1) * STEP_NS,
                relative_xyyaw=np.zeros(3),
                key=None,
            )
        )
    assert update.frames == 10_051
    back_end = trajectory._back_end
    assert len(back_end.graph) == 1 + sum(step.key is not None for step in steps[:50]) == len(back_end._scans)
    assert errors(trajectory, np.concatenate((true[:51], np.tile(true[50], (10_000, 1))))).max() < 0.3


@pytest.mark.parametrize("place", ["corridor", "the same room"])
def test_identical_key_scans_do_not_draw_the_path_together(place: str) -> None:
    """600 steps straight on, 60 m: every key scan looks like all others."""
    pose = np.array([0.0, 0.1, 0.05])
    same = scan_at(HALLWAY if place == "corridor" else HOUSE, pose, 0, ANGLES)
    trajectory = ScanTrajectory()
    for step in straight(601, lambda _, stamp_ns: replace(same, stamp_ns=stamp_ns)):
        update = trajectory.update(step)
        assert update.fault == ""
    trajectory.finish()
    whole = trajectory.trajectory()
    assert whole is not None
    np.testing.assert_allclose(whole.poses_xyyaw, whole.odometry_xyyaw, atol=0.3)
    assert update.covariance[0, 0] > 100 * STEP_COVARIANCE[0, 0]


def rejected(trajectory: ScanTrajectory, step: RelativeStep, kind: type[RejectedStep] = RejectedStep) -> None:
    before = state(trajectory)
    with pytest.raises(kind) as told:
        trajectory.update(step)
    assert "\n" not in str(told.value)
    assert state(trajectory) == before


def test_steps_that_came_already_change_nothing() -> None:
    _, _, steps = loop_drive()
    trajectory, reference = ScanTrajectory(), ScanTrajectory()
    for k, step in enumerate(steps[:100]):
        trajectory.update(step)
        reference.update(step)
        rejected(trajectory, step, DuplicateStep)
        if k > 5:
            rejected(trajectory, steps[k - 4], LateStep)
    assert state(trajectory) == state(reference)


# More of them are in test_online_trajectory.py and, as messages, in nodes/test_messages.py.
BAD = {
    "covariance of nan": lambda s: replace(s, covariance=np.full((3, 3), np.nan)),
    "key scan of another time": lambda s: replace(s, key=replace(s.key, scan=no_scan(s.stamp_ns - 1))),
    "first scan of another time": lambda s: replace(s, origin_scan=no_scan(0)),
}


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_step_is_refused_and_changes_nothing(bad: str) -> None:
    _, _, steps = loop_drive()
    keys = [k for k, step in enumerate(steps) if step.key is not None]
    trajectory = ScanTrajectory()
    for step in steps[: keys[10]]:
        trajectory.update(step)
    rejected(trajectory, BAD[bad](steps[keys[10]]))
    with pytest.raises(RejectedStep):
        trajectory.begins_anew(BAD[bad](steps[keys[10]]))
    assert not trajectory.update(steps[keys[10]]).gap


HOSTILE = {
    "1e300": np.eye(3) * 1e300,
    "1e308 everywhere": np.full((3, 3), 1e308),
    "1e5": np.eye(3) * 1e5,
    "x and y": np.diag((1e4, 1e4, 1e-6)),
    "singular": np.ones((3, 3)) * 1e-4,
    "tiny": np.eye(3) * 1e-300,
    "not symmetric": np.array([[1e-4, 5.0, 0.0], [-5.0, 1e-4, 0.0], [0.0, 3.0, 1e-4]]),
    "not positive": np.array([[1e-4, 5.0, 0.0], [5.0, 1e-4, 0.0], [0.0, 0.0, 1e-4]]),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_covariance_costs_no_trajectory(name: str) -> None:
    true, odometry, steps = loop_drive()
    trajectory = ScanTrajectory()
    keys = [k for k, step in enumerate(steps) if step.key is not None]
    for k, step in enumerate(steps):
        hostile = HOSTILE[name] if k in (50, keys[20], keys[-20]) else step.covariance
        key = step.key and replace(step.key, covariance=hostile)
        update = trajectory.update(replace(step, covariance=hostile, key=key))
        assert update.fault == "" and not update.restarted
        assert np.isfinite(update.covariance).all() and np.linalg.eigvalsh(update.covariance)[0] > 0.0
    trajectory.finish()
    worst = np.linalg.norm((odometry - true)[:, :2], axis=1).max()
    assert errors(trajectory, true).max() < 1.05 * worst


@pytest.mark.parametrize("where", ["loops", "begin", "iterate", "covariance", "no numbers"])
def test_a_fault_of_numerics_costs_an_optimisation_alone(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    true, _, steps = loop_drive()
    trajectory, sound = ScanTrajectory(iterations_per_step=1), ScanTrajectory(iterations_per_step=1)
    until = next(k for k, step in enumerate(steps) if sound.update(step).optimized) - 3

    def fails(*_: Any, **__: Any) -> Any:
        raise RuntimeError("Factor is\nexactly singular") if where == "iterate" else np.linalg.LinAlgError("x\ny")

    faults = 0
    with monkeypatch.context() as broken:
        for k, step in enumerate(steps[:-40]):
            if k == until:
                if where == "loops":
                    broken.setattr(ScanLoopFinder, "find", fails)
                elif where == "begin":
                    broken.setattr(Robust, "correct", fails)
                elif where == "no numbers":
                    broken.setattr(NormalEquations, "covariance", lambda *_: np.full((3, 3), np.nan))
                else:
                    broken.setattr(NormalEquations, "solution" if where == "iterate" else "covariance", fails)
            before = trajectory.trajectory()
            update = trajectory.update(step)
            faults += bool(update.fault)
            assert "\n" not in update.fault
            after = trajectory.trajectory()
            assert after is not None and not update.restarted
            if k >= until and before is not None:
                same = after.poses_xyyaw[: len(before.poses_xyyaw)]
                np.testing.assert_allclose(same, before.poses_xyyaw, atol=1e-12)
                moved = compose(before.poses_xyyaw[-1], step.relative_xyyaw)
                np.testing.assert_allclose(update.pose_xyyaw, moved, atol=1e-9)
        assert faults > 0
        assert trajectory.finish() is None or where == "loops"
    for step in steps[-40:]:
        trajectory.update(step)
    trajectory.finish()
    assert trajectory.fault == "" and errors(trajectory, true).max() < 0.5


def test_pausing_leaves_the_path_and_loses_no_loop() -> None:
    true, _, steps = loop_drive()
    trajectory = ScanTrajectory(iterations_per_step=1)
    for step in steps[:-20]:
        assert not trajectory.update(step, optimize=False).optimized
    assert trajectory.unfinished
    assert any(trajectory.update(step).optimized for step in steps[-20:])
    trajectory.finish()
    assert errors(trajectory, true).max() < 0.3


numbers = st.floats(-1e3, 1e3) | st.sampled_from([0.0, np.nan, np.inf, 1e-300, 1e9, 1e300])


@st.composite
def any_steps(draw: st.DrawFn) -> list[RelativeStep]:
    """Steps in any order, some lost, some with numbers of any kind."""
    _, _, steps = loop_drive()
    chosen = draw(st.lists(st.integers(0, 60), min_size=1, max_size=40))
    result = []
    for k in sorted(chosen) if draw(st.booleans()) else chosen:
        step = steps[k]
        kind = draw(st.integers(0, 7))
        values = np.array(draw(st.lists(numbers, min_size=9, max_size=9)))
        if kind == 1:
            step = replace(step, covariance=values.reshape(3, 3))
        elif kind == 2 and step.key is not None:
            step = replace(step, key=replace(step.key, covariance=values.reshape(3, 3)))
        elif kind == 3:
            step = replace(step, relative_xyyaw=values[:3], odom_xyyaw=values[3:6])
        elif kind == 4:
            step = replace(step, robot_odom_xyyaw=values[:3], from_stamp_ns=step.from_stamp_ns - 7)
        elif kind == 5:
            step = replace(step, origin_stamp_ns=step.origin_stamp_ns + 1, key=None)
        result.append(step)
    return result


@settings(max_examples=60, deadline=None)
@given(any_steps(), st.integers(0, 2))
def test_any_sequence_leaves_a_sound_trajectory(steps: list[RelativeStep], iterations: int) -> None:
    trajectory = ScanTrajectory(iterations_per_step=iterations)
    for step in steps:
        before = state(trajectory)
        try:
            update = trajectory.update(step)
        except RejectedStep:
            assert state(trajectory) == before
            continue
        assert update.fault == ""
        whole = trajectory.trajectory()
        assert whole is not None and len(whole.poses_xyyaw) == len(whole.online_xyyaw) == update.frames
        for values in (update.pose_xyyaw, update.covariance, update.map_from_odom_xyyaw, *list(vars(whole).values())):
            assert np.isfinite(values).all()
        np.testing.assert_allclose(whole.poses_xyyaw[-1], update.pose_xyyaw, atol=1e-6)
    trajectory.finish()
