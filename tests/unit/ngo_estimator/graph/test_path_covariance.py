"""How sure a path through the graph is, and what paths say of two places that may be one."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.graph.cycle_agreement import ChainUncertainty
from ngo_estimator.graph.path_covariance import covariances_of, path_covariances
from ngo_estimator.graph.place_agreement import place_ratio
from ngo_estimator.graph.relative_poses import RelativePoses

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


def test_where_no_path_may_lead_it_is_infinite() -> None:
    variance = np.ones(len(STEPS))
    variance[3] = np.inf
    found = covariances_of(chained(), CHAIN, spread(len(STEPS)), variance, len(STEPS))
    assert np.isinf(found[:4]).all() and np.isfinite(found[4:]).all() and not found[-1].any()


_VARIANCE = 0.25  # of a place, m^2
_NEVER = 1e-6  # deviation of a step that is all but known


def _there_and_back(turned: float = math.pi, deviation: float = _NEVER) -> ChainUncertainty:
    """Ten steps of a metre, and the same way back: node n lies where node 20 - n does, if the turn was ``turned``."""
    steps = np.tile((1.0, 0.0, 0.0), (20, 1))
    steps[10] = (math.cos(turned), math.sin(turned), turned)
    deviations = np.full((20, 3), _NEVER)
    deviations[10, 2] = deviation
    ends = np.stack((np.arange(20), np.arange(1, 21)), axis=1)
    return ChainUncertainty(RelativePoses.of_deviations(ends, steps, deviations))


def _places(*nodes: tuple[int, int]) -> RelativePoses:
    deviations = np.tile((math.sqrt(_VARIANCE), math.sqrt(_VARIANCE), math.inf), (len(nodes), 1))
    return RelativePoses.of_deviations(np.array(nodes), np.zeros((len(nodes), 3)), deviations)


def _likelier(off: float, known: float, more: float) -> float:
    """Log of N(off; 0, known) / N(off; 0, known + more)."""
    return 0.5 * (math.log((known + more) / known) - off**2 / known + off**2 / (known + more))


def test_ways_that_are_equal_speak_for_both_loops_as_solved_by_hand() -> None:
    ratio = place_ratio(_there_and_back(), _places((0, 20), (5, 15)), np.array(((0, 1), (1, 0))))
    length = _likelier(0.0, 2.0 * _VARIANCE, 25.0 / 3.0)
    direction = _likelier(0.0, 2.0 * _VARIANCE / 25.0, math.pi**2 / 3.0)
    np.testing.assert_allclose(ratio, length + direction, rtol=1e-6)


def test_ways_that_differ_speak_against_them_as_solved_by_hand() -> None:
    ratio = place_ratio(_there_and_back(), _places((0, 20), (5, 18)), np.array(((0, 1),)))
    length = _likelier(3.0, 2.0 * _VARIANCE, 3.5**2 / 3.0)
    direction = _likelier(0.0, 2.0 * _VARIANCE / 4.0, math.pi**2 / 3.0)
    assert ratio[0] == pytest.approx(length + direction, rel=1e-6)


def test_a_turn_that_nobody_measured_takes_nothing_from_their_lengths() -> None:
    pairs, loops = np.array(((0, 1),)), _places((0, 20), (5, 15))
    lost = [place_ratio(_there_and_back(turn, 1e3), loops, pairs)[0] for turn in (math.pi, 2.0)]
    np.testing.assert_allclose(lost, _likelier(0.0, 2.0 * _VARIANCE, 25.0 / 3.0), atol=1e-5)


def test_a_place_beside_the_robot_is_the_same_place_from_both_its_loops() -> None:
    """A loop's position is where its second node was seen: on the way back everything lies on the other side."""
    loops = _places((0, 20), (5, 15))
    seen = RelativePoses(loops.nodes, np.array(((3.0, 0.0, 0.0), (3.0, 0.0, 0.0))), loops.root)
    pairs = np.array(((0, 1),))
    np.testing.assert_allclose(
        place_ratio(_there_and_back(), seen, pairs), place_ratio(_there_and_back(), loops, pairs), rtol=1e-6
    )
