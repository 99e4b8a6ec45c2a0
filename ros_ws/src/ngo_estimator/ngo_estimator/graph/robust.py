"""The robust corrector: no network, and right with most loops wrong.

Two methods give a solution: graduated non-convexity over all loops that the cycles do not rule out, and belief in the
surest loops first. Where one factor does not hold all places, graduated non-convexity tries two choices of them. What
each solution predicts lets more loops in. One cost judges between all. Covariances that are not as stated are scaled.
Cycles of loops that know the whole relative pose measure the scale before anything is solved, and the residuals of
what is believed measure it afterwards.
"""

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.graph.corrector import (
    CorrectedGraph,
    GraphProblem,
    Progress,
    normal_equations,
    silent,
    thresholds,
    truncated_cost,
)
from ngo_estimator.graph.cycle_agreement import ChainUncertainty, chain_poses
from ngo_estimator.graph.graduated import graduate
from ngo_estimator.graph.loop_evidence import agreement, cycle_odds, likeliest_mixture, map_area, scale_and_inlier_ratio
from ngo_estimator.graph.normal_equations import GraphStructure
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.surest_first import believe

_MISSTATED = 2.0
"""Variances that are off by less than this factor, either way, are taken as stated."""

LEAST_SCALE = 1e-3
"""Edges without any error, as of a computed graph, would give a scale of zero."""

_NEAR = 1.0
"""Where graduated non-convexity begins at poses that are nearly right."""

_GROWN = 1.25
"""A solution from nothing is worth its time once there are so many times as many loops as at the last one."""

_MOST_FILLED = 2_000_000
"""Blocks that one factorisation may multiply: where loops would fill it, some of them are tried."""

_CELLS = (20, 40)
"""Nodes: loops whose ends are, both, within one cell of the chain say nearly the same. Where a factor holds not all
loops, those that are tried depend on the cells."""

_FEWER = 0.7
"""How many loops are tried where those before are too many."""

_AGREE = 0.9
"""So many of the places that cycles let in or a solution believes are both. Otherwise the chain may be worse than
stated: then all loops are tried, too."""

_MOST_ROUNDS = 3
"""So often refused loops that agree with each other are asked again."""

_AGREED = 2.0
"""Log odds at which they are."""

_MANY = 0.02
"""A solution is looked for anew for so many of them, as a share of the loops that are believed."""

_LESS = 0.999
"""Share of the cost below which a solution is worth another round."""

_LEAST_REDUNDANCY = 30.0
"""Degrees of freedom from which on residuals measure a scale."""


class Robust:
    """A ``Corrector`` by graduated non-convexity and by belief in the surest loops first.

    Args:
        report: takes in a few words what has been done, as often as poses move.
        least_scale: variances are not taken to be smaller than so many times the stated ones. Where edges err together,
            as neighbouring scans do, small residuals do not say that covariances are stated too large.
    """

    def __init__(self, report: Progress = silent, least_scale: float = LEAST_SCALE) -> None:
        self._report, self._least_scale = report, least_scale

    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        """Solve a problem; see ``Corrector``.

        A warm solution lets new loops in by what the graph predicts of them. Once there are many more loops than at the
        last solution from nothing, there is one again, and the better one is kept. A loop that is written several
        times counts once.
        """
        solution = self._corrected(with_copies_once(problem), start)
        return replace(solution, loop_weights=problem.trust * (solution.loop_weights > 0.0))

    def _corrected(self, problem: GraphProblem, start: CorrectedGraph | None) -> CorrectedGraph:
        loops = len(problem.loops)
        if loops == 0:
            chain = chain_poses(problem.steps.relative, problem.poses[0])
            return CorrectedGraph(problem, chain, np.zeros(0), np.ones(len(problem.steps)), 0.0)
        if start is None or len(start.loop_weights) == 0:
            solution = _from_nothing(problem, self._report, self._least_scale)
            return _with_wider_loops(problem, solution, self._least_scale)
        warm = _warm(problem, start, self._report, self._least_scale)
        if loops < _GROWN * start.loops_from_nothing:
            return warm
        anew = _from_nothing(problem, self._report, self._least_scale)
        better = truncated_cost(problem, warm.poses, anew.scale, anew.scale) < anew.cost
        return replace(warm, loops_from_nothing=loops) if better else anew


def with_copies_once(problem: GraphProblem) -> GraphProblem:
    """The problem in which copies of a loop share its trust: written again, it is no second witness."""
    loops = problem.loops
    written = np.concatenate((loops.nodes, loops.relative, loops.root.reshape(len(loops), 9)), axis=1)
    _, which, copies = np.unique(written, axis=0, return_inverse=True, return_counts=True)
    return replace(problem, trust=problem.trust / copies[which.ravel()])


def _from_nothing(problem: GraphProblem, report: Progress, least_scale: float) -> CorrectedGraph:
    """The best of the solutions that begin at the chain."""
    scale, inlier_ratio = 1.0, 0.5
    metric = problem.loops[problem.loops.degrees == 3]
    if len(metric):
        chain, area = ChainUncertainty(problem.steps), map_area(problem.poses)
        scale, inlier_ratio = scale_and_inlier_ratio(chain, metric, area)
        scale = _noticed(scale, least_scale)
    solution = _searched(problem, scale, inlier_ratio, report, least_scale)
    found = solution.loop_scale
    if scale in (1.0, found):
        return solution
    # Cycles with the chain have its errors in common and measure a scale roughly; residuals of the solution do it well.
    polished = _polished(problem, solution.poses, found, len(problem.loops), least_scale)
    if scale <= _MISSTATED * max(found, solution.step_scale):
        return polished
    # Wrong loops near each other along the chain made up such large variances, and all that followed.
    believed = float(np.clip((polished.loop_weights > 0.0).mean(), 0.05, 0.95))
    anew = _searched(problem, found, believed, report, least_scale)
    wide, narrow = ([truncated_cost(problem, each.poses, by, by) for each in (anew, polished)] for by in (scale, found))
    return anew if wide[0] < wide[1] and narrow[0] < narrow[1] else polished


def _searched(
    problem: GraphProblem, scale: float, inlier_ratio: float, report: Progress, least_scale: float
) -> CorrectedGraph:
    """The best of the solutions with variances so many times as large as stated."""
    scaled, area = problem.scaled(scale), map_area(problem.poses)
    both = cycle_odds(ChainUncertainty(scaled.steps), scaled.loops, area, inlier_ratio)
    # What an unknown chain says against loops keeps wrong ones out, and right ones that join what lies behind it.
    chosen = both if ((both[0] > 0.0) != (both[1] > 0.0)).any() else both[:1]
    solutions = [_searched_by(odds, problem, scale, inlier_ratio, report, least_scale) for odds in chosen]
    return min(solutions, key=lambda solution: solution.cost)


def _searched_by(
    odds: np.ndarray, problem: GraphProblem, scale: float, inlier_ratio: float, report: Progress, least_scale: float
) -> CorrectedGraph:
    """The best of these solutions, from what the cycles say of loops ``(loops,)`` on."""
    area, scaled, metric = map_area(problem.poses), problem.scaled(scale), problem.loops.degrees == 3
    chain = chain_poses(problem.steps.relative, problem.poses[0])
    begun, solutions, count = replace(scaled, poses=chain), [], np.count_nonzero(odds > 0.0)
    # Of whole relative poses the likeliest are right; of places they are where the chain is short.
    orders = [np.argsort(-odds, kind="stable")]
    if not metric.any():
        orders = [_spread(scaled.loops.nodes, odds, cell) for cell in _CELLS]
    for order in orders:
        likely, structure = _affordable(begun, order[:count])
        solutions.append(graduate(likely, chain, report=report, structure=structure)[0])
        if len(likely.loops) == count or metric.any():
            nothing = np.zeros(len(likely.loops), bool)
            solutions.append(believe(likely, chain, nothing, area, inlier_ratio, report, structure)[0])
            break
    different = {scaled.fits(poses).tobytes(): poses for poses in solutions}  # what believes the same ends at the same
    solutions += [_second_look(scaled, poses, area, inlier_ratio, report) for poses in different.values()]
    best = min(solutions, key=lambda poses: truncated_cost(scaled, poses))
    fits, let_in = scaled.fits(best)[~metric], odds[~metric] > 0.0
    if not metric.all() and (fits & let_in).sum() <= _AGREE * (fits | let_in).sum():
        everything, structure = _affordable(begun, orders[0])
        poses = graduate(everything, chain, report=report, structure=structure)[0]
        best = min(best, poses, key=lambda poses: truncated_cost(scaled, poses))
    solution = _polished(problem, best, scale, len(problem.loops), least_scale)
    return _reconsidered(problem, solution, report, least_scale)


def _with_wider_loops(problem: GraphProblem, solution: CorrectedGraph, least_scale: float) -> CorrectedGraph:
    """The solution where whole loops have larger variances than one scale for steps and loops gives them.

    Residuals do not say that they are smaller: poses bend to loops. A warm solution goes by the one scale again.
    """
    metric = problem.loops.degrees == 3
    loops, area = problem.loops[metric], map_area(problem.poses)
    logs = -2.0 * np.log(np.abs(np.linalg.det(loops.root)))
    wider = likeliest_mixture(loops.squared(solution.poses), logs, loops.degrees, area)[0] / solution.scale
    if wider <= _MISSTATED:
        return solution
    root = np.where(metric[:, None, None], 1.0 / math.sqrt(wider), 1.0) * problem.loops.root
    apart = replace(problem, loops=replace(problem.loops, root=root))
    other = _polished(apart, solution.poses, solution.scale, len(problem.loops), least_scale)
    return replace(other, problem=problem, loop_scale=_noticed(wider * other.loop_scale, least_scale))


def _second_look(
    problem: GraphProblem, poses: np.ndarray, area: float, inlier_ratio: float, report: Progress
) -> np.ndarray:
    """Poses after what they predict has let more loops in: a cycle with a long chain ruled some out that are right."""
    misfit = problem.loops.squared(poses) / thresholds(problem.loops)
    nearest, structure = _affordable(replace(problem, poses=poses), np.argsort(misfit, kind="stable"))
    return believe(nearest, poses, nearest.fits(poses), area, inlier_ratio, report, structure)[0]


def _reconsidered(
    problem: GraphProblem, solution: CorrectedGraph, report: Progress, least_scale: float
) -> CorrectedGraph:
    """The solution after its refused loops that agree with each other were asked again, while that lowers the cost.

    Where a stretch of the graph lies wrongly, the right loops that lead there are refused, and say the same of it.
    Wrong ones may agree, too, as between floors that look alike: loops that the chain alone rules out are not asked.
    """
    scaled = problem.scaled(solution.scale)
    chain, loops = ChainUncertainty(scaled.steps), scaled.loops
    possible = (loops.degrees == 3) & (chain.off_chain(loops)[0] <= thresholds(loops))
    for _ in range(_MOST_ROUNDS):
        poses, believed = solution.poses, solution.loop_weights > 0.0
        again = np.flatnonzero(~believed & possible)
        if len(again) > _MANY * believed.sum():
            again = again[agreement(chain.bent(poses), loops[again], map_area(poses)) > _AGREED]
        if len(again) <= _MANY * believed.sum():
            break
        asked, structure = _affordable(replace(scaled, poses=poses), np.append(np.flatnonzero(believed), again))
        poses = graduate(asked, poses, report=report, structure=structure)[0]
        other = _polished(problem, poses, solution.scale, solution.loops_from_nothing, least_scale)
        if other.cost >= solution.cost:
            break
        much, solution = other.cost < _LESS * solution.cost, other
        if not much:
            break
    return solution


def _warm(problem: GraphProblem, start: CorrectedGraph, report: Progress, least_scale: float) -> CorrectedGraph:
    """The solution that the last one leads to."""
    nodes, old = len(start.poses), len(start.loop_weights)
    since = chain_poses(problem.steps.relative[nodes - 1 :], start.poses[-1])
    poses = np.concatenate((start.poses, since[1:]))
    scaled, believed = problem.scaled(start.scale), np.zeros(len(problem.loops), bool)
    believed[:old] = start.loop_weights > 0.0
    # A loop that was refused is asked again where it fits, or when all are.
    asked = np.flatnonzero(believed | scaled.fits(poses) | (np.arange(len(believed)) >= old))
    part = replace(scaled, loops=scaled.loops[asked], trust=scaled.trust[asked])
    poses, _ = believe(part, poses, believed[asked], map_area(poses), report=report)
    return _polished(problem, poses, start.scale, start.loops_from_nothing, least_scale)


def _spread(nodes: np.ndarray, odds: np.ndarray, cell: int) -> np.ndarray:
    """An order of loops ``(loops,)``: the likeliest of each cell, then the second ones, and those ruled out at the end.

    The likeliest of all lie where the chain is short and leave most of a long one alone.
    """
    cells = np.unique(np.sort(nodes, axis=1) // cell, axis=0, return_inverse=True)[1].ravel()
    order = np.lexsort((-odds, cells))
    first = np.searchsorted(cells[order], cells[order])
    rank = np.empty(len(odds), np.int64)
    rank[order] = np.arange(len(odds)) - first
    spread: np.ndarray = np.lexsort((-odds, rank, odds <= 0.0))
    return spread


def _affordable(problem: GraphProblem, rows: np.ndarray) -> tuple[GraphProblem, GraphStructure]:
    """The problem with the first of these loops alone, as many as do not fill its factor, and its structure."""
    while True:
        part = replace(problem, loops=problem.loops[rows], trust=problem.trust[rows])
        structure = part.structure(_MOST_FILLED)
        if structure.blocks.complete:
            return part, structure
        rows = rows[: int(_FEWER * len(rows))]


def _polished(problem: GraphProblem, poses: np.ndarray, scale: float, loops: int, least_scale: float) -> CorrectedGraph:
    """The nearest solution of the truncated cost, with variances so many times as large as stated."""
    scaled = problem.scaled(scale)
    poses, loop_weights, step_weights = graduate(scaled, poses, _NEAR, steps_break=True)
    cost = truncated_cost(scaled, poses)
    solution = CorrectedGraph(problem, poses, loop_weights, step_weights, cost, scale, loops_from_nothing=loops)
    of_steps, of_loops = _found_scales(scaled, solution)
    of_steps, of_loops = (_noticed(scale * found, least_scale) for found in (of_steps, of_loops))
    return replace(solution, step_scale=of_steps, loop_scale=of_loops)


def _noticed(scale: float, least: float) -> float:
    scale = max(scale, least)
    return 1.0 if 1.0 / _MISSTATED < scale < _MISSTATED else scale


def _found_scales(problem: GraphProblem, solution: CorrectedGraph) -> tuple[float, float]:
    """Chi-square per degree of freedom of the steps, and of the loops that are believed (Helmert's components).

    An edge's degrees of freedom are those that the rest of the graph knows better than the edge.
    """
    rows = np.flatnonzero(solution.loop_weights > 0.0)
    loops = problem.loops[rows]
    parts = (problem.steps, solution.step_weights), (loops, solution.loop_weights[rows])
    equations = normal_equations(solution.poses, *parts)

    def found(edges: RelativePoses, weights: np.ndarray) -> float:
        predicted = edges.predicted_covariances(solution.poses, equations.pair_covariances(edges.nodes))
        known = np.einsum("kii->k", predicted)
        redundancy = float((weights * (edges.degrees - weights * known)).sum())
        if redundancy < _LEAST_REDUNDANCY:
            return 1.0
        return float((weights * edges.squared(solution.poses)).sum()) / redundancy

    return found(*parts[0]), found(*parts[1])
