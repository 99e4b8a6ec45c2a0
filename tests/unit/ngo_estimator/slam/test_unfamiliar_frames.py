"""Unfamiliar frames: the graph leaves their odometry as it is, closes no loops with them, and is wary behind them."""

import functools
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.slam.blind_stretches import shrunk_corrections, summed_variances
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive, corrected, estimates


@functools.cache
def golden(world: str) -> list[RelativeStep]:
    """The odometry that the shipped local network makes of a stored drive."""
    return estimates(GoldenDrive.load(world), LocalOdometry.load(WEIGHTS / world))


@pytest.mark.parametrize("world", WORLDS)
def test_what_is_unfamiliar_is_left_to_the_odometry(world: str) -> None:
    steps = golden(world)
    core = OnlineTrajectory.load(WEIGHTS / world, world=world)
    unfamiliar = [replace(step, unlikeness=2.0) for step in steps]
    trajectory, update = corrected(unfamiliar, core)
    np.testing.assert_allclose(trajectory.poses_xyyaw[1:], trajectory.odometry_xyyaw[1:], atol=1e-4)
    assert update.closed_loops == 0
    # What is told of the deviations is published, whatever factor fits familiar frames.
    core.reset()
    _, familiar = corrected([replace(step, unlikeness=0.0) for step in steps], core)
    assert update.covariance[0, 0] > familiar.covariance[0, 0]


def test_a_session_with_unfamiliar_frames_goes_on_to_the_last_bit() -> None:
    steps = golden("maze3d")
    steps = [replace(step, unlikeness=2.0 if 90 < k < 110 else 0.0) for k, step in enumerate(steps)]
    original = OnlineTrajectory.load(WEIGHTS / "maze3d", 200, "maze3d", 8, 1)
    for step in steps[:120]:
        original.update(step)
    loaded = original.restored(original.state())
    for step in steps[120:]:
        np.testing.assert_array_equal(original.update(step).pose_xyyaw, loaded.update(step).pose_xyyaw)


def test_what_frames_told_before_they_were_known_to_be_unfamiliar_is_taken_back() -> None:
    """A mean over 16 frames tells: until then their loops and registrations were taken."""
    steps = golden("maze2d")
    told = len(steps) // 8 * 8 - 8
    late = [replace(step, unlikeness=2.0 if k >= told else 0.0) for k, step in enumerate(steps)]
    core = OnlineTrajectory.load(WEIGHTS / "maze2d", world="maze2d")
    trajectory, _ = corrected(late, core)
    assert core._back_end.closed.pairs[:, 1].max() <= told - 16
    ends = [told - 16, told]
    found, came = (between(*of[ends]) for of in (trajectory.poses_xyyaw, trajectory.odometry_xyyaw))
    np.testing.assert_allclose(found, came, atol=1e-4)


@pytest.mark.parametrize("world", WORLDS)
def test_behind_a_blind_stretch_a_small_correction_gives_way_to_the_odometry(world: str) -> None:
    steps = golden(world)
    half = len(steps) // 2
    unknown = np.diag([4.0, 4.0, 0.04])
    blind = [replace(step, unlikeness=2.0, covariance=unknown) if k >= half else step for k, step in enumerate(steps)]
    trajectory, update = corrected(blind, OnlineTrajectory.load(WEIGHTS / world, world=world))
    last = len(steps) // 8 * 8
    np.testing.assert_allclose(trajectory.poses_xyyaw[last], trajectory.odometry_xyyaw[last], atol=1e-3)
    moved = np.linalg.norm((trajectory.poses_xyyaw - trajectory.odometry_xyyaw)[: half - 16, :2], axis=1)
    assert moved.max() > 1e-3  # what was known before stays corrected
    assert update.covariance[0, 0] > 4.0


def test_no_update_goes_on_from_shrunk_corrections_even_where_the_window_has_left_the_blind_stretch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    steps = golden("maze3d")
    unknown = np.diag([4.0, 4.0, 0.04])
    blind = [replace(s, unlikeness=2.0, covariance=unknown) if 80 <= k < 88 else s for k, s in enumerate(steps)]
    core = OnlineTrajectory.load(WEIGHTS / "maze3d", 96, "maze3d", 16, 1)
    graph, apply, resume = core._back_end, core._back_end._apply, core._optimizer.resume
    shrunk_by, begun_off, behind = [0.0], [], []

    def applied(solution: Any, *given: Any) -> None:
        apply(solution, *given)
        shrunk_by[0] = np.abs(graph.graph.poses - solution.poses).max()

    def resumed(*given: Any) -> Any:
        begun_off.append(shrunk_by[0])
        return resume(*given)

    monkeypatch.setattr(graph, "_apply", applied)
    monkeypatch.setattr(core._optimizer, "resume", resumed)
    for step in blind:
        assert not core.update(step).fault
        behind.append(graph._first > 11 and graph._shrunk)
    assert any(behind) and begun_off
    assert max(begun_off) < 1e-4


def test_place_codes_alone_close_no_loop_across_a_blind_stretch(tmp_path: Path) -> None:
    """Nothing limits the motion within it: each place that looks alike would do."""
    steps = golden("maze2d")
    folder = shutil.copytree(WEIGHTS / "maze2d", tmp_path / "maze2d")
    described = json.loads((folder / "neural_graph_optimizer.json").read_text())
    described["config"]["search"]["registrations"] = 0
    (folder / "neural_graph_optimizer.json").write_text(json.dumps(described))
    core, half = OnlineTrajectory.load(folder, world="maze2d"), len(steps) // 2 // 8 * 8

    def across(stretch: range) -> int:
        core.reset()
        corrected([replace(step, unlikeness=2.0 if k in stretch else 0.0) for k, step in enumerate(steps)], core)
        believed = core._back_end.closed.pairs[core._back_end.closed.weight > 0.1]
        return int(((believed[:, 0] < half) & (believed[:, 1] >= half)).sum())

    assert across(range(0)) > 0
    assert across(range(half, half + 4)) == 0


NODES = 12
ODOMETRY = np.stack((np.arange(NODES, dtype=float), np.zeros(NODES), np.zeros(NODES)), axis=1)
CORRECTED = ODOMETRY + [0.0, 1.0, 0.0]
NO_LOOPS = np.zeros((0, 2), np.int64), np.zeros(0)


def blind(variance: float, steps: slice = slice(4, 8)) -> np.ndarray:
    of_steps = np.zeros((NODES - 1, 3))
    of_steps[steps, :2] = variance
    return of_steps


def test_where_all_is_familiar_nothing_changes() -> None:
    assert shrunk_corrections(CORRECTED, ODOMETRY, blind(0.0), *NO_LOOPS) is CORRECTED


def test_a_correction_smaller_than_the_unknown_motion_gives_way_to_the_odometry() -> None:
    poses = shrunk_corrections(CORRECTED, ODOMETRY, blind(2.0), *NO_LOOPS)
    np.testing.assert_allclose(poses[:5], CORRECTED[:5])
    np.testing.assert_allclose(poses[5:], ODOMETRY[5:], atol=1e-12)


def test_it_is_shrunk_by_the_rule_of_james_and_stein() -> None:
    poses = shrunk_corrections(CORRECTED, ODOMETRY, blind(0.1), *NO_LOOPS)
    # After two blind steps the correction of 1 m is of squared size 1 / 0.2 in their deviations.
    np.testing.assert_allclose(poses[6], [6.0, 1.0 - 0.2, 0.0])
    np.testing.assert_allclose(poses[8:, 1], 1.0 - 0.4)


def test_a_correction_of_many_deviations_stays() -> None:
    far = ODOMETRY + [0.0, 100.0, 0.0]
    np.testing.assert_allclose(shrunk_corrections(far, ODOMETRY, blind(1.0), *NO_LOOPS), far, atol=0.1)


def test_a_believed_loop_across_the_stretch_keeps_the_correction() -> None:
    loop = np.array([[2, 10]])
    np.testing.assert_array_equal(shrunk_corrections(CORRECTED, ODOMETRY, blind(2.0), loop, np.ones(1)), CORRECTED)
    doubted = shrunk_corrections(CORRECTED, ODOMETRY, blind(2.0), loop, np.full(1, 0.1))
    np.testing.assert_allclose(doubted[8:], ODOMETRY[8:], atol=1e-12)


def test_what_is_corrected_behind_a_stretch_moves_as_a_whole() -> None:
    bent = CORRECTED.copy()
    bent[9:] += [0.3, -0.2, 0.1]
    poses = shrunk_corrections(bent, ODOMETRY, blind(2.0), *NO_LOOPS)
    for k in range(8, NODES):
        np.testing.assert_allclose(between(poses[8], poses[k]), between(bent[8], bent[k]), atol=1e-12)


def test_headings_are_compared_the_short_way_round() -> None:
    turned = CORRECTED.copy()
    turned[:, 2] += 2.0 * np.pi
    poses = shrunk_corrections(turned, ODOMETRY, blind(2.0), *NO_LOOPS)
    np.testing.assert_allclose(np.cos(poses[8:, 2]), 1.0)
    np.testing.assert_allclose(poses[8:, :2], ODOMETRY[8:, :2], atol=1e-12)


def test_variances_add_up_between_key_frames() -> None:
    variance = np.arange(12.0).reshape(4, 3)
    summed = summed_variances(variance, np.array([0, 3, 4]))
    np.testing.assert_array_equal(summed, [variance[:3].sum(0), variance[3]])
