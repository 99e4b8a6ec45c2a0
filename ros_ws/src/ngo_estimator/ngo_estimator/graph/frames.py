"""All frames of a trajectory by odometry, and those of them that are nodes of the pose graph.

A meta-pose is a node by count, a key scan one by motion: here both are frames with a number.
"""

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import between, chained, compose, frames_between_nodes


class Frames:
    """Frames in their order; the first is at the origin, and the first node."""

    SAVED = ("_odometry", "_nodes", "_joins")

    def __init__(self) -> None:
        self._odometry = GrowingRows((3,), np.float64)
        self._odometry.append(np.zeros(3))
        self._nodes = GrowingRows((), np.int64)
        self._nodes.append(0)
        self._joins = GrowingRows((), np.int64)  # frames from which on another odometry goes on

    def __len__(self) -> int:
        return len(self._odometry)

    @property
    def odometry(self) -> np.ndarray:
        """Poses of all frames by odometry ``(frames, 3)``, without a copy."""
        return self._odometry.values

    @property
    def nodes(self) -> np.ndarray:
        """The frames that are nodes ``(nodes,)``, without a copy."""
        return self._nodes.values

    @property
    def joins(self) -> np.ndarray:
        """The frames from which on another odometry goes on ``(n,)``, without a copy."""
        return self._joins.values

    @property
    def last_join(self) -> int:
        """The newest frame from which on another odometry goes on; 0 where there is none."""
        return int(self._joins.values[-1]) if len(self._joins) else 0

    @property
    def since_node(self) -> np.ndarray:
        """Pose ``(3,)`` of the newest frame, seen from the last node."""
        since: np.ndarray = between(self.odometry[self.nodes[-1]], self.odometry[-1])
        return since

    def append(self, relative: np.ndarray, joins: bool) -> None:
        """Add a frame, seen from the newest one ``(3,)``; with ``joins`` another odometry goes on from there."""
        self._odometry.append(compose(self.odometry[-1], relative.astype(np.float64)))
        if joins:
            self._joins.append(len(self) - 1)

    def part_at(self, frame: int) -> None:
        """Let another odometry go on from a frame."""
        self._joins.set(np.union1d(self.joins, (frame,)))

    def add_node(self) -> None:
        """Make the newest frame a node."""
        self._nodes.append(len(self) - 1)

    def poses(self, nodes: np.ndarray) -> np.ndarray:
        """Poses of all frames ``(frames, 3)`` where the nodes are at ``nodes`` ``(nodes, 3)``.

        What an optimisation moved two nodes against each other is spread evenly over the frames between. Where another
        odometry goes on, the motion that nobody saw is the one that is corrected.
        """
        return frames_between_nodes(nodes, self.odometry, self.nodes, self._joins.values)

    def thin(self, keep: np.ndarray, poses: np.ndarray) -> None:
        """Let go of the nodes that are not among ``keep`` ``(nodes,)``; the first and the last are.

        Frames around them stay as they lie to each other in ``poses`` ``(frames, 3)``.
        """
        frames, nodes = np.arange(len(self)), self.nodes[keep]
        # The node before each frame, and whether one that goes is between it and the next that stays.
        reached = np.maximum(np.searchsorted(nodes, frames) - 1, 0)
        bridged = np.append(np.diff(np.flatnonzero(keep)) > 1, False)
        relative = se2.between(self.odometry[nodes[reached]], self.odometry)
        own = bridged[reached]
        relative[own] = se2.between(poses[nodes[reached[own]]], poses[own])
        at = chained(relative[nodes[1:]])
        odometry = se2.compose(at[reached], relative)
        odometry[nodes] = at
        self._odometry.set(odometry)
        self._joins.set(self.joins[~own[self.joins]])
        self._nodes.set(nodes)

    def keep(self, frames: np.ndarray) -> None:
        """Let go of the frames that are not among ``frames`` ``(n,)``, ascending; all nodes and the newest one are."""
        joins = np.unique(np.searchsorted(frames, self.joins))
        self._nodes.set(np.searchsorted(frames, self.nodes))
        self._joins.set(joins)
        self._odometry.set(self.odometry[frames])

    def reorder(self, order: np.ndarray, nodes: np.ndarray) -> None:
        """Have the frames ``order`` ``(frames,)`` and the nodes ``nodes`` ``(nodes,)``, both by their old numbers, in
        this order: stretches of which each begins with a node, and with another odometry."""
        number = np.argsort(order)
        joins = np.union1d(number[self.joins], number[:1])
        self._joins.set(joins[joins > 0])
        self._nodes.set(number[self.nodes[nodes]])
        self._odometry.set(self.odometry[order])

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        frames, nodes, joins = len(self), self.nodes, self._joins.values
        require(
            len(nodes) > 0 and nodes[0] == 0 and bool((np.diff(nodes) > 0).all()) and bool(nodes[-1] < frames),
            "nodes are frames that are not there",
        )
        require(
            bool((joins > 0).all() and (joins < frames).all()), "another odometry begins at a frame that is not there"
        )
