"""Which loops are believed: the judge's evidence, and the tests before it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.loops import place_loop_finder
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.loops.place_ambiguity import FEWEST_PLACES, looks_like_everything, places_by_odometry
from ngo_estimator.ngo.loop_gates import FARTHEST, without_contradictions
from ngo_estimator.ngo.loop_judge import EVIDENCE, WITHIN, LoopJudge, evidence_of
from ngo_estimator.ngo.meta_poses import MetaSteps
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.samples import make_loops, meta_steps, with_origin

BLOCKS = 40
STEPS = MetaSteps(meta_steps(BLOCKS), torch.full((1, BLOCKS, 3), 0.05, dtype=torch.float64), None, BLOCKS)
POSES = with_origin(se2.r2g(STEPS.relative))[0]
OFF = torch.tensor([0.3, -0.2, 0.02])
AGREEING = 8


def loops_off(ends: list[int], off: Tensor = OFF) -> Loops:
    """Loops from nodes 30 before ``ends`` that all say that the later node is ``off``, seen from the map."""
    starts = [end - 30 for end in ends]
    measured = torch.stack([se2.between(POSES[s], POSES[e] + off) for s, e in zip(starts, ends, strict=True)])
    return make_loops(starts, [end - 1 for end in ends], measured[None])


def asking_for_neighbours() -> LoopJudge:
    """A judge that believes loops to which one other agrees."""
    judge = LoopJudge()
    with torch.no_grad():
        for layer in judge.layers:
            for parameter in layer.parameters():
                parameter.zero_()
        judge.layers[0].weight[0, AGREEING] = 1.0
        judge.layers[2].weight[0, 0] = 1.0
        judge.layers[4].weight[0, 0] = 10.0
        judge.layers[4].bias[0] = -3.0
    return judge


def test_neighbours_that_agree_are_evidence_and_those_that_do_not_are_other_evidence() -> None:
    evidence, allowed = evidence_of(loops_off([32, 34, 37]), STEPS)
    assert evidence.shape == (1, 3, EVIDENCE) and allowed.all()
    torch.testing.assert_close(evidence[0, :, AGREEING].expm1(), torch.full((3,), 2.0))
    contradicting, _ = evidence_of(loops_off([32]).and_also(loops_off([34], -2.0 * OFF)), STEPS)
    assert (contradicting[0, :, AGREEING] == 0.0).all() and (contradicting[0, :, AGREEING + 1] > 0.0).all()


def test_a_judge_leaves_out_what_is_unlikely_or_not_allowed() -> None:
    judge = asking_for_neighbours()
    assert judge.judged(loops_off([32, 34]), STEPS, 0.8).valid.all()
    alone = judge.judged(loops_off([32]), STEPS, 0.8)
    assert not alone.valid.any() and (alone.start == alone.end).all()
    far = torch.tensor([100.0 * WITHIN, 0.0, 0.0])
    assert not judge.judged(loops_off([32, 34], far), STEPS, 0.8).valid.any()


def test_loops_that_were_found_by_poses_are_not_judged() -> None:
    loops = loops_off([32])
    found = asking_for_neighbours().judged(replace(loops, by_poses=torch.ones(1, 1, dtype=torch.bool)), STEPS, 0.8)
    assert found.valid.all() and torch.equal(found.logit, loops.logit)
    assert torch.equal(found.log_scale, loops.log_scale)


WEIGHTS = Path(__file__).parents[4] / "ros_ws/src/ngo_estimator/weights"
COUNT, STEP_M, STEP_STD = 200, 0.1, (0.0025, 0.0025, 0.001)


def straight_on(world: str, value: float) -> tuple[float, float, int]:
    """Distance, its published deviation and the number of believed loops of a straight drive with one constant code."""
    core = OnlineTrajectory.load(WEIGHTS / world, world=world)
    code = np.full(core.feature_sizes[1], value, np.float32)
    motion = np.zeros(core._optimizer.config.aggregation.motion_feature_size, np.float32)
    for k in range(COUNT):
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
    assert believed == 0 and abs(x - COUNT * STEP_M) < 3.0 * max(deviation, 0.02)


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
