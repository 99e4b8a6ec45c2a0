"""Graphs to learn from, drawn at random: of every density, odometry and share of wrong loops, and not as stated.

They differ from those of the table in all that its cells fix. Their seeds are far from the table's.
"""

import math
from functools import reduce

import numpy as np

from ngo_estimator.geometry.se2 import between, wrap
from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.relative_poses import RelativePoses
from training.scoring.graph_problems import KINDS, LOOP_STD, STEP_STD, JudgedProblem, drive, right_pairs, with_wrong

TRAIN_SEEDS = range(1_000_000, 2_000_000)
VALIDATION_SEEDS = range(2_000_000, 3_000_000)

_NODES = (200, 600)
_LOOPS_PER_NODE = (0.3, 3.5)
_WRONG = (0.1, 0.85)
_STEP_FACTOR = (0.5, 4.0)
_POOR_TURNS = (1.0, 4.0)  # beside the other factor, as wheels that slip
_LOOP_FACTOR = (0.5, 2.0)
_PLACE_STD = (0.3, 1.0)
_MISSTATED = (0.02, 50.0)  # variances that are stated over true ones
_HONEST = 0.5  # share of graphs whose covariances are as stated
_KNOWS = ((True, False, False), (True, False, True), (False, True, False))
_RIGHT = 4.0  # deviations that a right loop is off by at most, in each direction


def drawn(seed: int) -> JudgedProblem:
    """The graph of a seed; a loop counts as right where the truth fits it."""
    rng = np.random.default_rng((seed, 44))
    nodes = int(rng.integers(*_NODES, endpoint=True))
    true, step_std = drive(nodes, rng), STEP_STD * _log_uniform(rng, _STEP_FACTOR)
    step_std[2] *= _log_uniform(rng, _POOR_TURNS)
    steps = between(true[:-1], true[1:]) + rng.normal(0.0, step_std, (nodes - 1, 3))
    place_share = float(rng.choice((0.0, 1.0, rng.uniform())))
    loops = _loops(true, rng, _log_uniform(rng, _LOOPS_PER_NODE), place_share)
    right = _fits(loops, true)
    order = rng.permutation(len(loops))
    loops, right = loops[order], right[order]
    stated_steps, stated_loops = 1.0, 1.0
    if rng.uniform() > _HONEST:
        stated_steps = _log_uniform(rng, _MISSTATED)
        stated_loops = stated_steps * _log_uniform(rng, (0.25, 4.0))
    ends = np.stack((np.arange(nodes - 1), np.arange(1, nodes)), axis=1)
    chain = RelativePoses.of_deviations(ends, steps, np.tile(step_std, (nodes - 1, 1))).scaled(stated_steps)
    problem = GraphProblem(chain_poses(steps), chain, loops.scaled(stated_loops), np.ones(len(loops)))
    return JudgedProblem(problem, true[:, :2], right)


def _loops(true: np.ndarray, rng: np.random.Generator, per_node: float, place_share: float) -> RelativePoses:
    """Right and wrong loops, of one to three kinds; some of them say only that two nodes are at one place."""
    wrong, count = rng.uniform(*_WRONG), max(20, round(per_node * len(true)))
    kinds = rng.choice(KINDS, size=int(rng.integers(1, 4)), replace=False)
    shares = rng.dirichlet(np.ones(len(kinds)))
    place_std, loop_std = rng.uniform(*_PLACE_STD), LOOP_STD * _log_uniform(rng, _LOOP_FACTOR)
    parts = []
    for place in (False, True):
        many = round(count * (place_share if place else 1.0 - place_share))
        if many < 10:
            continue
        pairs = right_pairs(true, rng, max(5, round(many * (1.0 - wrong))), place_std if place else 2.0)
        relative = between(true[pairs[:, 0]], true[pairs[:, 1]]) + rng.normal(0.0, loop_std, (len(pairs), 3))
        right = RelativePoses.of_deviations(pairs, relative, np.tile(loop_std, (len(pairs), 1)))
        of_kinds = [right]
        for kind, share in zip(kinds, shares, strict=True):
            number = len(right) * wrong / (1.0 - wrong) * share
            of_kinds.append(with_wrong(right, true, kind, 100.0 * number / (len(right) + number), rng)[len(right) :])
        loops = reduce(RelativePoses.extended, of_kinds)
        if place:
            deviations = np.tile((place_std, place_std, math.inf), (len(loops), 1))
            loops = RelativePoses.of_deviations(loops.nodes, np.zeros((len(loops), 3)), deviations)
        parts.append(loops)
    return reduce(RelativePoses.extended, parts)


def _fits(loops: RelativePoses, true: np.ndarray) -> np.ndarray:
    off = loops.relative - between(true[loops.nodes[:, 0]], true[loops.nodes[:, 1]])
    off[:, 2] = wrap(off[:, 2])
    fits: np.ndarray = (np.abs((loops.root @ off[..., None])[..., 0]) < _RIGHT).all(1)
    return fits


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    return float(np.exp(rng.uniform(*np.log(limits))))
