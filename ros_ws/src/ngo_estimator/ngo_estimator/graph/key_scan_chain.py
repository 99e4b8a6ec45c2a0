"""The chain of key scans: nodes by motion, and the steps between them. A robot that stands adds no node."""

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.graph.node_chain import NodeChain
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.sparsification import largest_variances


class KeyScanChain(NodeChain):
    """Nodes that are key scans, with their steps. ``floor`` ``(3, 3)`` is added to the covariance of each step."""

    def __init__(self, floor: np.ndarray) -> None:
        super().__init__()
        self._floor = floor
        self._steps = GrowingRows((3,), np.float64)
        self._step_covariance = GrowingRows((3, 3), np.float64)  # for the optimisation
        self._published_covariance = GrowingRows((3, 3), np.float64)
        self._step_variance = GrowingRows((), np.float64)  # the largest of each
        self._key_stamp_ns = 0

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

    def begin_at(self, stamp_ns: int) -> None:
        """Take the stamp of the first frame, which is a node."""
        self._key_stamp_ns = stamp_ns

    def add_key(self, key: KeyScanStep, joins: bool) -> None:
        """Make the newest frame, which ends at a key scan, a node."""
        if key.from_key_stamp_ns == self._key_stamp_ns and not joins:
            # Registration in the same key scans: errors of the steps between do not add up.
            covariance = bounded(key.covariance)
            published = covariance * np.outer(key.factors, key.factors)
        else:
            covariance = published = bounded(self.since_covariance)
        covariance, published = covariance + self._floor, published + self._floor
        self._steps.append(self.add_node(published))
        self._step_covariance.append(covariance)
        self._step_variance.append(largest_variances(covariance[None])[0])
        self._published_covariance.append(published)
        self._key_stamp_ns = key.scan.stamp_ns

    SAVED = (
        *NodeChain.SAVED, "_steps", "_step_covariance", "_published_covariance", "_step_variance", "_key_stamp_ns",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        super().check_state()
        keys = len(self)
        of_steps = (self._steps, self._step_covariance, self._published_covariance, self._step_variance)
        require({len(rows) for rows in of_steps} == {keys - 1}, f"there are not {keys} key scans, and a step less")
