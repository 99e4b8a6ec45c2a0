"""The chain of key scans: nodes by motion, the steps between them, and the frames that follow them by odometry.

Node ``k`` is the pose of key scan ``k``; node 0, the first frame, is the origin of ``map``. A robot that stands adds no
node.
"""

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.geometry.planar_motion import compose, propagated
from ngo_estimator.graph.frames import Frames
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.sparsification import largest_variances


class KeyScanChain:
    """Owns the poses of all key scans and of all frames, and the covariance of the newest.

    ``floor`` ``(3, 3)`` is added to each step's covariance.
    """

    def __init__(self, floor: np.ndarray) -> None:
        self._floor = floor
        self._frames = Frames()
        self._nodes = GrowingRows((3,), np.float64)
        self._steps = GrowingRows((3,), np.float64)
        self._step_covariance = GrowingRows((3, 3), np.float64)  # for the optimisation
        self._published_covariance = GrowingRows((3, 3), np.float64)
        self._step_variance = GrowingRows((), np.float64)  # the largest of each
        self._key_stamp_ns = 0
        self._since = np.zeros((3, 3))  # covariance of the newest frame, seen from the last node
        self._end = np.zeros((3, 3))  # covariance of the last node in the map
        self._before = np.zeros((0, 3))  # poses of the nodes before the last ``move``

    def __len__(self) -> int:
        return len(self._nodes)

    @property
    def nodes(self) -> np.ndarray:
        """Poses of the nodes ``(keys, 3)``, without a copy."""
        return self._nodes.values

    @property
    def frames(self) -> np.ndarray:
        """The frames that are nodes ``(keys,)``."""
        return self._frames.nodes

    @property
    def edges(self) -> np.ndarray:
        """The nodes ``(keys - 1, 2)`` that the steps join."""
        chain = np.arange(len(self) - 1)
        return np.stack((chain, chain + 1), axis=1)

    @property
    def step_covariance(self) -> np.ndarray:
        """Covariance of each step ``(keys - 1, 3, 3)``."""
        return self._step_covariance.values

    @property
    def step_variance(self) -> np.ndarray:
        """Largest variance of each step ``(keys - 1,)``; see ``largest_variances``."""
        return self._step_variance.values

    @property
    def steps(self) -> RelativePoses:
        """The steps from each node to the next."""
        return RelativePoses.of_covariances(self.edges, self._steps.values, self._step_covariance.values)

    @property
    def published_steps(self) -> RelativePoses:
        """The same with covariances as they are published."""
        return RelativePoses.of_covariances(self.edges, self._steps.values, self._published_covariance.values)

    @property
    def end(self) -> np.ndarray:
        """Covariance ``(3, 3)`` of the last node."""
        return self._end

    @property
    def largest_move_m(self) -> float:
        """How far the last ``move`` moved a node at most."""
        moved = self._nodes.values[: len(self._before), :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    def begin_at(self, stamp_ns: int) -> None:
        """Take the first frame, which is a node."""
        self._nodes.append(np.zeros(3))
        self._key_stamp_ns = stamp_ns

    def append(self, relative: np.ndarray, covariance: np.ndarray, joins: bool) -> None:
        """Take a step ``(3,)`` to the next frame with its covariance ``(3, 3)``; see ``ScanGraph.append``."""
        self._frames.append(relative, joins)
        self._since = propagated(self._since, self._frames.since_node, relative, covariance)

    def append_node(self, key: KeyScanStep, joins: bool) -> None:
        """Make the newest frame, which ends at a key scan, a node."""
        if key.from_key_stamp_ns == self._key_stamp_ns and not joins:
            # Registration in the same key scans: errors of the steps between do not add up.
            covariance = bounded(key.covariance)
            published = covariance * np.outer(key.factors, key.factors)
        else:
            covariance = published = bounded(self._since)
        covariance, published = covariance + self._floor, published + self._floor
        since = self._frames.since_node
        self._steps.append(since)
        self._step_covariance.append(covariance)
        self._step_variance.append(largest_variances(covariance[None])[0])
        self._published_covariance.append(published)
        pose = compose(self._nodes.values[-1], since)
        self._end = propagated(self._end, pose, since, published)
        self._nodes.append(pose)
        self._frames.add_node()
        self._key_stamp_ns = key.scan.stamp_ns
        self._since = np.zeros((3, 3))

    def move(self, nodes: np.ndarray, end: np.ndarray) -> None:
        """Put all nodes at other poses ``(keys, 3)``, the last with covariance ``end`` ``(3, 3)``."""
        self._before = self._nodes.values.copy()
        self._nodes.values[:] = nodes
        self._end = end

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame, behind the last node by odometry, and its covariance ``(3, 3)``."""
        since = self._frames.since_node
        pose = compose(self._nodes.values[-1], since)
        return pose, propagated(self._end, pose, since, self._since)

    def frame_poses(self, before: bool, nodes: np.ndarray | None) -> np.ndarray:
        """Poses of all frames ``(frames, 3)``, as they are or as they were before the last ``move``.

        With ``nodes`` ``(nodes, 3)`` these are the poses of the nodes.
        """
        nodes = (self._nodes.values if nodes is None else nodes).copy()
        if before:  # nodes that came since follow the last of those
            last = len(self._before) - 1
            since = se2.between(nodes[last], nodes[last:])
            nodes[: last + 1] = self._before
            nodes[last:] = se2.compose(self._before[-1], since)
        return self._frames.poses(nodes)

    SAVED = (
        "_frames", "_nodes", "_steps", "_step_covariance", "_published_covariance",
        "_step_variance", "_key_stamp_ns", "_since", "_end", "_before",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        keys = len(self)
        of_steps = (self._steps, self._step_covariance, self._published_covariance, self._step_variance)
        require(
            keys > 0 and len(self.frames) == keys and {len(rows) for rows in of_steps} == {keys - 1},
            f"there are not {keys} key scans, and a step less",
        )
        require(len(self._before) <= keys, "nodes were moved that are not there")
