"""What a network sees of the loops of a pose graph: numbers of each, and of each beside some others, its partners.

All are bounded logarithms and ratios, so that covariances that are mis-stated fifty times stay within what a network
has seen. Nothing depends on the order of loops, on where the map begins, or on which way it is turned.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from ngo_estimator.geometry.se2 import wrap
from ngo_estimator.graph.corrector import GraphProblem, thresholds
from ngo_estimator.graph.cycle_agreement import ChainUncertainty, covariances
from ngo_estimator.graph.loop_evidence import likelihood_ratio, map_area
from ngo_estimator.graph.place_agreement import place_ratio

TOKEN_FEATURES = 35
PAIR_FEATURES = 12
PARTNERS = 32

_NEAREST = 12  # partners whose ends are nearest along the chain; the others agree best
_NEAR_ASKED = 40
_FAR_ASKED = 56
"""Candidates for partners: of the nearest loops, and of all, spread over the graph."""

_END = 8  # nodes around a loop's end whose steps are looked at
_LEAST = 1e-3  # below it, a squared residual in deviations is none
_LARGEST = 30.0  # log likelihood ratio, either way


_Strain = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class LoopFeatures:
    """``tokens`` ``(loops, TOKEN_FEATURES)``, ``partners`` ``(loops, p)``, ``pairs`` ``(loops, p, PAIR_FEATURES)``."""

    tokens: np.ndarray
    partners: np.ndarray
    pairs: np.ndarray


class LoopView:
    """The loops of one problem, seen under poses that change; what does not depend on poses is worked out once.

    There are at least two loops.
    """

    def __init__(self, problem: GraphProblem) -> None:
        self.problem, loops = problem, problem.loops
        self._chain = ChainUncertainty(problem.steps)
        self._area = map_area(self._chain.poses)
        self._squared, self._logs = self._chain.off_chain(loops)
        ratio = likelihood_ratio(self._squared, self._logs, loops.degrees, self._area)
        self._ratio = np.clip(ratio, -_LARGEST, _LARGEST)
        covariance = covariances(loops)
        self._variance = 0.5 * (covariance[:, 0, 0] + covariance[:, 1, 1])
        self._limits = thresholds(loops)
        moved = np.hypot(*np.diff(self._chain.poses[:, :2], axis=0).T)
        self._travelled = np.concatenate(((0.0,), np.cumsum(moved)))
        self._choose_partners()

    def _choose_partners(self) -> None:
        """The nearest loops, and of these and some from all over the graph those that agree best."""
        loops, count = self.problem.loops, len(self.problem.loops)
        nodes = loops.nodes
        order = np.lexsort((*loops.relative.T, nodes[:, 1], nodes[:, 0]))
        far = order[np.unique(np.linspace(0, count - 1, _FAR_ASKED).round().astype(np.int64))]
        # Ends that are equally near would come in any order.
        spread = nodes[order] + 1e-3 * np.sin(np.arange(count, dtype=np.float64))[:, None]
        near = KDTree(spread).query(spread, k=min(_NEAR_ASKED + 1, count), p=1)[1].reshape(count, -1)
        asked = np.empty((count, near.shape[1] + len(far)), np.int64)
        asked[order, : near.shape[1]] = order[near]
        asked[:, near.shape[1] :] = far
        own = np.arange(count)[:, None]
        ratio, squared = self._compared(np.stack(np.broadcast_arrays(own, asked), axis=-1).reshape(-1, 2))
        ratio, squared = ratio.reshape(asked.shape), squared.reshape(asked.shape)
        # The nearest come first, then who agrees best; the loop itself and what is named twice come last.
        rank = -ratio
        rank[:, : _NEAREST + 1] = np.arange(_NEAREST + 1) - 1e6
        again = np.zeros(asked.shape, bool)
        again[:, near.shape[1] :] = (far[None, :, None] == asked[:, None, : near.shape[1]]).any(2)
        rank[again | (asked == own)] = np.inf
        kept = np.argsort(rank, axis=1, kind="stable")[:, :PARTNERS]
        self.partners = np.take_along_axis(asked, kept, axis=1)
        self._absent = ~np.isfinite(np.take_along_axis(rank, kept, axis=1))
        self._pair_ratio = np.take_along_axis(ratio, kept, axis=1)
        self._pair_squared = np.take_along_axis(squared, kept, axis=1)

    def _compared(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Log likelihood ratio ``(n,)`` of pairs of loops, and the squared residual of their cycle if it is whole."""
        loops, degrees = self.problem.loops, self.problem.loops.degrees
        whole = (degrees[pairs] == 3).all(1)
        ratio, squared = np.empty(len(pairs)), np.ones(len(pairs))
        if whole.any():
            rows = np.flatnonzero(degrees == 3)
            number = np.zeros(len(loops), np.int64)
            number[rows] = np.arange(len(rows))
            found, logs = self._chain.off_pairs(loops[rows], number[pairs[whole]])
            squared[whole] = found
            ratio[whole] = likelihood_ratio(found, logs, np.full(len(found), 3), self._area)
        if not whole.all():
            ratio[~whole] = place_ratio(self._chain, loops, pairs[~whole])
        return np.clip(ratio, -_LARGEST, _LARGEST), squared

    def under(self, poses: np.ndarray, weights: np.ndarray) -> LoopFeatures:
        """The features under poses ``(nodes, 3)`` that came of weights ``(loops,)``, all zero for the chain's."""
        problem, loops, count = self.problem, self.problem.loops, len(self.problem.loops)
        first, last = loops.nodes.min(1), loops.nodes.max(1)
        residuals = loops.residuals(poses)
        misfit = _log((residuals**2).sum(1) / self._limits)
        size = residuals / np.sqrt(self._limits)[:, None]
        strain = np.concatenate(((0.0,), np.cumsum((problem.steps.residuals(poses) ** 2).sum(1) / 3.0)))
        most = len(poses) - 1

        def strained(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            low, high = np.clip(np.minimum(a, b), 0, most), np.clip(np.maximum(a, b), 0, most)
            return _log((strain[high] - strain[low]) / np.maximum(high - low, 1))

        ends = np.sort(loops.nodes.ravel())
        crowds = [np.searchsorted(ends, n + _END, "right") - np.searchsorted(ends, n - _END) for n in (first, last)]
        predicted = np.hypot(*(poses[loops.nodes[:, 0], :2] - poses[loops.nodes[:, 1], :2]).T)
        chain = _log(self._squared)
        columns = [
            *(size / (1.0 + np.abs(size))).T,
            misfit,
            chain,
            self._logs / 10.0,
            self._ratio / 10.0,
            loops.degrees == 3,
            np.log(last - first + 1.0) / 5.0,
            np.log1p(self._travelled[last] - self._travelled[first]) / 5.0,
            np.log1p(predicted),
            np.log1p(np.hypot(*loops.relative[:, :2].T)),
            0.25 * np.log(self._variance),
            *(np.log1p(number) / 5.0 for number in crowds),
            strained(first, last),
            strained(first - _END, first + _END),
            strained(last - _END, last + _END),
            weights,
            problem.trust,
            *self._similar(),
            *np.broadcast_to(self._of_graph(misfit, chain, weights, strained)[:, None], (13, count)),
        ]
        tokens = np.stack([np.asarray(column, np.float32) for column in columns], axis=1)
        return LoopFeatures(tokens, self.partners, self._pairs(poses, misfit, strained))

    def _similar(self) -> tuple[np.ndarray, np.ndarray]:
        """The first similarity as its rank among all, -1 to 1, and whether there is one."""
        similarity, count = self.problem.similarity, len(self.problem.loops)
        if similarity is None:
            return np.zeros(count), np.zeros(count)
        values = similarity[:, 0]
        below, upto = (np.searchsorted(np.sort(values), values, side) for side in ("left", "right"))
        return (below + upto) / count - 1.0, np.ones(count)

    def _of_graph(self, misfit: np.ndarray, chain: np.ndarray, weights: np.ndarray, strained: _Strain) -> np.ndarray:
        whole = np.zeros(1, np.int64)
        levels = (0.1, 0.5, 0.9)
        return np.concatenate(
            (
                np.quantile(misfit, levels),
                np.quantile(chain, levels),
                np.quantile(self._ratio / 10.0, levels),
                (weights.mean(), float(weights.any())),
                (math.log(len(misfit) / len(self._travelled)),),
                strained(whole, whole + len(self._travelled)),
            )
        )

    def _pairs(self, poses: np.ndarray, misfit: np.ndarray, strained: _Strain) -> np.ndarray:
        loops, partners = self.problem.loops, self.partners
        start, end = poses[loops.nodes[:, 0]], poses[loops.nodes[:, 1]]
        cos, sin = np.cos(start[:, 2]), np.sin(start[:, 2])
        x, y = loops.relative[:, 0], loops.relative[:, 1]
        off = np.stack((start[:, 0] + cos * x - sin * y - end[:, 0], start[:, 1] + sin * x + cos * y - end[:, 1]), 1)
        apart = ((off[:, None] - off[partners]) ** 2).sum(2) / (self._variance[:, None] + self._variance[partners])
        turned = wrap(end[:, 2] - start[:, 2])
        i, j = loops.nodes[:, :1], loops.nodes[:, 1:]
        k, l = loops.nodes[partners, 0], loops.nodes[partners, 1]  # noqa: E741
        whole = loops.degrees == 3
        columns = [
            self._pair_ratio / 10.0,
            _log(self._pair_squared),
            whole[:, None] & whole[partners],
            np.log1p(np.abs(i - k)) / 5.0,
            np.log1p(np.abs(j - l)) / 5.0,
            _log(apart),
            misfit[partners],
            self._ratio[partners] / 10.0,
            np.cos(turned[:, None] - turned[partners]),
            strained(i, k),
            strained(j, l),
            self._absent,
        ]
        return np.stack([np.asarray(column, np.float32) for column in columns], axis=2)


def _log(squared: np.ndarray) -> np.ndarray:
    """A squared residual's logarithm, about -2 to 4."""
    logarithm: np.ndarray = np.log(np.clip(squared, _LEAST, 1e6)) / 4.0
    return logarithm
