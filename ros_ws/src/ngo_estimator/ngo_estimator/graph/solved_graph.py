"""The graph as the last optimisation solved it: its nodes, and how well they are known."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.row_buffers import SlidingRows
from ngo_estimator.data.state_arrays import Arrays, part, taken, under
from ngo_estimator.graph.normal_equations import FactorisedInformation

_MOST_DRIFT = 4.0
"""How much the variance between a key frame and the newest pose is taken to be more than the graph says."""


@dataclass(frozen=True)
class SolvedGraph:
    """Nodes of an optimisation: key frames ``keys`` ``(n,)``, and the window from ``first`` to ``last``.

    ``end`` ``(3, 3)`` is the covariance of the last one in the map. ``information`` is of all, None without loops.
    """

    keys: np.ndarray
    first: int
    last: int
    end: np.ndarray
    information: FactorisedInformation | None

    @classmethod
    def none(cls) -> "SolvedGraph":
        """Before the first optimisation."""
        return cls(np.zeros(0, np.int64), 0, 0, np.zeros((3, 3)), None)

    def most_drift(
        self, start: np.ndarray, first: int, nodes: np.ndarray, step_std: SlidingRows, scale: float
    ) -> np.ndarray:
        """How far loops from key frames to the newest node may be off at most, variances ``(n, 3)``; else infinite.

        The odometry alone would let a pose of long ago lie anywhere; the loops that were closed since say more.

        Args:
            start: node where each loop begins ``(n,)``; ``first``: node where the window begins.
            nodes: poses of all nodes in the map; ``step_std``: deviations of each block.
            scale: factor of the graph's variances.
        """
        limits = np.full((len(start), 3), np.inf)
        if self.information is None or self.last < first:
            return limits  # nothing was optimised, or all of what was lies behind the window by now
        last = int(len(self.keys) + self.last - self.first)
        since = step_std.slice(self.last).astype(np.float64)
        travelled = nodes[self.last + 1 :, :2] - nodes[-1, :2]
        own = (since**2).sum(0) + np.array([1.0, 1.0, 0.0]) * (since[:, 2] ** 2 @ (travelled**2).sum(1))
        for k in np.flatnonzero(start < first):
            key = int(np.searchsorted(self.keys, start[k]))
            if key >= len(self.keys) or self.keys[key] != start[k]:
                continue
            covariance = np.zeros((6, 6))
            which = slice(0, 6) if key else slice(3, 6)
            covariance[which, which] = self.information.covariance([key, last] if key else [last])
            x, y = nodes[self.last, :2] - nodes[start[k], :2]
            jacobian = np.hstack((np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]]), -np.eye(3)))
            drift = np.diagonal(jacobian @ covariance @ jacobian.T)
            limits[k] = _MOST_DRIFT * (scale * drift + own)
        return limits

    def state(self) -> Arrays:
        """The same as arrays, for ``from_state``."""
        own = {"keys": self.keys, "ends": np.array((self.first, self.last)), "end": self.end}
        return own if self.information is None else own | under("information", self.information.state())

    @classmethod
    def from_state(cls, arrays: Arrays) -> "SolvedGraph":
        """Take a ``state()``; raises ``StateError``."""
        first, last = taken(arrays, "ends", np.int64, 2).tolist()
        information = part(arrays, "information")
        return cls(
            taken(arrays, "keys", np.int64, -1),
            first,
            last,
            taken(arrays, "end", np.float64, 3, 3),
            FactorisedInformation.from_state(information) if information else None,
        )
