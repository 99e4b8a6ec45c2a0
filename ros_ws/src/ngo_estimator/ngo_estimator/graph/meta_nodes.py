"""Poses of all nodes of the graph: those that are optimised, and those that move with them."""

import numpy as np
import torch

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require, require_ascending
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import all_between, between, compose
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames


class MetaNodes:
    """The nodes of a window, the key frames before it, and the nodes between key frames, which are let go."""

    def __init__(self, key_frames: int) -> None:
        self._poses = GrowingRows((3,), np.float64)
        self._poses.append(np.zeros(3))
        self.first = 0
        """Node where the window begins."""
        self.keys = KeyFrames(key_frames)
        """Those before it."""
        self._kept = np.zeros((0, 3))  # poses of key frames when some were let go last
        self._gone = np.zeros(0, np.int64)  # nodes between these
        self._moved = np.zeros(0, np.int64)  # nodes optimised last, with their poses before
        self._before = np.zeros((0, 3))

    @property
    def blocks(self) -> int:
        """Blocks between the nodes: the number of the last node."""
        return len(self._poses) - 1

    @property
    def poses(self) -> np.ndarray:
        """Of all nodes in the map ``(blocks + 1, 3)``, without a copy; nodes let go are where they were then."""
        return self._poses.values

    @property
    def active(self) -> np.ndarray:
        """Nodes that are optimised: key frames, and those of the window."""
        return np.concatenate((self.keys.nodes, np.arange(self.first, self.blocks + 1)))

    @property
    def relative(self) -> np.ndarray:
        """Poses of the active nodes ``(n, 3)`` but the first, each seen from the one before."""
        nodes = self.poses.take(self.active, axis=0)
        return all_between(nodes[:-1], nodes[1:])

    @property
    def largest_move_m(self) -> float:
        """How far ``move`` moved a node at most."""
        moved = self.poses[self._moved, :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    def append(self, relative: np.ndarray) -> None:
        """Add a node, seen from the last one ``(3,)``."""
        self._poses.append(compose(self.poses[-1], relative))

    def move(self, poses: np.ndarray) -> None:
        """Move the active nodes but the first, which is the origin, to these poses ``(n - 1, 3)``."""
        self._moved = self.active
        self._before = self.poses.take(self._moved, axis=0)
        self.poses[self._moved[1:]] = poses

    def step(self) -> np.ndarray:
        """The window's second node as seen from its first ``(3,)``."""
        return between(*self.poses[[self.first, self.first + 1]])

    def leave(self, key: KeyFrame) -> None:
        """Move the window by a block: its first node becomes this key frame."""
        self.keys.add(key)
        self.first += 1

    def thin(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Let some key frames go; each node between those that stay moves with them from now on.

        Returns:
            The key frames before ``(n,)``, which of them stay ``(n,)``, their poses and variances ``(n, 3)``.
        """
        nodes, variance = self.keys.nodes, self.keys.variance
        self.poses[:] = self.all()
        poses = self.poses[nodes]
        stay = self.keys.thin(poses)
        self._kept = poses[stay]
        inside = np.arange(self.first)
        self._gone = inside[~np.isin(inside, self.keys.nodes)]
        return nodes, stay, poses, variance

    def all(self, before: bool = False) -> np.ndarray:
        """Poses of all nodes ``(blocks + 1, 3)``, as they are or as they were before the last optimisation."""
        nodes: np.ndarray = self.poses.copy()
        if before:
            nodes[self._moved] = self._before
        if len(self._gone):
            keys = self.keys.nodes[: len(self._kept)]
            old, new = torch.from_numpy(self._kept), torch.from_numpy(nodes[keys])
            segment = np.searchsorted(keys, self._gone, side="right") - 1
            bent = se2.between(new[:-1], new[1:]) - se2.between(old[:-1], old[1:])
            bent = se2.wrapped(bent)
            share = torch.from_numpy((self._gone - keys[segment]) / (keys[segment + 1] - keys[segment]))
            relative = se2.between(old[segment], torch.from_numpy(nodes[self._gone]))
            nodes[self._gone] = se2.compose(new[segment], relative + share[:, None] * bent[segment]).numpy()
        return nodes

    SAVED = ("_poses", "first", "keys", "_kept", "_gone", "_moved", "_before")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        keys = self.keys.nodes
        for name, nodes in (("key frames", keys), ("gone", self._gone), ("active", self._moved)):
            require_ascending(nodes, name, self.blocks + 1)
        require(len(self._moved) == len(self._before), "poses of other nodes than those that moved are given")
        require(
            self.first == (keys[-1] + 1 if len(keys) else 0) and len(self._kept) <= len(keys),
            "key frames do not end where the window begins",
        )
