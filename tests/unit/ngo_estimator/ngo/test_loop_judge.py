"""A judge of loops learns from true poses what the odometry and other loops nearby tell."""

from dataclasses import replace

import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.loop_judge import EVIDENCE, WITHIN, LoopJudge, evidence_of
from ngo_estimator.ngo.meta_poses import MetaSteps
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
