"""The chain of nodes that every pose graph has: their poses, the frames behind them, the newest one's covariance.

Node 0 is the first frame, the origin of ``map``. Frames follow the last node by odometry.
"""

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require, require_ascending
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import compose, propagated
from ngo_estimator.graph.frames import Frames


class NodeChain:
    """Owns the poses of all nodes and of all frames, and the covariance of the newest."""

    SAVED: tuple[str, ...] = ("frames", "_poses", "_since", "_end", "_moved", "_before")

    def __init__(self) -> None:
        self.frames = Frames()
        """All of them by odometry, and which of them are nodes."""
        self._poses = GrowingRows((3,), np.float64)
        self._poses.append(np.zeros(3))
        self._since = np.zeros((3, 3))  # covariance of the newest frame, seen from the last node
        self._end = np.zeros((3, 3))  # covariance of the last node in the map
        self._moved = np.zeros(0, np.int64)  # nodes that the last ``move`` moved, with their poses before
        self._before = np.zeros((0, 3))

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def poses(self) -> np.ndarray:
        """Poses of the nodes in the map ``(nodes, 3)``, without a copy."""
        return self._poses.values

    @property
    def end(self) -> np.ndarray:
        """Covariance ``(3, 3)`` of the last node."""
        return self._end

    @property
    def largest_move_m(self) -> float:
        """How far the last ``move`` moved a node at most."""
        moved = self.poses[self._moved, :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    def append(self, relative: np.ndarray, covariance: np.ndarray, joins: bool = False) -> None:
        """Take a step ``(3,)`` to the next frame with its covariance ``(3, 3)``.

        With ``joins`` another odometry goes on from there, in another place.
        """
        self.frames.append(relative, joins)
        self._since = propagated(self._since, self.frames.since_node, relative, covariance)

    @property
    def since_covariance(self) -> np.ndarray:
        """Covariance ``(3, 3)`` of the newest frame, seen from the last node."""
        return self._since

    def add_node(self, covariance: np.ndarray | None = None) -> np.ndarray:
        """Make the newest frame a node; returns its pose ``(3,)``, seen from the node before.

        ``covariance`` ``(3, 3)`` is of that pose; by default that of all steps between.
        """
        since = self.frames.since_node
        pose = compose(self.poses[-1], since)
        self._end = propagated(self._end, pose, since, self._since if covariance is None else covariance)
        self._poses.append(pose)
        self.frames.add_node()
        self._since = np.zeros((3, 3))
        return since

    def move(self, nodes: np.ndarray, poses: np.ndarray, end: np.ndarray) -> None:
        """Put nodes ``(n,)``, ascending, at other poses ``(n, 3)``; the last node has the covariance ``end``."""
        self._moved, self._before = nodes, self.poses.take(nodes, axis=0)
        self.poses[nodes] = poses
        self._end = end

    def let_go(self, keep: np.ndarray) -> None:
        """Let go of the nodes that are not among ``keep`` ``(nodes,)``; the first and the last are. No frame moves."""
        self.frames.thin(keep, self.frame_poses())
        left, number = keep[self._moved], np.cumsum(keep) - 1
        self._moved, self._before = number[self._moved[left]], self._before[left]
        self._poses.set(self.poses[keep])

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame, behind the last node by odometry, and its covariance ``(3, 3)``."""
        since = self.frames.since_node
        pose = compose(self.poses[-1], since)
        return pose, propagated(self._end, pose, since, self._since)

    def node_poses(self, before: bool = False) -> np.ndarray:
        """Poses of all nodes ``(nodes, 3)``, as they are or as they were before the last ``move``."""
        nodes: np.ndarray = self.poses.copy()
        if before and len(self._moved):  # nodes that came since follow the last of those
            last = self._moved[-1]
            since = se2.between(nodes[last], nodes[last:])
            nodes[self._moved] = self._before
            nodes[last:] = se2.compose(self._before[-1], since)
        return nodes

    def frame_poses(self, before: bool = False, nodes: np.ndarray | None = None) -> np.ndarray:
        """Poses of all frames ``(frames, 3)``, as they are or as they were before the last ``move``.

        With ``nodes`` ``(nodes, 3)`` these are the poses of the nodes.
        """
        return self.frames.poses(self.node_poses(before) if nodes is None else nodes)

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        nodes = len(self)
        require(
            nodes == len(self.frames.nodes) and len(self._moved) == len(self._before),
            f"there are not {nodes} nodes, or others than those that moved",
        )
        require_ascending(self._moved, "moved", nodes)
