"""Other solvers of our graph find our optimum where all is well, and leave a wrong loop out."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.robust import Robust
from ngo_recordings.scan_stream import LidarScan
from training.baselines.graph_peers import Peer, cauchy_on_all, gnc, least_squares
from training.baselines.lidar_peers import scan_points

NODES = 40


def graph(seed: int = 0, wrong: int = 0) -> tuple[RelativePoses, RelativePoses, np.ndarray, np.ndarray]:
    """Steps and loops of two laps of a circle, the chain of the steps, and the truth."""
    rng = np.random.default_rng(seed)
    angle = 4.0 * math.pi * np.arange(NODES) / NODES
    truth = np.stack((5.0 * np.sin(angle), 5.0 - 5.0 * np.cos(angle), angle), axis=-1)
    covariance = np.diag((0.02**2, 0.05**2, 0.02**2))
    covariance[0, 1] = covariance[1, 0] = 0.5 * 0.02 * 0.05

    def measured(first: int, second: int) -> np.ndarray:
        return between(truth[first], truth[second]) + rng.multivariate_normal(np.zeros(3), covariance)

    chain = [(k, k + 1) for k in range(NODES - 1)]
    pairs = [(k, k + NODES // 2) for k in range(0, NODES // 2, 3)]
    steps = np.stack([measured(*pair) for pair in chain])
    loops = np.stack([measured(*pair) for pair in pairs])
    loops[:wrong, 0] += 3.0
    poses = [np.zeros(3)]
    for step in steps:
        poses.append(compose(poses[-1], step))
    factors = [
        RelativePoses.of_covariances(np.array(nodes), relative, np.tile(covariance, (len(nodes), 1, 1)))
        for nodes, relative in ((chain, steps), (pairs, loops))
    ]
    return factors[0], factors[1], np.stack(poses), truth


def test_gtsam_finds_the_optimum_of_our_own_graph() -> None:
    steps, loops, start, _ = graph()
    problem = GraphProblem(start, steps, loops, np.ones(len(loops)))
    ours = Robust().correct(problem)
    assert (ours.loop_weights == 1.0).all()  # no loop is wrong
    theirs = least_squares(problem)
    np.testing.assert_allclose(theirs[:, :2], ours.poses[:, :2], atol=5e-4)
    off = np.remainder(theirs[:, 2] - ours.poses[:, 2] + math.pi, 2.0 * math.pi) - math.pi
    np.testing.assert_allclose(off, 0.0, atol=5e-4)


@pytest.mark.parametrize("solve", [cauchy_on_all, gnc])
def test_a_wrong_loop_does_little(solve: Peer) -> None:
    steps, loops, start, truth = graph(wrong=1)
    poses = solve(GraphProblem(start, steps, loops, np.ones(len(loops))))
    assert np.abs(poses[:, :2] - truth[:, :2]).max() < 0.5
    assert np.abs(poses[-1, :2] - truth[-1, :2]).max() < np.abs(start[-1, :2] - truth[-1, :2]).max() + 0.05


def test_points_of_a_scanner_that_hangs_upside_down_to_the_left() -> None:
    ranges = np.array((1.0, np.inf, 2.0, 0.01), np.float32)
    scan = LidarScan(0, 0.0, math.pi / 2, ranges, 0.05, 10.0, 0.0, "laser")
    points = scan_points(scan, Mounting(np.array((0.5, 0.0, math.pi / 2)), upside_down=True))
    np.testing.assert_allclose(points, ((0.5, 1.0), (0.5, -2.0)), atol=1e-12)
