"""What correctors have in common: a cost, a covariance, and the residuals that are linearised."""

import math

import numpy as np
import pytest

from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem, thresholds, truncated_cost
from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
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


def test_the_linearisation_is_that_of_the_residuals() -> None:
    generator = np.random.default_rng(3)
    poses = generator.normal(0.0, 1.0, (2, 3))
    root = generator.normal(0.0, 1.0, (3, 3))
    one = RelativePoses.of_covariances(
        np.array([[0, 1]]), generator.normal(0.0, 1.0, (1, 3)), (root @ root.T + np.eye(3))[None]
    )
    slopes = np.empty((3, 6))
    for k in range(6):
        moved = [poses.copy(), poses.copy()]
        for sign, each in zip((1.0, -1.0), moved, strict=True):
            each.reshape(-1)[k] += sign * 1e-6
        slopes[:, k] = -(one.residuals(moved[0]) - one.residuals(moved[1]))[0] / 2e-6
    weight, residual = 0.7, one.residuals(poses)[0]
    # Node 0 is known: the step is that of the second node alone, and so is the information.
    equations = NormalEquations(GraphStructure(one.nodes, 2), poses, one.relative, weight * one.information)
    hessian, gradient = weight * slopes[:, 3:].T @ slopes[:, 3:], weight * slopes[:, 3:].T @ residual
    np.testing.assert_allclose(equations.solution()[1], np.linalg.solve(hessian, gradient), rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(equations.covariance([1])), hessian, rtol=1e-6, atol=1e-9)
    # With a third node, to which a step leads, each of them has its share of what both measure.
    three = np.concatenate((np.zeros((1, 3)), poses))
    first = RelativePoses.of_covariances(np.array([[0, 1]]), poses[:1] + 0.1, np.eye(3)[None])
    nodes = np.concatenate((first.nodes, one.nodes + 1))
    relative, information = (
        np.concatenate((getattr(first, name), getattr(one, name))) for name in ("relative", "information")
    )
    joint = np.linalg.inv(NormalEquations(GraphStructure(nodes, 3), three, relative, information).covariance([1, 2]))
    expected = slopes.T @ slopes
    expected[:3, :3] += np.eye(3)
    np.testing.assert_allclose(joint, expected, rtol=1e-5, atol=1e-6)


def test_a_covariance_must_be_positive_definite() -> None:
    with pytest.raises(ValueError, match="positive definite"):
        RelativePoses.of_covariances(np.array([[0, 1]]), np.zeros((1, 3)), np.diag((1.0, 1.0, -1.0))[None])
