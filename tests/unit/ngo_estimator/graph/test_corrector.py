"""What every corrector shares: a problem, a solution, and the cost by which solutions are compared."""

import math

import numpy as np
import pytest

from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem, thresholds, truncated_cost
from ngo_estimator.graph.relative_poses import RelativePoses

STD = 0.1


def straight(count: int, loops: RelativePoses) -> GraphProblem:
    """Steps of 1 m ahead, each known to ``STD``."""
    nodes = np.stack((np.arange(count), np.arange(1, count + 1)), axis=1)
    steps = RelativePoses.of_deviations(nodes, np.tile((1.0, 0.0, 0.0), (count, 1)), np.full((count, 3), STD))
    poses = np.arange(count + 1.0)[:, None] * (1.0, 0.0, 0.0)
    return GraphProblem(poses, steps, loops, np.ones(len(loops)))


def loop(metres: float, deviations: tuple[float, ...]) -> RelativePoses:
    return RelativePoses.of_deviations(np.array([[0, 3]]), np.array([[metres, 0.0, 0.0]]), np.array([deviations]))


def test_a_direction_of_which_nothing_is_known_is_no_degree_of_freedom() -> None:
    pose, place = loop(3.0, (STD, STD, STD)), loop(3.0, (STD, STD, math.inf))
    assert pose.degrees.tolist() == [3] and place.degrees.tolist() == [2]
    # Quantiles of chi-square at 0.99.
    np.testing.assert_allclose([thresholds(pose)[0], thresholds(place)[0]], [11.345, 9.210], atol=1e-3)
    turned = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 2.0)])
    assert place.residuals(turned).tolist() == [[0.0, 0.0, 0.0]]


def test_the_cost_is_the_squared_residual_up_to_the_threshold() -> None:
    near, far = straight(3, loop(3.2, (STD, STD, STD))), straight(3, loop(30.0, (STD, STD, STD)))
    assert truncated_cost(near, near.poses) == pytest.approx(4.0)
    assert truncated_cost(near, near.poses, loop_scale=4.0) == pytest.approx(1.0)
    assert truncated_cost(far, far.poses) == pytest.approx(11.345, abs=1e-3)


def test_the_covariance_is_of_what_is_believed() -> None:
    """Along x there are three steps of variance v to node 3, and a loop of variance v beside them."""
    problem = straight(3, loop(3.0, (STD, STD, STD)))
    believed = CorrectedGraph(problem, problem.poses, np.ones(1), np.ones(3), 0.0)
    refused = CorrectedGraph(problem, problem.poses, np.zeros(1), np.ones(3), 0.0)
    scaled = CorrectedGraph(problem, problem.poses, np.zeros(1), np.ones(3), 0.0, step_scale=4.0)
    variances = [graph.covariance([3])[0, 0] / STD**2 for graph in (believed, refused, scaled)]
    np.testing.assert_allclose(variances, [0.75, 3.0, 12.0], rtol=1e-6)


def test_a_problem_has_a_step_less_than_poses() -> None:
    problem = straight(3, loop(3.0, (STD, STD, STD)))
    with pytest.raises(ValueError, match="4 poses, 3 steps, 1 loops"):
        GraphProblem(problem.poses, problem.steps, problem.loops, np.ones(2))


def test_deviations_are_positive() -> None:
    with pytest.raises(ValueError, match="not positive"):
        loop(3.0, (STD, 0.0, STD))
