"""A planar graph as a problem for a corrector: its vertices in the order of their ids, a step from each to the next."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ngo_estimator.geometry.se2 import between, compose, inverse
from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem, thresholds
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.relative_poses import BELIEVED, RelativePoses
from ngo_estimator.trajectory.g2o import UNSTAMPED, PlanarGraph

_BREAK = -1  # in place of an edge, where no step leads to the next vertex


@dataclass(frozen=True)
class ChainedGraph:
    """A graph, sorted.

    An edge between neighbours that is not marked as a loop and knows the whole relative pose is a step: of several, the
    one that fits the vertices' lines best, or the first one where these are all equal. Where there is none, a step that
    knows next to nothing stands in: it is as wide as the graph. A step that is written again is left out; all other
    edges are loops.

    Attributes:
        graph: with its vertices by their ids, and those that had no line.
        edges: rows of its edges as the problem has them: of the steps ``(n - 1,)``, -1 where one stands in, and of the
            loops.
    """

    graph: PlanarGraph
    problem: GraphProblem
    edges: tuple[np.ndarray, np.ndarray]

    @property
    def breaks(self) -> int:
        """Neighbours that no step joins."""
        return int((self.edges[0] == _BREAK).sum())

    @cached_property
    def components(self) -> int:
        """Parts of the graph that no edge joins."""
        nodes, count = np.searchsorted(self.graph.ids, self.graph.edges), len(self.graph.ids)
        joined = coo_array((np.ones(len(nodes)), nodes.T), shape=(count, count))
        return int(connected_components(joined, directed=False)[0])

    def corrected(self, solution: CorrectedGraph) -> PlanarGraph:
        """The graph with what a corrector makes of it; the fixed vertex, or the first, stays where it was."""
        graph, (steps, loops) = self.graph, self.edges
        fixed = int(np.searchsorted(graph.ids, graph.fixed[0])) if graph.fixed else 0
        poses = compose(graph.poses[fixed], between(solution.poses[fixed], solution.poses))
        poses[fixed] = graph.poses[fixed]
        is_loop, belief = np.zeros(len(graph.edges), bool), np.full(len(graph.edges), np.nan)
        is_loop[loops], belief[loops] = True, solution.loop_weights
        doubted = (steps != _BREAK) & (solution.step_weights < BELIEVED)
        belief[steps[doubted]] = solution.step_weights[doubted]
        return graph.with_beliefs(poses, is_loop, belief)

    def misfit(self, solution: CorrectedGraph) -> np.ndarray:
        """Squared residual of each loop ``(loops,)``, in those that a right one stays below."""
        loops = self.problem.loops
        misfit: np.ndarray = loops.squared(solution.poses) / thresholds(loops)
        return misfit


def chained(graph: PlanarGraph) -> ChainedGraph:
    """Sort a graph.

    Raises:
        ValueError: several vertices are fixed.
    """
    if len(graph.fixed) > 1:
        raise ValueError(f"FIX holds {len(graph.fixed)} vertices, {graph.fixed[0]} first; expected one at most")
    ids = np.union1d(graph.ids, graph.edges)
    nodes, known = np.searchsorted(ids, graph.edges), np.searchsorted(ids, graph.ids)
    apart = nodes[:, 1] - nodes[:, 0]
    may_step = np.flatnonzero((np.abs(apart) == 1) & ~graph.is_loop & np.einsum("kii->ki", graph.information).all(1))
    poses, stamps = np.full((len(ids), 3), np.nan), np.full(len(ids), UNSTAMPED)
    poses[known], stamps[known] = graph.poses, graph.stamps_ns
    edges = RelativePoses(nodes, graph.relative, _roots(graph.information))
    if (graph.poses != graph.poses[:1]).any():  # equal ones are no first guess
        may_step = may_step[np.argsort(edges[may_step].squared(poses), kind="stable")]
    begins, first = np.unique(nodes[may_step].min(1), return_index=True)
    steps = np.full(len(ids) - 1, _BREAK)
    steps[begins] = may_step[first]
    twins, written = steps[nodes[may_step].min(1)], (nodes, graph.relative, graph.information.reshape(-1, 9))
    again = may_step[np.all([(each[may_step] == each[twins]).all(1) for each in written], axis=0)]
    loops = np.setdiff1d(np.arange(len(nodes)), again)
    relative, root = _forward(graph, steps, apart)
    gaps = np.flatnonzero(steps == _BREAK)
    relative[gaps] = 0.0
    _fill(poses, relative)
    relative[gaps] = between(poses[gaps], poses[gaps + 1])
    span = max(float(np.ptp(poses[:, :2], axis=0).max()), 1.0)
    root[gaps] = np.diag((1.0 / span, 1.0 / span, 1.0 / math.pi))
    chain = RelativePoses(np.stack((np.arange(len(steps)), np.arange(1, len(ids))), axis=1), relative, root)
    whole = PlanarGraph(
        ids, poses, stamps, graph.edges, graph.relative, graph.information, graph.is_loop, graph.belief, graph.fixed,
        graph.remarks,
    )  # fmt: skip
    return ChainedGraph(whole, GraphProblem(poses, chain, edges[loops], np.ones(len(loops))), (steps, loops))


def _forward(graph: PlanarGraph, steps: np.ndarray, apart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each step ``(n, 3)`` from the earlier vertex to the later one, and its root ``(n, 3, 3)``."""
    relative, root = graph.relative[steps].copy(), _roots(graph.information[steps])
    turned = np.flatnonzero((apart[steps] < 0) & (steps != _BREAK))
    back = inverse(relative[turned])
    cos, sin = np.cos(back[:, 2]), np.sin(back[:, 2])
    # The derivative of what was measured by its inverse: (x, y, t) = inverse(back).
    jacobian = np.zeros((len(turned), 3, 3))
    jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 0, 2] = -cos, -sin, back[:, 0] * sin - back[:, 1] * cos
    jacobian[:, 1, 0], jacobian[:, 1, 1], jacobian[:, 1, 2] = sin, -cos, back[:, 0] * cos + back[:, 1] * sin
    jacobian[:, 2, 2] = -1.0
    of_step = graph.information[steps[turned]]
    relative[turned], root[turned] = back, _roots(jacobian.mT @ of_step @ jacobian)
    return relative, root


def _fill(poses: np.ndarray, relative: np.ndarray) -> None:
    """Poses of the vertices that had no line, by the steps ``(n, 3)`` from the last one that had."""
    if np.isnan(poses[0, 0]):
        poses[0] = 0.0
    missing = np.flatnonzero(np.isnan(poses[:, 0]))
    known, chain = np.setdiff1d(np.arange(len(poses)), missing), chain_poses(relative)
    before = known[np.searchsorted(known, missing) - 1]
    poses[missing] = compose(poses[before], between(chain[before], chain[missing]))


def _roots(information: np.ndarray) -> np.ndarray:
    """Roots ``(n, 3, 3)`` of information matrices, with rows of zeros where these have them."""
    unknown = np.einsum("kii->ki", information) == 0.0
    root: np.ndarray = np.linalg.cholesky(information + unknown[:, None, :] * np.eye(3)).mT.copy()
    root[unknown] = 0.0
    return root
