"""The graph leaves the odometry of unfamiliar frames as it is, and closes no loops with them."""

import functools
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry.planar_motion import all_between, between, chained
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive, corrected, estimates


@functools.cache
def golden(world: str) -> list[RelativeStep]:
    """The odometry that the shipped local network makes of a stored drive."""
    return estimates(GoldenDrive.load(world), LocalOdometry.load(WEIGHTS / world))


@pytest.mark.parametrize("world", WORLDS)
def test_what_is_unfamiliar_is_left_to_the_odometry(world: str) -> None:
    torch.set_num_threads(1)
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
    torch.set_num_threads(1)
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
    torch.set_num_threads(1)
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
    torch.set_num_threads(1)
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
    torch.set_num_threads(1)
    steps = golden("maze3d")
    unknown = np.diag([4.0, 4.0, 0.04])
    blind = [replace(s, unlikeness=2.0, covariance=unknown) if 80 <= k < 88 else s for k, s in enumerate(steps)]
    core = OnlineTrajectory.load(WEIGHTS / "maze3d", 96, "maze3d", 16, 1)
    graph, iterate = core._back_end, core._optimizer.iterate
    solved, differences, behind = [np.zeros((1, 3))], [], []

    def remembered(*given: Any) -> Iterator[Any]:
        if (solution := given[-1]) is not None:
            relative = all_between(solved[0][:-1], solved[0][1:])
            differences.append(np.abs(solution.relative[0, : len(relative)].numpy() - relative).max())
        for result in iterate(*given):
            solved[0] = chained(result.meta_relative[-1][0].double().numpy())
            yield result

    monkeypatch.setattr(core._optimizer, "iterate", remembered)
    for step in blind:
        assert not core.update(step).fault
        behind.append(graph._first > 11 and graph._shrunk)
    assert any(behind) and differences
    assert max(differences) < 1e-4


def test_place_codes_alone_close_no_loop_across_a_blind_stretch(tmp_path: Path) -> None:
    """Nothing limits the motion within it: each place that looks alike would do."""
    torch.set_num_threads(1)
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
