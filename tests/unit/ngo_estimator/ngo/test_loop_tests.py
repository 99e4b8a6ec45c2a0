"""Loops are tested against the odometry between their poses, and frames against looking like every place."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.loops import place_loop_finder
from ngo_estimator.loops.place_ambiguity import FEWEST_PLACES, looks_like_everything, places_by_odometry
from ngo_estimator.ngo.loop_gates import FARTHEST, without_contradictions
from ngo_estimator.ngo.meta_poses import MetaSteps
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.samples import make_loops

WEIGHTS = Path(__file__).parents[4] / "ros_ws/src/ngo_estimator/weights"
STEPS, STEP_M, STEP_STD = 200, 0.1, (0.0025, 0.0025, 0.001)


def straight_on(world: str, value: float) -> tuple[float, float, int]:
    """Distance, its published deviation and the number of believed loops of a straight drive with one constant code."""
    core = OnlineTrajectory.load(WEIGHTS / world, world=world)
    code = np.full(core.feature_sizes[1], value, np.float32)
    motion = np.zeros(core._optimizer.config.aggregation.motion_feature_size, np.float32)
    for k in range(STEPS):
        pose, relative = np.array([STEP_M * (k + 1), 0.0, 0.0]), np.array([STEP_M, 0.0, 0.0])
        covariance = np.diag(np.square(STEP_STD))
        first = code if k == 0 else None
        step = RelativeStep(k + 1, k, relative, covariance, 0, pose, motion, code, from_place_code=first)
        update = core.update(step)
    return float(update.pose_xyyaw[0]), float(update.covariance[0, 0] ** 0.5), update.closed_loops


@pytest.mark.parametrize("ambiguity", [True, False])
@pytest.mark.parametrize("value", [1.0, 0.5])
def test_no_number_of_loops_wins_over_confident_odometry(
    value: float, ambiguity: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All frames of a straight drive look the same."""
    if not ambiguity:
        monkeypatch.setattr(place_loop_finder, "looks_like_everything", lambda *_: torch.tensor(False))
    x, deviation, believed = straight_on("maze2d", value)
    assert believed == 0 and abs(x - STEPS * STEP_M) < 3.0 * max(deviation, 0.02)


@pytest.mark.parametrize("gradients", [False, True])
def test_loops_are_measured_in_deviations_of_the_odometry_between_their_poses(gradients: bool) -> None:
    steps = MetaSteps(torch.tensor([[[1.0, 0.0, 0.0]] * 16]), torch.full((1, 16, 3), 0.01), None, 16)
    deviation = 0.01 * 16**0.5
    within, beyond = 16.0 - 0.9 * FARTHEST * deviation, 16.0 - 1.1 * FARTHEST * deviation
    loops = make_loops([0] * 4, [15] * 4, torch.tensor([[x, 0.0, 0.0] for x in (16.0, within, beyond, 0.0)])[None])
    unsure = MetaSteps(steps.relative, 100.0 * steps.std, None, 16)
    with torch.set_grad_enabled(gradients):
        assert without_contradictions(loops, steps).valid.tolist() == [[True, True, False, False]]
        assert without_contradictions(loops, unsure).valid.all()


def test_a_frame_like_many_places_tells_none_and_a_robot_that_stood_long_is_no_such_frame() -> None:
    places = places_by_odometry(torch.stack((torch.arange(400) * 0.1, torch.zeros(400)), dim=-1), 1.0)
    assert places.unique().tolist() == list(range(40))
    all_frames = torch.ones(400, dtype=torch.bool)
    assert looks_like_everything(torch.ones(400), places, all_frames)
    some = (places < FEWEST_PLACES + 3).float()
    assert looks_like_everything(some, places, all_frames)
    assert not looks_like_everything((places < FEWEST_PLACES - 1).float(), places, all_frames)
    assert not looks_like_everything(some, places, places < 0)  # nothing is compared
    standing = torch.cat((torch.zeros(4000, dtype=torch.long), places))
    at_the_start = (standing == 0).float()
    assert not looks_like_everything(at_the_start, standing, torch.ones(4400, dtype=torch.bool))
    batch = torch.stack((torch.ones(400), torch.zeros(400)))[None]
    assert looks_like_everything(batch, places[None], all_frames).tolist() == [[True, False]]
