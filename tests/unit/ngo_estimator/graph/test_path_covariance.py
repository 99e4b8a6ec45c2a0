"""Covariances along paths through a graph are those of what the edges' errors do to the poses."""

import numpy as np

from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.graph.path_covariance import path_covariances

RANDOM = np.random.default_rng(5)
STEPS = RANDOM.normal(size=(8, 3)) * (0.5, 0.2, 0.6) + (0.5, 0.0, 0.0)
CHAIN = np.array([(k, k + 1) for k in range(len(STEPS))])


def spread(count: int) -> np.ndarray:
    mixed = RANDOM.normal(size=(count, 3, 3)) * 0.02
    return mixed @ mixed.transpose(0, 2, 1) + 1e-5 * np.eye(3)


def chained() -> np.ndarray:
    poses = [np.array((1.0, -2.0, 0.4))]
    for step in STEPS:
        poses.append(compose(poses[-1], step))
    return np.stack(poses)


def test_along_a_chain_it_is_the_covariance_of_its_steps() -> None:
    poses, covariance = chained(), spread(len(STEPS))
    expected = np.zeros((3, 3))
    for k in range(2, len(STEPS)):
        expected = propagate(expected, poses[k + 1], STEPS[k], covariance[k])
    found = path_covariances(poses, CHAIN, covariance, np.array([(2, len(STEPS))]))
    np.testing.assert_allclose(found[0], expected, rtol=1e-6)


def test_a_path_may_lead_backwards_and_over_a_loop() -> None:
    """From key 3 back to 1, over a loop to 8, back to 6: all but two of the steps count as unknown."""
    poses, edges = chained(), np.concatenate((CHAIN, [(1, 8)]))
    covariance = spread(len(edges))
    covariance[[3, 4, 5]] = 1e4 * np.eye(3)
    expected = np.zeros((3, 3))
    for edge, backwards in ((2, True), (1, True), (8, False), (7, True), (6, True)):
        start, end = poses[edges[edge]]
        moved = np.zeros((3, 3))
        for axis in range(3):
            # The last key, seen from the first, after a small error of this edge.
            led = compose(start, between(start, end) + 1e-6 * np.eye(3)[axis])
            before, after = (led, end) if backwards else (end, led)
            other = compose(after, between(before, poses[6]))
            moved[:, axis] = (other - poses[6]) / 1e-6
        expected += moved @ covariance[edge] @ moved.T
    found = path_covariances(poses, edges, covariance, np.array([(3, 6)]))
    np.testing.assert_allclose(found[0], expected, rtol=1e-4, atol=1e-9)
