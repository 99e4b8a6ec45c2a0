"""The graph as the last optimisation solved it: its nodes, and how well they are known."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, part, taken, under
from ngo_estimator.graph.normal_equations import FactorisedInformation
from ngo_estimator.graph.pose_graph import PoseGraph

_MOST_DRIFT = 4.0
"""How much the variance between a key frame and the newest pose is taken to be more than the graph says."""


@dataclass(frozen=True)
class SolvedGraph:
    """The nodes of an optimisation, which are the ``frames`` ``(n,)``.

    ``information`` is of all, None without loops.
    """

    frames: np.ndarray
    information: FactorisedInformation | None

    @classmethod
    def none(cls) -> "SolvedGraph":
        """Before the first optimisation: the origin alone."""
        return cls(np.zeros(1, np.int64), None)

    def most_drift(self, starts: np.ndarray, window: int, graph: PoseGraph, scale: float) -> np.ndarray:
        """How far loops from key frames to the newest node may be off at most, variances ``(n, 3)``; else infinite.

        The odometry alone would let a pose of long ago lie anywhere; the loops that were closed since say more.

        Args:
            starts: nodes where the loops begin ``(n,)``; ``window``: node where the window begins.
            scale: factor of the graph's variances.
        """
        limits = np.full((len(starts), 3), np.inf)
        frames, nodes, end = graph.frames.nodes, graph.poses, len(self.frames) - 1
        last = int(np.searchsorted(frames, self.frames[-1]))
        if self.information is None or last < window:
            return limits  # nothing was optimised, or all of what was lies behind the window by now
        since = np.diagonal(graph.step_covariance[last:], axis1=1, axis2=2)
        travelled = nodes[last + 1 :, :2] - nodes[-1, :2]
        own = since.sum(0) + np.array([1.0, 1.0, 0.0]) * (since[:, 2] @ (travelled**2).sum(1))
        for k in np.flatnonzero(starts < window):
            start = int(starts[k])
            key = int(np.searchsorted(self.frames, frames[start]))
            if self.frames[key] != frames[start]:
                continue
            covariance = np.zeros((6, 6))
            which = slice(0, 6) if key else slice(3, 6)
            covariance[which, which] = self.information.covariance([key, end] if key else [end])
            x, y = nodes[last, :2] - nodes[start, :2]
            jacobian = np.hstack((np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]]), -np.eye(3)))
            drift = np.diagonal(jacobian @ covariance @ jacobian.T)
            limits[k] = _MOST_DRIFT * (scale * drift + own)
        return limits

    def state(self) -> Arrays:
        """The same as arrays, for ``from_state``."""
        own = {"frames": self.frames}
        return own if self.information is None else own | under("information", self.information.state())

    @classmethod
    def from_state(cls, arrays: Arrays) -> "SolvedGraph":
        """Take a ``state()``; raises ``StateError``."""
        information = part(arrays, "information")
        return cls(
            taken(arrays, "frames", np.int64, -1),
            FactorisedInformation.from_state(information) if information else None,
        )
