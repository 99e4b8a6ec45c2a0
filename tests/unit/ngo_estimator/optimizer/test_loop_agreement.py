"""Loops need the consent of the odometry and of other loops nearby."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.optimizer.loop_agreement import WITHIN, agreeing
from ngo_estimator.optimizer.loop_closure import Loops, LoopSearch
from ngo_estimator.optimizer.meta_poses import MetaSteps
from tests.unit.ngo_estimator.samples import make_loops, meta_steps, with_origin

BLOCKS = 40
STEPS = MetaSteps(meta_steps(BLOCKS), torch.full((1, BLOCKS, 3), 0.05, dtype=torch.float64), None, BLOCKS)
POSES = with_origin(se2.r2g(STEPS.relative))[0]
OFF = torch.tensor([0.3, -0.2, 0.02])


def loops_off(ends: list[int], off: Tensor = OFF) -> Loops:
    """Loops from nodes 30 before ``ends`` that all say that the later node is ``off``, seen from the map."""
    starts = [end - 30 for end in ends]
    measured = torch.stack([se2.between(POSES[s], POSES[e] + off) for s, e in zip(starts, ends, strict=True)])
    return make_loops(starts, [end - 1 for end in ends], measured[None])


def test_loops_that_agree_are_valid_and_one_alone_is_not() -> None:
    assert agreeing(loops_off([32, 34, 37]), STEPS, 1).valid.tolist() == [[True] * 3]
    assert agreeing(loops_off([32]), STEPS, 1).valid.tolist() == [[False]]


def test_the_more_a_loop_changes_the_more_witnesses_it_needs() -> None:
    small, large = OFF.new_tensor([0.01, 0.0, 0.0]), torch.tensor([0.0, 0.8, 0.0])
    assert agreeing(loops_off([32, 34], small), STEPS, 3).valid.all()
    assert not agreeing(loops_off([32, 34], large), STEPS, 3).valid.any()


def test_several_loops_of_one_frame_are_one_witness() -> None:
    again = loops_off([32, 34]).where(torch.tensor([0, 1, 1, 1]))
    fewest = 9
    assert agreeing(loops_off([32, 34, 36, 38]), STEPS, fewest).valid.all()
    assert agreeing(again, STEPS, 1).valid.all() and not agreeing(again, STEPS, fewest).valid[0, 0]


def test_what_the_odometry_does_not_allow_is_no_loop_and_no_witness() -> None:
    far = torch.tensor([100.0 * WITHIN, 0.0, 0.0])
    assert not agreeing(loops_off([32, 34, 36, 38], far), STEPS, 1).valid.any()


def test_loops_that_contradict_each_other_are_no_witnesses() -> None:
    one, other = loops_off([32]), loops_off([34], -2.0 * OFF)
    assert not agreeing(one.and_also(other), STEPS, 1).valid.any()


def test_what_is_not_valid_joins_neighbours_and_no_batch_sees_another() -> None:
    loops = loops_off([32, 34]).and_also(loops_off([33], torch.tensor([50.0, 0.0, 0.0])))
    found = agreeing(loops, STEPS, 1)
    assert found.valid.tolist() == [[True, True, False]] and found.start[0, 2] == found.end[0, 2] == 32
    assert found.start[0, :2].tolist() == [2, 4]
    alone = replace(loops, valid=torch.tensor([[True, False, False]]))
    assert not agreeing(alone, STEPS, 1).valid.any()


def test_a_search_takes_no_negative_number_of_witnesses() -> None:
    with pytest.raises(ValueError, match="witnesses is -1; expected 0"):
        LoopSearch(witnesses=-1)
