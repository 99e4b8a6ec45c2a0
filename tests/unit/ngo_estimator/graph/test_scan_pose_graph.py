"""Pose graphs of key scans with answers worked out by hand."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.scan_pose_graph import ScanPoseGraph

WIDE = 1e6
"""Of the kernel: as good as none."""


def chain(steps: np.ndarray) -> np.ndarray:
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    return np.array(poses)


def measured(nodes: list[tuple[int, int]], relative: list[tuple[float, ...]], std: tuple[float, ...]) -> RelativePoses:
    covariance = np.broadcast_to(np.diag(np.square(std)), (len(nodes), 3, 3))
    return RelativePoses.of_covariances(
        np.array(nodes, np.int64).reshape(-1, 2), np.array(relative).reshape(-1, 3), covariance
    )


def steps_of(relative: np.ndarray, std: tuple[float, ...] = (0.1, 0.1, 0.01)) -> RelativePoses:
    return measured([(k, k + 1) for k in range(len(relative))], list(relative), std)


def solved(graph: ScanPoseGraph, iterations: int = 30) -> ScanPoseGraph:
    for _ in range(iterations):
        graph.iterate()
        if graph.converged:
            break
    return graph


def ahead(count: int, metres: float = 1.0) -> np.ndarray:
    return np.tile((metres, 0.0, 0.0), (count, 1))


def test_a_loop_shares_its_error_by_the_variances() -> None:
    """Four steps of 1 m with variance v, and a loop of 3.5 m with variance v: each gives way by a fifth of 0.5 m."""
    steps = ahead(4)
    graph = solved(
        ScanPoseGraph(
            steps_of(steps), measured([(0, 4)], [(3.5, 0.0, 0.0)], (0.1, 0.1, 0.01)), np.ones(1), chain(steps), WIDE
        )
    )
    np.testing.assert_allclose(graph.poses[:, 0], [0.0, 0.9, 1.8, 2.7, 3.6], atol=1e-6)
    np.testing.assert_allclose(graph.poses[:, 1:], 0.0, atol=1e-9)
    # Two ways to the last node, of variances 4 v and v.
    assert graph.covariance(steps_of(steps), 4)[0, 0] == pytest.approx(0.01 * 4.0 / 5.0, rel=1e-6)


def test_a_fix_across_a_corridor_moves_nothing_along_it() -> None:
    """The loop is sure across (y) and turned by 90 deg against the map: its own axes must be turned along."""
    steps = np.array([(0.0, 0.0, math.pi / 2.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    poses = chain(steps)
    # Seen from node 1, ahead is the map's y. It is 0.3 m to the left of where the chain has it, and 2 m short.
    along, across = 1e3, 1e-3
    loop = measured([(1, 4)], [(1.0, 0.3, 0.0)], (along, across, 1e3))
    between = steps_of(steps, (0.1, 0.1, 1e-4))
    graph = solved(ScanPoseGraph(between, loop, np.ones(1), poses, WIDE))
    np.testing.assert_allclose(graph.poses[4], [-0.3, 3.0, math.pi / 2.0], atol=2e-3)
    covariance = graph.covariance(between, 4)
    assert covariance[1, 1] > 0.02 and covariance[0, 0] < 2e-2  # the map's y is the corridor's length


def test_a_wrong_loop_is_gated_and_does_not_bend_the_chain() -> None:
    steps = ahead(40)
    right = [(k, k + 20) for k in range(0, 20, 4)]
    loops = measured([*right, (3, 35)], [*([(20.0, 0.0, 0.0)] * len(right)), (0.0, 4.0, 1.0)], (0.05, 0.05, 0.01))
    graph = solved(ScanPoseGraph(steps_of(steps, (0.02, 0.02, 0.01)), loops, np.ones(6), chain(steps), 3.0))
    assert graph.weights[-1] < 1e-3 and (graph.weights[:-1] > 0.9).all()
    np.testing.assert_allclose(graph.poses, chain(steps), atol=0.01)


def test_loops_without_trust_change_nothing() -> None:
    steps = ahead(5)
    loops = measured([(0, 5)], [(3.0, 1.0, 0.5)], (0.01, 0.01, 0.01))
    graph = solved(ScanPoseGraph(steps_of(steps), loops, np.zeros(1), chain(steps), 3.0))
    np.testing.assert_allclose(graph.poses, chain(steps), atol=1e-12)


def test_a_graph_without_loops_is_its_chain() -> None:
    steps = np.random.default_rng(1).normal(0.0, 0.5, (6, 3))
    none = measured([], [], (1.0, 1.0, 1.0))
    graph = solved(ScanPoseGraph(steps_of(steps), none, np.zeros(0), chain(steps), 3.0))
    np.testing.assert_allclose(graph.poses, chain(steps), atol=1e-12)
    assert graph.converged


def test_a_warm_start_ends_where_a_start_from_the_odometry_does() -> None:
    generator = np.random.default_rng(2)
    true = np.tile((0.5, 0.0, 2.0 * math.pi / 40.0), (80, 1))
    steps = true + generator.normal(0.0, (0.01, 0.01, 0.005), true.shape)
    pairs = [(k, k + 40) for k in range(0, 40, 3)]
    loops = measured(pairs, [tuple(generator.normal(0.0, 0.005, 3)) for _ in pairs], (0.01, 0.01, 0.01))
    factors = steps_of(steps, (0.01, 0.01, 0.005))
    cold = solved(ScanPoseGraph(factors, loops, np.ones(len(pairs)), chain(steps), 3.0), 60)
    few = loops.nodes[:5], loops.relative[:5], loops.root[:5]
    first = solved(ScanPoseGraph(factors, RelativePoses(*few), np.ones(5), chain(steps), 3.0))
    warm = solved(ScanPoseGraph(factors, loops, np.ones(len(pairs)), first.poses, 3.0), 60)
    assert np.abs(cold.poses - chain(steps)).max() > 0.02
    np.testing.assert_allclose(warm.poses, cold.poses, atol=1e-3)


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
