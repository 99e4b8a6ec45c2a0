"""Unlike input is told, repeating frames are named, and deviations cover the truth, with the shipped weights."""

import functools
from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import FAMILIARITY, load_familiarity, load_local, load_place
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.frontend.camera.familiarity_watch import FamiliarityWatch
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from tests.golden.drives import WEIGHTS, WORLDS, GoldenDrive
from training.data.faults import SensedDrive, faulted
from training.scoring.consistency import estimates_of, odometry_covariances
from training.scoring.metrics import within

BEGIN = 60


@functools.cache
def stored(world: str) -> SensedDrive:
    drive = GoldenDrive.load(world)
    return SensedDrive(torch.from_numpy(drive.frames), drive.truth, drive.actions.astype(np.int64))


@functools.cache
def estimates(world: str, fault: str | None) -> list[LocalEstimate]:
    drive = stored(world) if fault is None else faulted(stored(world), fault, BEGIN, 0)
    return estimates_of(LocalOdometry.load(WEIGHTS / world), drive)


def share_within(world: str, steps: list[LocalEstimate]) -> float:
    odometry = np.stack([step.odom_xyyaw for step in steps])
    return within(odometry, odometry_covariances(odometry, steps), stored(world).poses_xyyaw[1:])


@pytest.mark.parametrize("world", WORLDS)
def test_a_familiar_drive_is_as_without(world: str) -> None:
    steps = estimates(world, None)
    without = LocalOdometry(load_local(WEIGHTS / world)[0], load_place(WEIGHTS / world)[0], world)
    plain = estimates_of(without, stored(world))
    assert np.mean([step.unlikeness > 1.0 for step in steps]) < 0.02
    assert not any(step.repeated for step in steps) and all(0.0 < step.unlikeness < 5.0 for step in steps)
    for one, other in zip(steps, plain, strict=True):
        assert other.unlikeness == 0.0
        if one.unlikeness <= 1.0:
            np.testing.assert_array_equal(one.relative_xyyaw, other.relative_xyyaw)
            np.testing.assert_array_equal(one.covariance, other.covariance)


@pytest.mark.parametrize("world", WORLDS)
def test_a_frozen_picture_is_named_and_its_deviations_hold_the_truth(world: str) -> None:
    steps = estimates(world, "frozen")
    frozen = [step for step in steps[BEGIN:] if np.linalg.norm(step.relative_xyyaw) > 0.0]
    assert np.mean([step.repeated for step in frozen]) > 0.8
    assert np.mean([step.unlikeness > 1.0 for step in frozen]) > 0.8
    assert share_within(world, steps) > 0.95


@pytest.mark.parametrize(("world", "fault"), [("maze2d", "noise"), ("maze2d", "lost"), ("maze3d", "noise")])
def test_unlike_frames_are_told(world: str, fault: str) -> None:
    steps = estimates(world, fault)
    assert np.mean([step.unlikeness > 1.0 for step in steps[BEGIN + 20 :]]) > 0.9
    assert share_within(world, steps) > 0.95


def test_errors_of_an_unfamiliar_stretch_add_up_as_deviations() -> None:
    """Its variances grow faster than those of independent errors, and begin anew behind it."""
    steps = estimates("maze2d", "frozen")
    deviation = np.sqrt(odometry_covariances(np.stack([s.odom_xyyaw for s in steps]), steps)[:, :2, :2].trace(0, 1, 2))
    along = deviation[BEGIN + 20 :: 20]
    assert (np.diff(along) > 0.0).all() and along[-1] > 2.0 * along[0]


def test_weights_without_it_work_and_others_than_those_beside_it_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "maze2d"
    folder.mkdir()
    for path in (WEIGHTS / "maze2d").iterdir():
        if not path.name.startswith(FAMILIARITY):
            (folder / path.name).write_bytes(path.read_bytes())
    assert load_familiarity(folder) is None and not LocalOdometry.load(folder).tells_unlike_input
    for suffix in (".json", ".safetensors"):
        content = (WEIGHTS / "maze2d" / f"{FAMILIARITY}{suffix}").read_bytes()
        (folder / f"{FAMILIARITY}{suffix}").write_bytes(content)
    assert LocalOdometry.load(folder).tells_unlike_input
    other = folder / "local_pose_network.json"
    other.write_text(other.read_text().replace('"sha256": "8', '"sha256": "9'))
    with pytest.raises(CheckpointError, match="fitted to another local_pose_network"):
        load_familiarity(folder)


@pytest.mark.parametrize("world", WORLDS)
def test_a_whole_drive_is_judged_as_frame_by_frame(world: str) -> None:
    network, place = load_local(WEIGHTS / world)[0], load_place(WEIGHTS / world)[0]
    familiarity = load_familiarity(WEIGHTS / world, world)
    assert familiarity is not None
    frozen = faulted(stored(world), "frozen", BEGIN, 0)
    actions = stored(world).actions
    assert actions is not None
    drive = SensedDrive(frozen.images[:100], frozen.poses_xyyaw[:100], actions[:99])
    one_by_one = estimates_of(LocalOdometry(network, place, world, familiarity), drive)
    plain = estimates_of(LocalOdometry(network, place, world), drive)
    steps = (
        torch.tensor(np.stack([step.relative_xyyaw for step in plain])),
        torch.tensor(np.stack([np.diag(step.covariance) for step in plain])),
        torch.tensor(np.stack([step.motion_feature for step in plain])),
    )
    watch = FamiliarityWatch(familiarity, place.encoder)
    together = watch.judge_drive(drive.images, drive.actions, steps)
    for one, other in zip(one_by_one, together, strict=True):
        assert one.repeated == other.repeated and one.unlikeness == pytest.approx(other.unlikeness, rel=1e-4)
        np.testing.assert_allclose(one.relative_xyyaw, other.relative, atol=1e-5)
        np.testing.assert_allclose(np.diag(one.covariance), other.variance, rtol=1e-3)
