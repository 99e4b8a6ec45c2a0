"""The learned corrector: no harm, no order, and a network that is read back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import LOOP_ATTENTION, CheckpointError, load_loop_attention, save_checkpoint
from ngo_estimator.graph.corrector import GraphProblem, truncated_cost
from ngo_estimator.graph.crowds import without_crowds
from ngo_estimator.graph.learned import LearnedCorrector, iterated
from ngo_estimator.graph.loop_features import PARTNERS, LoopView
from ngo_estimator.graph.robust import Robust
from ngo_estimator.networks.loop_attention import LoopAttention, LoopAttentionConfig
from tests.unit.ngo_estimator.graph.test_robust import mixed


def network(seed: int = 0, attention: bool = True) -> LoopAttention:
    torch.manual_seed(seed)
    return LoopAttention(LoopAttentionConfig(width=16, attention=attention)).eval()


def permuted(problem: GraphProblem, order: np.ndarray) -> GraphProblem:
    return replace(problem, loops=problem.loops[order], trust=problem.trust[order])


def test_an_untrained_network_does_no_harm() -> None:
    problem, _ = mixed(0, 60, group=5)
    robust, learned = Robust().correct(problem), LearnedCorrector(network()).correct(problem)
    fair = without_crowds(problem.scaled(robust.scale))
    assert truncated_cost(fair, learned.poses) <= truncated_cost(fair, robust.poses)


def test_the_order_of_loops_does_not_matter() -> None:
    problem = mixed(0, 30)[0]
    order = np.random.default_rng(0).permutation(len(problem.loops))
    (_, weights), *_ = iterated(network(), problem)
    (_, others), *_ = iterated(network(), permuted(problem, order))
    np.testing.assert_allclose(others, weights[order], atol=1e-5)


def test_where_the_map_begins_does_not_matter() -> None:
    problem = mixed(1, 30)[0]
    turned = replace(problem, poses=problem.poses + (3.0, -2.0, 1.0))
    weights, others = ([*iterated(network(), one)][-1][1] for one in (problem, turned))
    np.testing.assert_allclose(others, weights, atol=1e-4)


def test_partners_are_others_and_differ() -> None:
    problem = mixed(2, 30)[0]
    view = LoopView(problem)
    assert view.partners.shape == (len(problem.loops), PARTNERS)
    for loop, partners in enumerate(view.partners):
        assert loop not in partners and len(set(partners)) == PARTNERS


def test_without_attention_partners_do_not_matter() -> None:
    alone, together = network(attention=False), network()
    problem, _ = mixed(3, 30)
    features = LoopView(problem).under(problem.poses, np.zeros(len(problem.loops)))
    tokens, partners, pairs = (torch.from_numpy(each) for each in (features.tokens, features.partners, features.pairs))
    assert torch.equal(alone(tokens, partners, pairs), alone(tokens, partners.flip(0), 0.0 * pairs))
    assert not torch.allclose(together(tokens, partners, pairs), together(tokens, partners.flip(0), pairs))


def test_a_saved_network_is_read_back(tmp_path: Path) -> None:
    path, saved = tmp_path / f"{LOOP_ATTENTION}.safetensors", network(4)
    save_checkpoint(path, saved, LOOP_ATTENTION, "graphs", {})
    read, _ = load_loop_attention(tmp_path)
    problem = mixed(4, 30)[0]
    for one, other in zip(iterated(saved, problem), iterated(read, problem), strict=True):
        np.testing.assert_array_equal(one[1], other[1])
    with pytest.raises(CheckpointError, match="cannot be read"):
        load_loop_attention(tmp_path / "elsewhere")
