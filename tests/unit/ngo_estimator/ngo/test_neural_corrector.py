"""The optimizer as a corrector of graphs whose answers are known."""

import numpy as np
import pytest
import torch

from ngo_estimator.graph.corrector import Corrector, GraphProblem
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.ngo.neural_corrector import NeuralCorrector
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from tests.unit.ngo_estimator.samples import small_optimizer

BEGIN = np.array((3.0, -2.0, 0.7))


def corrector(network: bool) -> Corrector:
    torch.manual_seed(0)
    aggregation = PoseAggregationConfig(motion_feature_size=1, halvings=0, width=8)
    return NeuralCorrector(NeuralGraphOptimizer(NeuralGraphOptimizerConfig(aggregation, network=network)).eval())


def problem(loops: list[tuple[int, int]], measured: list[tuple[float, float, float]]) -> GraphProblem:
    """20 steps of 1.02 m ahead that should be 1 m, from a pose of its own, and loops."""
    nodes = np.stack((np.arange(20), np.arange(1, 21)), axis=1)
    steps = RelativePoses.of_deviations(nodes, np.tile((1.02, 0.0, 0.0), (20, 1)), np.full((20, 3), 0.02))
    joined = RelativePoses.of_deviations(
        np.array(loops, np.int64).reshape(-1, 2), np.array(measured).reshape(-1, 3), np.full((len(loops), 3), 0.005)
    )
    ahead = 1.02 * np.arange(21.0)
    turned = np.stack((np.cos(BEGIN[2]) * ahead, np.sin(BEGIN[2]) * ahead, np.zeros(21)), axis=1)
    return GraphProblem(BEGIN + turned, steps, joined, np.ones(len(loops)))


@pytest.mark.parametrize("network", [False, True])
def test_right_loops_are_closed_whichever_way_they_look_and_a_wrong_one_is_not(network: bool) -> None:
    loops = [(0, 10), (20, 10), (0, 20), (2, 15)]
    graph = problem(loops, [(10.0, 0.0, 0.0), (-10.0, 0.0, 0.0), (20.0, 0.0, 0.0), (0.0, 4.0, 1.0)])
    solution = corrector(network).correct(graph)
    assert (solution.loop_weights[:3] > 0.5).all() and solution.loop_weights[3] < 0.01
    np.testing.assert_array_equal(solution.poses[0], BEGIN)
    length = np.linalg.norm(solution.poses[[10, 20], :2] - BEGIN[:2], axis=1)
    np.testing.assert_allclose(length, [10.0, 20.0], atol=0.02)
    np.testing.assert_allclose(solution.poses[:, 2], BEGIN[2], atol=1e-3)
    assert np.diagonal(solution.covariance([20])).max() < 0.02


def test_without_a_loop_the_graph_is_the_odometry() -> None:
    graph = problem([], [])
    np.testing.assert_allclose(corrector(True).correct(graph).poses, graph.poses, atol=1e-5)


def test_an_optimizer_of_longer_meta_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="expected an optimizer with loops whose meta-poses are of one step each"):
        NeuralCorrector(small_optimizer())
