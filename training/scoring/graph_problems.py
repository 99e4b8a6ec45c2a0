"""Pose graphs with wrong loops: synthetic ones of five kinds, and real ones of a folder; the truth is beside them.

A graph's truth is its true positions, or where nobody knows these the solution with its right loops alone.
"""

import gzip
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.geometry.se2 import between, compose
from ngo_estimator.graph.corrector import CorrectedGraph, Corrector, GraphProblem
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.trajectory.chained_graph import chained
from ngo_estimator.trajectory.g2o import read_g2o
from training.baselines.graph_peers import least_squares
from training.scoring.metrics import absolute_error_m

KINDS = ("random", "local", "grouped", "lookalike", "offset")
"""How loops are wrong: between any two nodes; near along the chain; in groups that agree; between long stretches that
look alike; by one and the same offset."""

BLOCK = 120
"""Loops in a block of a graph that comes online."""

_GROUP, _STRETCH = 10, 50
_NEAR_M = 2.0  # of a loop's two nodes
_PLACE_STD = 0.5
_STEP_STD = np.array((0.03, 0.03, 0.006))
_POOR_STEP_STD = np.array((0.06, 0.04, 0.03))
_LOOP_STD = np.array((0.05, 0.05, 0.02))
_APART = 40  # nodes between a loop's two
_OFFSET_M = 3.0
_LEAST_ATE_M = 0.5  # of Manhattan, whose steps are of a metre
_NODE_S = 0.5  # of Lecture Hall: between two nodes


@dataclass(frozen=True)
class JudgedProblem:
    """A problem, the true positions ``(nodes, 2)`` (m), and which loops are right ``(loops,)``."""

    problem: GraphProblem
    truth: np.ndarray
    right: np.ndarray
    least_ate_m: float = 0.0  # An error below which a graph counts as solved, where the truth is itself a solution.

    def ate_m(self, poses: np.ndarray) -> float:
        """Root mean square distance (m) of poses ``(nodes, 3)`` after the best alignment."""
        return absolute_error_m(poses, self.truth)


def synthetic(kind: str, percent: float, nodes: int, metric: bool, seed: int, hard: bool = False) -> JudgedProblem:
    """A graph of a robot that comes back to where it was; without ``metric`` its loops only say "the same place".

    A ``hard`` one has the odometry of poor wheels, and twice as many loops: its chain alone tells few of them apart.
    """
    rng = np.random.default_rng((seed, nodes, KINDS.index(kind), round(percent), int(metric)))
    true, std = _drive(nodes, rng), _POOR_STEP_STD if hard else _STEP_STD
    steps = between(true[:-1], true[1:]) + rng.normal(0.0, std, (nodes - 1, 3))
    ends = np.stack((np.arange(nodes - 1), np.arange(1, nodes)), axis=1)
    chain = RelativePoses.of_deviations(ends, steps, np.tile(std, (nodes - 1, 1)))
    pairs = _right_pairs(true, rng, nodes if hard else nodes // 2, _NEAR_M if metric else _PLACE_STD)
    relative = between(true[pairs[:, 0]], true[pairs[:, 1]]) + rng.normal(0.0, _LOOP_STD, (len(pairs), 3))
    right = RelativePoses.of_deviations(pairs, relative, np.tile(_LOOP_STD, (len(pairs), 1)))
    loops = with_wrong(right, true, kind, percent, rng)
    if not metric:
        deviations = np.tile((_PLACE_STD, _PLACE_STD, math.inf), (len(loops), 1))
        loops = RelativePoses.of_deviations(loops.nodes, np.zeros((len(loops), 3)), deviations)
    problem = GraphProblem(chain_poses(steps), chain, loops, np.ones(len(loops)))
    return JudgedProblem(problem, true[:, :2], np.arange(len(loops)) < len(right))


def _drive(nodes: int, rng: np.random.Generator) -> np.ndarray:
    """True poses ``(nodes, 3)``: half a metre a step along the streets of a square town, of nine metres a block."""
    side = max(3, round(math.sqrt(nodes / 60.0)))
    at, heading, steps = np.array((side // 2, side // 2)), 0, np.zeros((nodes - 1, 3))
    directions = np.array(((1, 0), (0, 1), (-1, 0), (0, -1)))
    k, block = 0, 18
    while k < nodes - 1:
        open_turns = [w for w in range(4) if ((at + directions[w] >= 0) & (at + directions[w] < side)).all()]
        ahead = [w for w in open_turns if (w - heading) % 4 != 2] or open_turns
        following = int(rng.choice(ahead))
        turn = ((following - heading + 1) % 4 - 1) * math.pi / 2.0
        steps[k : k + block, 0] = 0.5
        steps[k, 2] = turn
        at, heading, k = at + directions[following], following, k + block
    return chain_poses(steps)


def _right_pairs(true: np.ndarray, rng: np.random.Generator, count: int, near_m: float) -> np.ndarray:
    """Pairs ``(n, 2)`` of nodes near each other, the earlier one first."""
    pairs = KDTree(true[:, :2]).query_pairs(near_m, output_type="ndarray")
    apart = np.hypot(*(true[pairs[:, 0], :2] - true[pairs[:, 1], :2]).T)
    pairs = pairs[(pairs[:, 1] - pairs[:, 0] >= _APART) & (apart < near_m)]
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    return pairs[np.sort(rng.permutation(len(pairs))[:count])]


def with_wrong(
    right: RelativePoses, true: np.ndarray, kind: str, percent: float, rng: np.random.Generator
) -> RelativePoses:
    """Right loops, and behind them wrong ones, ``percent`` of all; ``true`` ``(nodes, 3)`` are the true poses."""
    count, nodes = round(len(right) * percent / (100.0 - percent)), len(true)
    if kind in ("grouped", "lookalike"):
        pairs, relative = _alike(true, count, _GROUP if kind == "grouped" else _STRETCH, right, rng)
    elif kind == "offset":
        rows = rng.integers(len(right), size=count)
        pairs, relative = right.nodes[rows].copy(), right.relative[rows] + (_OFFSET_M, 0.0, 0.0)
        pairs[:, 1] = np.minimum(pairs[:, 1] + round(2.0 * _OFFSET_M), nodes - 1)  # half a metre a node
    else:
        first = rng.integers(nodes - 5, size=4 * count)
        span = rng.integers(5, 30, size=4 * count) if kind == "local" else rng.integers(nodes, size=4 * count)
        pairs = np.sort(np.stack((first, (first + span) % nodes), axis=1), axis=1)
        relative = right.relative[rng.integers(len(right), size=len(pairs))]
        wrong = np.flatnonzero(_wrong(true, pairs, relative) & (pairs[:, 1] - pairs[:, 0] > 2))[:count]
        pairs, relative = pairs[wrong], relative[wrong]
    root = right.root[rng.integers(len(right), size=len(pairs))]
    return RelativePoses(
        np.concatenate((right.nodes, pairs)),
        np.concatenate((right.relative, relative)),
        np.concatenate((right.root, root)),
    )


def _alike(
    true: np.ndarray, count: int, length: int, right: RelativePoses, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Loops between stretches of so many nodes that look alike: each pair of stretches is off in one way."""
    stretches = -(-4 * count // length)
    ends = rng.integers(len(true) - length, size=(stretches, 2))
    pairs = (ends[:, None] + np.arange(length)[:, None]).reshape(-1, 2)
    # The second stretch seems to lie where the first does, as far off as right loops are.
    moved = np.repeat(right.relative[rng.integers(len(right), size=stretches)], length, axis=0)
    first, second = (np.repeat(true[ends[:, k]], length, axis=0) for k in (0, 1))
    seeming = compose(first, compose(moved, between(second, true[pairs[:, 1]])))
    relative = between(true[pairs[:, 0]], seeming)
    far = (np.abs(pairs[:, 1] - pairs[:, 0]) > length) & _wrong(true, pairs, relative)
    kept = np.flatnonzero(far)[:count]
    return pairs[kept], relative[kept] + rng.normal(0.0, 0.2 * _LOOP_STD, (len(kept), 3))


def _wrong(true: np.ndarray, pairs: np.ndarray, relative: np.ndarray) -> np.ndarray:
    """Whether what loops measured is farther from the truth than ``_NEAR_M`` ``(n,)``."""
    off = relative - between(true[pairs[:, 0]], true[pairs[:, 1]])
    wrong: np.ndarray = np.hypot(off[:, 0], off[:, 1]) > _NEAR_M
    return wrong


def lecture_hall(folder: Path) -> JudgedProblem:
    """Lecture Hall of the TUC SLAM data: its own loops, which say "the same place"; those over a metre are wrong."""
    rows: dict[str, list[list[float]]] = {"odom2": [], "loop": [], "point2": []}
    for name in ("lecture_hall_input.txt.gz", "lecture_hall_truth.txt.gz"):
        with gzip.open(folder / name, "rt") as lines:
            for words in map(str.split, lines):
                if words and words[0] in rows:
                    rows[words[0]].append([float(word) for word in words[1:]])
    odometry, loops, tracked = (np.array(rows[name]) for name in ("odom2", "loop", "point2"))
    stamps, seconds = odometry[:, 0], np.diff(odometry[:, 0])[:, None]
    poses = chain_poses(odometry[1:, 1:4] * seconds)
    nodes = np.unique(np.searchsorted(stamps, np.arange(0.0, stamps[-1], _NODE_S)))
    covariance = _propagated(poses, nodes, odometry[1:, 4:7] * seconds**2)
    ends = np.stack((np.arange(len(nodes) - 1), np.arange(1, len(nodes))), axis=1)
    steps = RelativePoses.of_covariances(ends, between(poses[nodes[:-1]], poses[nodes[1:]]), covariance)
    pairs = np.sort(np.abs(stamps[nodes] - loops[:, :2, None]).argmin(2), axis=1)
    deviations = np.tile((_PLACE_STD, _PLACE_STD, math.inf), (len(pairs), 1))
    places = RelativePoses.of_deviations(pairs, np.zeros((len(pairs), 3)), deviations)
    truth = np.stack([np.interp(stamps[nodes], tracked[:, 0], tracked[:, k]) for k in (1, 2)], axis=1)
    right = np.hypot(*(truth[pairs[:, 0]] - truth[pairs[:, 1]]).T) < 2.0 * _PLACE_STD
    return JudgedProblem(GraphProblem(poses[nodes], steps, places, np.ones(len(pairs))), truth, right)


def _propagated(poses: np.ndarray, nodes: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Covariances ``(nodes - 1, 3, 3)`` from node to node, of frames' motions with these variances ``(frames, 3)``."""
    own = np.repeat(np.arange(len(nodes) - 1), np.diff(nodes))
    start, frames = poses[nodes[own]], slice(nodes[0], nodes[-1])
    at, after = between(start, poses[frames]), between(start, poses[nodes[0] + 1 : nodes[-1] + 1])
    end = between(start, poses[nodes[own + 1]])
    moved = np.zeros((len(own), 3, 3))
    moved[:, 0, 0] = moved[:, 1, 1] = np.cos(at[:, 2])
    moved[:, 1, 0], moved[:, 2, 2] = np.sin(at[:, 2]), 1.0
    moved[:, 0, 1] = -moved[:, 1, 0]
    moved[:, 0, 2], moved[:, 1, 2] = after[:, 1] - end[:, 1], end[:, 0] - after[:, 0]
    return np.add.reduceat((moved * variances[frames, None, :]) @ moved.mT, nodes[:-1] - nodes[0])


def manhattan(folder: Path, kind: str, percent: float, seed: int) -> JudgedProblem:
    """Manhattan3500 with wrong loops, ``percent`` of all; the truth is its solution with its own loops."""
    own = chained(read_g2o(folder / "manhattan3500.g2o.gz")).problem
    steps, right, start = own.steps, own.loops, chain_poses(own.steps.relative)
    true = least_squares(GraphProblem(start, steps, right, np.ones(len(right))))
    rng = np.random.default_rng((seed, KINDS.index(kind), round(percent)))
    loops = with_wrong(right, true, kind, percent, rng)
    problem = GraphProblem(start, steps, loops, np.ones(len(loops)))
    return JudgedProblem(problem, true[:, :2], np.arange(len(loops)) < len(right), _LEAST_ATE_M)


def blocks(judged: JudgedProblem) -> Iterator[JudgedProblem]:
    """The graph as a robot builds it, after each block of loops in order of their later nodes.

    The last one is whole, but for nodes behind its last loop.
    """
    problem = judged.problem
    order = np.argsort(problem.loops.nodes.max(axis=1), kind="stable")
    for end in range(BLOCK, len(order) + BLOCK, BLOCK):
        rows = order[:end]
        nodes = int(problem.loops.nodes[rows].max()) + 1
        steps, loops = problem.steps[: nodes - 1], problem.loops[rows]
        part = GraphProblem(problem.poses[:nodes], steps, loops, problem.trust[rows])
        yield JudgedProblem(part, judged.truth[:nodes], judged.right[rows], judged.least_ate_m)


class Online:
    """Corrects the blocks of one graph, each from the solution of the one before it."""

    def __init__(self, corrector: Corrector) -> None:
        self._corrector = corrector
        self.solutions: list[CorrectedGraph] = []
        """One of each block."""

    def correct(self, problem: GraphProblem) -> CorrectedGraph:
        """The solution of the next block."""
        self.solutions.append(self._corrector.correct(problem, *self.solutions[-1:]))
        return self.solutions[-1]

    @property
    def changed(self) -> float:
        """Share of the verdicts about known loops that changed."""
        verdicts = [solution.loop_weights for solution in self.solutions]
        changes = [after[: len(before)] != before for before, after in zip(verdicts[:-1], verdicts[1:], strict=True)]
        return float(np.concatenate(changes).mean()) if changes else 0.0
