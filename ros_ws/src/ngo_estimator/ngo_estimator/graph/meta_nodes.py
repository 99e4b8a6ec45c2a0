"""Poses of all nodes of the graph: those that are optimised, and those that move with them."""

import numpy as np
import torch

from ngo_estimator.data.state_arrays import require, require_ascending
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import all_between, between
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames
from ngo_estimator.graph.node_chain import NodeChain


class MetaNodes(NodeChain):
    """The nodes of a window, the key frames before it, and the nodes between key frames, which are let go.

    Nodes that were let go are, among ``poses``, where they were then; ``node_poses`` has them where they are.
    """

    def __init__(self, key_frames: int) -> None:
        super().__init__()
        self.first = 0
        """Node where the window begins."""
        self.keys = KeyFrames(key_frames)
        """Those before it."""
        self._kept = np.zeros((0, 3))  # poses of key frames when some were let go last
        self._gone = np.zeros(0, np.int64)  # nodes between these

    @property
    def blocks(self) -> int:
        """Blocks between the nodes: the number of the last node."""
        return len(self) - 1

    @property
    def active(self) -> np.ndarray:
        """Nodes that are optimised: key frames, and those of the window."""
        return np.concatenate((self.keys.nodes, np.arange(self.first, self.blocks + 1)))

    @property
    def relative(self) -> np.ndarray:
        """Poses of the active nodes ``(n, 3)`` but the first, each seen from the one before."""
        nodes = self.poses.take(self.active, axis=0)
        return all_between(nodes[:-1], nodes[1:])

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
        self.poses[:] = self.node_poses()
        poses = self.poses[nodes]
        stay = self.keys.thin(poses)
        self._kept = poses[stay]
        inside = np.arange(self.first)
        self._gone = inside[~np.isin(inside, self.keys.nodes)]
        return nodes, stay, poses, variance

    def node_poses(self, before: bool = False) -> np.ndarray:
        """Poses of all nodes ``(blocks + 1, 3)``; those let go move with the key frames around them."""
        nodes = super().node_poses(before)
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

    SAVED = (*NodeChain.SAVED, "first", "keys", "_kept", "_gone")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        super().check_state()
        keys = self.keys.nodes
        for name, nodes in (("key frames", keys), ("gone", self._gone)):
            require_ascending(nodes, name, self.blocks + 1)
        require(
            self.first == (keys[-1] + 1 if len(keys) else 0) and len(self._kept) <= len(keys),
            "key frames do not end where the window begins",
        )
