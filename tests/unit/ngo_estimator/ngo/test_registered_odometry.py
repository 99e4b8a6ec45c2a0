"""Steps that are measured again by scans: nearer the truth, and online the same as offline."""

import dataclasses

import numpy as np
import pytest
import torch

from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.place_encoder import PairHead, PlaceConfig, PlaceEncoder
from ngo_estimator.ngo.pose_aggregation import block_variances, poses_in_blocks
from ngo_estimator.ngo.registered_odometry import registered_steps
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.rooms import CONFIG, drive_in_the_room, registering_pair_head
from tests.unit.ngo_estimator.samples import small_optimizer
from training.scoring.online_estimate import steps_of

STEPS = 96
SEARCH = LoopSearch(2, 8, 2, 0, 3, registrations=4)


def position_errors(relative: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    return (se2.r2g(relative.double()) - truth)[..., :2].norm(dim=-1)


@pytest.mark.parametrize("known", [True, False])
def test_registered_steps_drift_less(known: bool) -> None:
    relative, log_std, codes, origin, truth = drive_in_the_room(STEPS)
    steps, deviations = registered_steps(
        registering_pair_head(), relative[None], log_std[None], codes[None], 8, 5, origin if known else None
    )
    before, after = position_errors(relative, truth), position_errors(steps[0], truth)
    assert after.max() < (0.1 if known else 0.5) * before.max()
    first_is_measured = not torch.equal(steps[0, 0], relative[0])
    assert first_is_measured == known
    # What is left of the errors of a block is what its deviations say.
    meta, true = poses_in_blocks(steps, 8)[0, 1:, -1], se2.g2r(truth[7::8])[1:]
    error = torch.cat(((meta - true)[:, :2], se2.wrap((meta - true)[:, 2:])), dim=1)
    std = block_variances(poses_in_blocks(steps, 8), deviations)[0, 1:].sqrt()
    assert (error / std).square().mean() < 9.0 and std.max() < 0.2 * 0.003 * 8**0.5


def relative_steps(steps: int, first_code: bool = True) -> list[RelativeStep]:
    relative, log_std, codes, origin, _ = drive_in_the_room(steps)
    motion = torch.rand(steps, 6, generator=torch.Generator().manual_seed(1))
    features = {"relative": relative, "log_std": log_std, "motion": motion, "codes": codes}
    features |= {"origin_code": origin} if first_code else {}
    return list(steps_of({name: values.numpy() for name, values in features.items()}))


@pytest.mark.parametrize("first_code", [True, False])
def test_online_is_offline(first_code: bool) -> None:
    optimizer, pair_head = small_optimizer(search=SEARCH), registering_pair_head()
    core = OnlineTrajectory(optimizer, pair_head, 2 * STEPS)
    steps = relative_steps(STEPS + 3, first_code)
    for step in steps:
        core.update(step)
    relative, log_std, codes, origin, truth = drive_in_the_room(STEPS + 3)
    motion = torch.from_numpy(np.stack([step.motion_feature for step in steps]))
    offline = optimize_offline(
        optimizer, pair_head, relative, log_std, motion, codes, origin if first_code else None
    ).poses[0]
    trajectory = core.trajectory()
    assert trajectory is not None
    np.testing.assert_allclose(trajectory.poses_xyyaw[1:, :2], offline[:, :2], atol=2e-4)
    errors = np.linalg.norm(trajectory.poses_xyyaw[1:, :2] - truth[:, :2].numpy(), axis=1)
    assert errors.max() < 0.3 * position_errors(relative, truth).max()
    np.testing.assert_array_equal(trajectory.odometry_xyyaw[1:], [step.odom_xyyaw for step in steps])


def test_beyond_the_window_scans_are_registered_with_key_frames() -> None:
    core = OnlineTrajectory(small_optimizer(search=SEARCH), registering_pair_head(), 48, key_frames=4)
    steps = 320
    for step in relative_steps(steps):
        core.update(step)
    trajectory = core.trajectory()
    assert trajectory is not None
    *_, relative, truth = (drive_in_the_room(steps)[k] for k in (0, 4))
    errors = np.linalg.norm(trajectory.poses_xyyaw[1:, :2] - truth[:, :2].numpy(), axis=1)
    assert errors.max() < 0.3 * position_errors(relative, truth).max()


def test_a_code_ends_with_the_ranges_of_its_frame() -> None:
    image = ImageFormat(1, 241, 4, "float32")
    config = PlaceConfig(image, 0.1, 0.5, code_size=12, registration=CONFIG)
    frames = torch.rand(2, *image.shape)
    frames[1, 0, 5, 3] = torch.inf
    codes = PlaceEncoder(config).eval()(frames)
    assert codes.shape == (2, config.code_length) == (2, 253)
    ranges = frames[:, 0, :, 3].clone()
    ranges[1, 5] = 0.0
    assert torch.equal(codes[:, 12:], ranges)
    plain = PlaceEncoder(dataclasses.replace(config, registration=None))
    assert plain.config.code_length == plain(frames).shape[1] == 12


def test_ranges_for_loops_alone_leave_the_odometry_as_it_is() -> None:
    pair_head = registering_pair_head()
    relative, log_std, codes, origin, _ = (value.unsqueeze(0) for value in drive_in_the_room(32))
    registered = registered_steps(pair_head, relative, log_std, codes, 8, 3, origin[:, 0])
    assert not torch.equal(registered[0], relative)
    coarse = loops_alone(pair_head)
    steps, deviations = registered_steps(coarse, relative, log_std, codes, 8, 3, origin[:, 0])
    assert steps is relative and deviations is log_std
    start, prior = torch.tensor([0.1, 0.0, 0.0]), torch.tensor([0.1, 0.05]).log()
    measured, _ = coarse.register(codes[0, 0], codes[0, 1], start, prior, 3)
    assert torch.equal(measured, pair_head.register(codes[0, 0], codes[0, 1], start, prior, 3)[0])
    assert not torch.equal(measured, start)


def loops_alone(pair_head: PairHead) -> PairHead:
    """The same, but for ranges that are not good enough for steps."""
    coarse = PairHead(dataclasses.replace(pair_head.config, registration=dataclasses.replace(CONFIG, odometry=False)))
    coarse.load_state_dict(pair_head.state_dict())
    return coarse.eval().requires_grad_(False)


def test_smoothed_online_is_offline_with_loops_that_are_registered() -> None:
    search = dataclasses.replace(SEARCH, most=64)  # all that there are: which of them are best depends on when one asks
    optimizer, pair_head = small_optimizer("smoothed", search=search), loops_alone(registering_pair_head())
    core = OnlineTrajectory(optimizer, pair_head, 2 * STEPS)
    steps = relative_steps(STEPS)
    for step in steps:
        core.update(step)
    relative, log_std, codes, *_ = drive_in_the_room(STEPS)
    motion = torch.from_numpy(np.stack([step.motion_feature for step in steps]))
    offline = optimize_offline(optimizer, pair_head, relative, log_std, motion, codes, None)
    trajectory = core.trajectory()
    assert trajectory is not None and offline.loop_weights is not None and offline.loop_weights.max() > 0.1
    np.testing.assert_allclose(trajectory.poses_xyyaw[1:, :2], offline.poses[0, :, :2], atol=2e-4)
