"""The chain of key scans: nodes by motion, and the steps between them. A robot that stands adds no node."""

import math

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require, require_ascending
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.graph.marginalisation import NeighbourTree
from ngo_estimator.graph.node_chain import NodeChain
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.sparsification import largest_variances

OPEN = np.diag((1e4, 1e4, math.pi**2))
"""Covariance of a step that nobody measured: the robot may be anywhere, as far as a planar covariance reaches."""

_LEAST_PLACE_M = 5.0
"""Extent at least of the place where a robot may be after such a step."""


class KeyScanChain(NodeChain):
    """Nodes that are key scans, with their steps. ``floor`` ``(3, 3)`` is added to the covariance of each step."""

    def __init__(self, floor: np.ndarray) -> None:
        super().__init__()
        self._floor = floor
        self._steps = GrowingRows((3,), np.float64)
        self._step_covariance = GrowingRows((3, 3), np.float64)  # for the optimisation
        self._published_covariance = GrowingRows((3, 3), np.float64)
        self._step_variance = GrowingRows((), np.float64)  # the largest of each
        self._segments = GrowingRows((), np.int64)
        self._segments.append(0)
        self._bridged = GrowingRows((), np.int64)  # nodes to which a step leads over others that are gone
        self._opens = 0  # whether a segment begins at the next node
        self._key_stamp_ns = 0

    @property
    def segments(self) -> np.ndarray:
        """The nodes ``(segments,)`` with which a segment begins: nobody measured the step to it."""
        return self._segments.values

    @property
    def last_step(self) -> np.ndarray:
        """The step ``(3,)`` to the last node."""
        step: np.ndarray = self._steps.values[-1]
        return step

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
        """The steps from each node to the next; those that nobody measured lead anywhere in the place."""
        return self.steps_at(self.poses)

    def steps_at(self, poses: np.ndarray) -> RelativePoses:
        """The same where the nodes are at other poses ``(keys, 3)``: from there steps that nobody measured go on."""
        opens = self.segments[1:] - 1
        if len(opens) == 0:
            return RelativePoses.of_covariances(self.edges, self._steps.values, self._step_covariance.values)
        relative, covariance = self._steps.values.copy(), self._step_covariance.values.copy()
        relative[opens] = se2.between(poses[opens], poses[opens + 1])
        # The Gaussian that is as high as an even density over the square around all poses.
        extent = max(float(np.ptp(poses[:, :2], axis=0).max()), _LEAST_PLACE_M)
        covariance[opens] = np.diag((extent**2 / math.tau, extent**2 / math.tau, math.tau))
        return RelativePoses.of_covariances(self.edges, relative, covariance)

    @property
    def published_steps(self) -> RelativePoses:
        """The same with covariances as they are published."""
        return RelativePoses.of_covariances(self.edges, self._steps.values, self._published_covariance.values)

    @property
    def borders(self) -> np.ndarray:
        """The nodes ``(n,)`` from which on scans do not lie together with those before: nobody measured the step there,
        or nodes before them are gone."""
        return np.union1d(self.segments, self._bridged.values)

    @property
    def ends_of_segments(self) -> np.ndarray:
        """The nodes ``(n,)`` between which nobody measured a step, and the last one: they stay."""
        return np.concatenate((self.segments, self.segments[1:] - 1, [len(self) - 1]))

    def part_at(self, node: int) -> None:
        """Begin a segment with an earlier node: what the step to it said turned out to be wrong."""
        for rows in (self._step_covariance, self._published_covariance):
            rows.values[node - 1] = OPEN
        self._step_variance.values[node - 1] = largest_variances(OPEN[None])[0]
        self._segments.set(np.union1d(self.segments, (node,)))
        self.frames.part_at(int(self.frames.nodes[node]))
        self._end = self._end + OPEN

    def bridge(self, keep: np.ndarray, bridges: NeighbourTree) -> None:
        """Let go of nodes, as ``let_go``; ``bridges`` are the steps over the gaps, in their order."""
        kept = np.flatnonzero(keep)
        gaps, rows = np.diff(kept) > 1, kept[1:] - 1
        given, published = self.step_covariance, self._published_covariance.values
        # By how much deviations are larger as they are published, over each gap.
        sums = [np.add.reduceat(np.diagonal(of, axis1=1, axis2=2), kept[:-1], axis=0) for of in (published, given)]
        factors = np.sqrt(sums[0] / sums[1])[gaps]
        steps, given, published = self._steps.values[rows], given[rows], published[rows]
        steps[gaps], given[gaps] = bridges.relative, bridges.covariance + self._floor
        published[gaps] = bridges.covariance * factors[:, :, None] * factors[:, None, :] + self._floor
        number = np.cumsum(keep) - 1
        before = self._bridged.values
        self.let_go(keep)
        self._steps.set(steps)
        self._step_covariance.set(given)
        self._published_covariance.set(published)
        self._step_variance.set(largest_variances(given))
        self._segments.set(number[self.segments])
        self._bridged.set(np.union1d(number[before[keep[before]]], np.flatnonzero(gaps) + 1))

    def begin_at(self, stamp_ns: int) -> None:
        """Take the stamp of the first frame, which is a node."""
        self._key_stamp_ns = stamp_ns

    def open_segment(self) -> None:
        """Begin a segment with the next node."""
        self._opens = 1

    def add_key(self, key: KeyScanStep, joins: bool) -> None:
        """Make the newest frame, which ends at a key scan, a node."""
        if key.from_key_stamp_ns == self._key_stamp_ns and not joins:
            # Registration in the same key scans: errors of the steps between do not add up.
            covariance = bounded(key.covariance)
            published = covariance * np.outer(key.factors, key.factors)
        else:
            covariance = published = bounded(self.since_covariance)
        covariance, published = covariance + self._floor, published + self._floor
        if self._opens:
            covariance = published = OPEN
            self._segments.append(len(self))
            self._opens = 0
        self._steps.append(self.add_node(published))
        self._step_covariance.append(covariance)
        self._step_variance.append(largest_variances(covariance[None])[0])
        self._published_covariance.append(published)
        self._key_stamp_ns = key.scan.stamp_ns

    @property
    def segment_frames(self) -> np.ndarray:
        """The frames ``(n,)`` with which a segment begins, but the first: before its first key scan, or that one."""
        joins, nodes = self.frames.joins, self.frames.nodes
        first = np.searchsorted(joins, nodes[self.segments[1:] - 1], side="right")
        return joins[first]

    def key_step(self, node: int, scan: KeyScan, from_key_stamp_ns: int) -> KeyScanStep:
        """The step to a node, as ``add_key`` took it; the one to the first node is not known."""
        if node == 0:
            return KeyScanStep(scan, from_key_stamp_ns, np.zeros(3), OPEN)
        given, published = (
            rows.values[node - 1] - self._floor for rows in (self._step_covariance, self._published_covariance)
        )
        factors = np.sqrt(np.diagonal(published) / np.diagonal(given))
        return KeyScanStep(scan, from_key_stamp_ns, self._steps.values[node - 1].copy(), given, factors)

    SAVED = (
        *NodeChain.SAVED, "_steps", "_step_covariance", "_published_covariance", "_step_variance", "_segments",
        "_bridged", "_opens", "_key_stamp_ns",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        super().check_state()
        keys = len(self)
        of_steps = (self._steps, self._step_covariance, self._published_covariance, self._step_variance)
        require({len(rows) for rows in of_steps} == {keys - 1}, f"there are not {keys} key scans, and a step less")
        require_ascending(self.segments, "_segments", keys)
        require_ascending(self._bridged.values, "_bridged", keys)
        require(len(self.segments) > 0 and self.segments[0] == 0, "no segment begins at the first key scan")
