"""Edges of a pose graph: their linearisation, and what they refuse."""

import numpy as np
import pytest

from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
from ngo_estimator.graph.relative_poses import RelativePoses


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
