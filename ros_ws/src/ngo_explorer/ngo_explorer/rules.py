"""Rules that choose the next frontier: the unknown area a metre by default, and others of the literature."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ngo_explorer.frontiers import Candidate
from ngo_explorer.known_map import Floats
from ngo_explorer.settings import ExplorerConfig

_LOOP_M = 2.0  # a node this near is taken for a loop closure (Placed et al.)
_NODE_M = 1.0  # between two nodes of a predicted graph
_MOST_NODES = 150  # of the graph of where the robot was


@dataclass(frozen=True, eq=False)
class Situation:
    """What a rule decides on.

    candidates: at least one. present: the candidate that the robot drives to now, -1: none. trail: ``(n, 2)`` where the
    robot was, some metres apart, the newest last.
    """

    robot_xy: Floats
    candidates: Sequence[Candidate]
    present: int
    trail: Floats


Rule = Callable[[Situation], int]
"""Gives the index of the candidate to drive to."""


def make_rule(config: ExplorerConfig, rng: np.random.Generator) -> Rule:
    """The rule that a config names; ``rng`` is for those by chance."""
    scores: dict[str, Callable[[Situation], Floats]] = {
        "nearest": lambda seen: -_ways(seen),
        "explore_lite": _explore_lite,
        "gain_distance": lambda seen: np.array([c.gain_m2 for c in seen.candidates]) / np.maximum(_ways(seen), 0.5),
        "d_optimality": _d_optimality,
    }
    if config.rule == "random":
        return lambda seen: seen.present if seen.present >= 0 else int(rng.integers(len(seen.candidates)))
    score = scores[config.rule]
    return lambda seen: int(np.argmax(score(seen)))


def _ways(seen: Situation) -> Floats:
    return np.array([candidate.way_m for candidate in seen.candidates])


def _explore_lite(seen: Situation) -> Floats:
    """m-explore-ros2's cost with its defaults; its distance is a straight line to the nearest cell of the frontier."""
    costs = []
    for candidate in seen.candidates:
        at = candidate.frontier.points_xy
        costs.append(3.0 * np.hypot(*(at - seen.robot_xy).T).min() - 1.0 * candidate.frontier.size_m)
    return -np.array(costs)


def _d_optimality(seen: Situation) -> Floats:
    """D-optimality of the pose graph predicted for each candidate (Placed et al.): odometry, loops around it.

    ``n^(1/n) exp(logdet(L) / n)`` of the reduced Laplacian L of n nodes. An edge of odometry weighs less the
    more of its way leads into the unknown; a node within 2 m of the viewpoint is joined by a loop closure.
    """
    trail = seen.trail[-_MOST_NODES:]
    base = _laplacian(trail)
    found = []
    for candidate in seen.candidates:
        steps = max(1, round(candidate.way_m / _NODE_M))
        count = len(trail) + steps
        laplacian = np.zeros((count, count))
        laplacian[: len(trail), : len(trail)] = base
        share_unknown = min(1.0, candidate.gain_m2 / 10.0)
        for step in range(steps):
            _join(laplacian, len(trail) - 1 + step, len(trail) + step, 1.0 - 0.5 * share_unknown * (step + 1) / steps)
        away = np.hypot(*(trail - candidate.viewpoint_xy).T)
        for node in np.flatnonzero(away < _LOOP_M):
            _join(laplacian, int(node), count - 1, 1.0)
        _, logdet = np.linalg.slogdet(laplacian[1:, 1:])
        found.append(count ** (1.0 / count) * math.exp(logdet / count))
    return np.array(found)


def _laplacian(trail: Floats) -> Floats:
    laplacian = np.zeros((len(trail), len(trail)))
    away = np.hypot(trail[:, None, 0] - trail[None, :, 0], trail[:, None, 1] - trail[None, :, 1])
    for node in range(1, len(trail)):
        _join(laplacian, node - 1, node, 1.0)
        for other in np.flatnonzero(away[node, : max(0, node - 5)] < _LOOP_M):
            _join(laplacian, int(other), node, 1.0)
    return laplacian


def _join(laplacian: Floats, one: int, other: int, weight: float) -> None:
    laplacian[one, one] += weight
    laplacian[other, other] += weight
    laplacian[one, other] -= weight
    laplacian[other, one] -= weight
