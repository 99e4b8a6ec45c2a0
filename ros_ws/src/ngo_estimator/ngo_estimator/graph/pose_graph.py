"""The pose graph of every sensor: nodes in a chain, and the steps from each to the next.

A meta-pose is a node by count, a key scan one by motion. Node 0 is the first frame, the origin of ``map``. Frames
between nodes hang between them (``frames``), and the newest ones follow the last node by odometry.

Several odometries may go on at once: each is a stream, and its nodes are a stretch of the chain that begins a segment.
The stream whose frame comes next is the last stretch (``go_on_with``), so that the newest node is the last one.
"""

import math

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import require, require_ascending
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import between, compose, propagated
from ngo_estimator.graph.frames import Frames
from ngo_estimator.graph.marginalisation import NeighbourTree
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.segments import segment_of
from ngo_estimator.graph.sparsification import largest_variances

OPEN = np.diag((1e4, 1e4, math.pi**2))
"""Covariance of a step that nobody measured: the robot may be anywhere, as far as a planar covariance reaches."""

_LEAST_PLACE_M = 5.0
"""Extent at least of the place where a robot may be after such a step."""


class PoseGraph:
    """Owns the poses of all nodes and of all frames, the steps between nodes, and the covariance of the newest frame.

    Args:
        floor: ``(3, 3)`` is added to the covariance of each step; by default nothing.
    """

    SAVED = (
        "frames", "_poses", "_steps", "_step_covariance", "_published_covariance", "_step_variance", "_segments",
        "_bridged", "_opens", "_since", "_end", "_before",
    )  # fmt: skip

    def __init__(self, floor: np.ndarray | None = None) -> None:
        self._floor = np.zeros((3, 3)) if floor is None else floor
        self.frames = Frames()
        """All of them by odometry, and which of them are nodes."""
        self._poses = GrowingRows((3,), np.float64)
        self._poses.append(np.zeros(3))
        self._steps = GrowingRows((3,), np.float64)
        self._step_covariance = GrowingRows((3, 3), np.float64)  # for the optimisation
        self._published_covariance = GrowingRows((3, 3), np.float64)
        self._step_variance = GrowingRows((), np.float64)  # the largest of each
        self._segments = GrowingRows((), np.int64)
        self._segments.append(0)
        self._bridged = GrowingRows((), np.int64)  # nodes to which a step leads over others that are gone
        self._opens = 0  # whether a segment begins at the next node
        self._since = np.zeros((3, 3))  # covariance of the newest frame, seen from the last node
        self._end = np.zeros((3, 3))  # covariance of the last node in the map
        self._before = np.zeros((0, 3))  # poses of the first nodes before the last ``move``, which knew no others
        self.is_shared = False
        """Whether streams of several robots may come: then a segment has a map of its own until it is joined."""
        self._ranks, self._begins = np.zeros(1, np.int64), np.zeros(1, np.int64)  # of the streams: their first frames
        self._waiting: dict[int, tuple[np.ndarray, np.ndarray, int]] = {}  # by rank, of the streams but the last

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
    def ranks(self) -> np.ndarray:
        """The rank of each stream ``(streams,)``, by which it is named, in the order of their nodes."""
        return self._ranks

    @property
    def streams(self) -> np.ndarray:
        """The nodes ``(streams,)`` with which the streams begin."""
        return np.searchsorted(self.frames.nodes, self._begins)

    @property
    def stream_ends(self) -> np.ndarray:
        """The last node of each stream ``(streams,)``."""
        return np.append(self.streams[1:] - 1, len(self) - 1)

    @property
    def rank_of_frames(self) -> np.ndarray:
        """The rank of each frame's stream ``(frames,)``."""
        return np.repeat(self._ranks, np.diff(np.append(self._begins, len(self.frames))))

    def stream_of(self, nodes: np.ndarray) -> np.ndarray:
        """The number of the stream in which each node is, an array of the shape of ``nodes``."""
        return segment_of(self.streams, nodes)

    def share(self, rank: int) -> None:
        """Let the first stream have a rank, and others come beside it."""
        self.is_shared, self._ranks = True, np.array((rank,))

    def begin_stream(self, rank: int) -> None:
        """Begin another stream with the next frame, which is to be a node, and to begin a segment."""
        self._waiting[int(self._ranks[-1])] = self._since, self._end, self._opens
        self._since, self._end, self._opens = np.zeros((3, 3)), np.zeros((3, 3)), 0
        self._ranks, self._begins = np.append(self._ranks, rank), np.append(self._begins, len(self.frames))

    def go_on_with(self, rank: int) -> tuple[np.ndarray, np.ndarray]:
        """Put a stream's nodes and frames behind all others.

        Returns:
            The old numbers of the nodes ``(nodes,)`` and of the frames ``(frames,)`` in their new order.
        """
        stream = int(np.flatnonzero(self._ranks == rank)[0])
        order, frames = _to_end(self.streams, stream, len(self)), _to_end(self._begins, stream, len(self.frames))
        number, last = np.argsort(order), int(self._ranks[-1])
        self._begins = np.sort(np.argsort(frames)[self._begins])
        self._ranks = np.append(np.delete(self._ranks, stream), rank)
        self.frames.reorder(frames, order)
        self._poses.set(self.poses[order])
        # Of the step to each node; nobody measured those to the first of a stream.
        for rows, first in (
            (self._steps, np.zeros(3)),
            (self._step_covariance, OPEN),
            (self._published_covariance, OPEN),
            (self._step_variance, largest_variances(OPEN[None])[0]),
        ):
            rows.set(np.concatenate((np.asarray(first)[None], rows.values))[order][1:])
        self._segments.set(np.sort(number[self.segments]))
        self._bridged.set(np.sort(number[self._bridged.values]))
        self._before = np.zeros((0, 3))
        self._waiting[last] = self._since, self._end, self._opens
        self._since, self._end, self._opens = self._waiting.pop(rank)
        return order, frames

    @property
    def largest_move_m(self) -> float:
        """How far the last ``move`` moved a node at most."""
        moved = self.poses[: len(self._before), :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    @property
    def unmoved(self) -> int:
        """How many nodes came since the last ``move``."""
        return len(self) - max(1, len(self._before))

    @property
    def since_covariance(self) -> np.ndarray:
        """Covariance ``(3, 3)`` of the newest frame, seen from the last node."""
        return self._since

    def append(self, relative: np.ndarray, covariance: np.ndarray, joins: bool = False) -> None:
        """Take a step ``(3,)`` to the next frame with its covariance ``(3, 3)``.

        With ``joins`` another odometry goes on from there, in another place.
        """
        self.frames.append(relative, joins)
        self._since = propagated(self._since, self.frames.since_node, relative, covariance)

    def open_segment(self) -> None:
        """Begin a segment with the next node."""
        self._opens = 1

    def add_node(self, covariance: np.ndarray | None = None, published: np.ndarray | None = None) -> None:
        """Make the newest frame a node.

        Args:
            covariance: ``(3, 3)`` of its pose, seen from the node before; by default that of all steps between.
            published: the same as it is published, by default the same.
        """
        covariance = self._since if covariance is None else covariance
        published = (covariance if published is None else published) + self._floor
        covariance = covariance + self._floor
        begins_map = bool(self._opens) and self.is_shared
        if self._opens:
            covariance = published = OPEN
            self._segments.append(len(self))
            self._opens = 0
        since = self.frames.since_node
        pose = compose(self.poses[-1], since)
        self._end = np.zeros((3, 3)) if begins_map else propagated(self._end, pose, since, published)
        self._poses.append(pose)
        self.frames.add_node()
        self._steps.append(since)
        self._step_covariance.append(covariance)
        self._published_covariance.append(published)
        self._step_variance.append(largest_variances(covariance[None])[0])
        self._since = np.zeros((3, 3))

    @property
    def edges(self) -> np.ndarray:
        """The nodes ``(nodes - 1, 2)`` that the steps join."""
        chain = np.arange(len(self) - 1)
        return np.stack((chain, chain + 1), axis=1)

    @property
    def relative(self) -> np.ndarray:
        """The steps ``(nodes - 1, 3)``: each node seen from the one before."""
        return self._steps.values

    @property
    def step_covariance(self) -> np.ndarray:
        """Covariance of each step ``(nodes - 1, 3, 3)``."""
        return self._step_covariance.values

    @property
    def published_covariance(self) -> np.ndarray:
        """The same as it is published."""
        return self._published_covariance.values

    @property
    def step_variance(self) -> np.ndarray:
        """Largest variance of each step ``(nodes - 1,)``; see ``largest_variances``."""
        return self._step_variance.values

    @property
    def steps(self) -> RelativePoses:
        """The steps from each node to the next; those that nobody measured lead anywhere in the place."""
        return self.steps_at(self.poses)

    def steps_at(self, poses: np.ndarray) -> RelativePoses:
        """The same where the nodes are at other poses ``(nodes, 3)``: from there steps that nobody measured go on."""
        opens = self.segments[1:] - 1
        if len(opens) == 0:
            return RelativePoses.of_covariances(self.edges, self.relative, self.step_covariance)
        relative, covariance = self.relative.copy(), self.step_covariance.copy()
        relative[opens] = se2.between(poses[opens], poses[opens + 1])
        # The Gaussian that is as high as an even density over the square around all poses.
        extent = max(float(np.ptp(poses[:, :2], axis=0).max()), _LEAST_PLACE_M)
        covariance[opens] = np.diag((extent**2 / math.tau, extent**2 / math.tau, math.tau))
        return RelativePoses.of_covariances(self.edges, relative, covariance)

    @property
    def published_steps(self) -> RelativePoses:
        """The same with covariances as they are published."""
        return RelativePoses.of_covariances(self.edges, self.relative, self.published_covariance)

    def restate(self, first: int, relative: np.ndarray, variance: np.ndarray) -> None:
        """Have other steps ``(n, 3)`` from the node ``first`` on; their components err independently, with ``variance``
        ``(n, 3)``."""
        rows, covariance = slice(first, first + len(relative)), variance[:, :, None] * np.eye(3)
        self.relative[rows] = relative
        self.step_covariance[rows] = self.published_covariance[rows] = covariance
        self.step_variance[rows] = largest_variances(covariance)

    @property
    def segments(self) -> np.ndarray:
        """The nodes ``(segments,)`` with which a segment begins: nobody measured the step to it."""
        return self._segments.values

    @property
    def borders(self) -> np.ndarray:
        """The nodes ``(n,)`` from which on scans do not lie together with those before: nobody measured the step there,
        or nodes before them are gone."""
        return np.union1d(self.segments, self._bridged.values)

    @property
    def ends_of_segments(self) -> np.ndarray:
        """The nodes ``(n,)`` between which nobody measured a step, and the last one: they stay."""
        return np.concatenate((self.segments, self.segments[1:] - 1, [len(self) - 1]))

    @property
    def segment_frames(self) -> np.ndarray:
        """The frames ``(n,)`` with which a segment begins, but the first: before its first node, or that one."""
        joins, nodes = self.frames.joins, self.frames.nodes
        first = np.searchsorted(joins, nodes[self.segments[1:] - 1], side="right")
        return joins[first]

    def part_at(self, node: int) -> None:
        """Begin a segment with an earlier node: what the step to it said turned out to be wrong."""
        self.step_covariance[node - 1] = self.published_covariance[node - 1] = OPEN
        self.step_variance[node - 1] = largest_variances(OPEN[None])[0]
        self._segments.set(np.union1d(self.segments, (node,)))
        self.frames.part_at(int(self.frames.nodes[node]))
        self._end = self._end + OPEN

    def move(self, poses: np.ndarray, *ends: np.ndarray) -> None:
        """Put the nodes at other poses ``(nodes, 3)``; the last one of each stream has the covariance ``ends``."""
        self._before = self.poses.copy()
        self.poses[:] = poses
        *others, self._end = ends
        for rank, end in zip(self._ranks[:-1].tolist(), others, strict=True):
            since, _, opens = self._waiting[rank]
            self._waiting[rank] = since, end, opens

    def let_go(self, keep: np.ndarray, bridges: NeighbourTree | None = None) -> None:
        """Let go of the nodes that are not among ``keep`` ``(nodes,)``; the first and the last are. No frame moves.

        ``bridges`` are the steps over the gaps, in their order; by default, errors of the steps there add up.
        """
        kept = np.flatnonzero(keep)
        gaps, rows = np.diff(kept) > 1, kept[1:] - 1
        given, published = self.step_covariance, self.published_covariance
        # By how much deviations are larger as they are published, over each gap.
        sums = [np.add.reduceat(np.diagonal(of, axis1=1, axis2=2), kept[:-1], axis=0) for of in (published, given)]
        factors = np.sqrt(sums[0] / sums[1])[gaps]
        if bridges is None:
            over, covariance = (of[gaps] for of in _summed(self.poses, given, kept))
        else:
            over, covariance = bridges.relative, bridges.covariance
        steps, given, published = self.relative[rows], given[rows], published[rows]
        steps[gaps], given[gaps] = over, covariance + self._floor
        published[gaps] = covariance * factors[:, :, None] * factors[:, None, :] + self._floor
        number = np.cumsum(keep) - 1
        before = self._bridged.values
        self.frames.thin(keep, self.frame_poses())
        self._before = self._before[keep[: len(self._before)]]
        self._poses.set(self.poses[keep])
        self._steps.set(steps)
        self._step_covariance.set(given)
        self._published_covariance.set(published)
        self._step_variance.set(largest_variances(given))
        self._segments.set(number[self.segments])
        self._bridged.set(np.union1d(number[before[keep[before]]], np.flatnonzero(gaps) + 1))

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame, behind the last node by odometry, and its covariance ``(3, 3)``."""
        since = self.frames.since_node
        pose = compose(self.poses[-1], since)
        return pose, propagated(self._end, pose, since, self._since)

    def newest_of(self, rank: int) -> tuple[np.ndarray, np.ndarray]:
        """The same of the newest frame of a stream."""
        stream = int(np.flatnonzero(self._ranks == rank)[0])
        if stream == len(self._ranks) - 1:
            return self.newest()
        node, odometry = self.stream_ends[stream], self.frames.odometry
        since = between(odometry[self.frames.nodes[node]], odometry[self._begins[stream + 1] - 1])
        since_covariance, end, _ = self._waiting[rank]
        pose = compose(self.poses[node], since)
        return pose, propagated(end, pose, since, since_covariance)

    def node_poses(self, before: bool = False) -> np.ndarray:
        """Poses of all nodes ``(nodes, 3)``, as they are or as they were before the last ``move``."""
        nodes: np.ndarray = self.poses.copy()
        if before and len(self._before):  # nodes that came since follow the last of those
            last = len(self._before) - 1
            since = se2.between(nodes[last], nodes[last:])
            nodes[:last] = self._before[:-1]
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
            nodes == len(self.frames.nodes) and len(self._before) <= nodes,
            f"there are not {nodes} nodes, or more of them that moved",
        )
        of_steps = (self._steps, self._step_covariance, self._published_covariance, self._step_variance)
        require({len(rows) for rows in of_steps} == {nodes - 1}, f"there are not {nodes} nodes, and a step less")
        require_ascending(self.segments, "_segments", nodes)
        require_ascending(self._bridged.values, "_bridged", nodes)
        require(len(self.segments) > 0 and self.segments[0] == 0, "no segment begins at the first node")


def _to_end(begins: np.ndarray, which: int, count: int) -> np.ndarray:
    """Old numbers of ``count`` rows in their new order: those of one of the stretches that ``begins`` come last."""
    first, after = np.append(begins, count)[which : which + 2]
    rows = np.arange(count)
    return np.concatenate((rows[:first], rows[after:], rows[first:after]))


def _summed(poses: np.ndarray, covariance: np.ndarray, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of nodes that are kept ``(n,)`` each but the first, seen from the one before ``(n - 1, 3)``, and its covariance.

    Errors of the steps between, of ``covariance`` ``(nodes - 1, 3, 3)``, add up; one of the heading swings all behind.
    """
    start, end = poses[kept[:-1]], poses[kept[1:]]
    segment = np.repeat(np.arange(len(start)), np.diff(kept))
    turned = poses[:-1, 2] - start[segment, 2]
    lever = se2.rotate(-start[segment, 2], end[segment, :2] - poses[1:, :2])
    jacobian = np.tile(np.eye(3), (len(segment), 1, 1))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = np.cos(turned)
    jacobian[:, 1, 0], jacobian[:, 0, 1] = np.sin(turned), -np.sin(turned)
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -lever[:, 1], lever[:, 0]
    terms = jacobian @ covariance @ jacobian.mT
    return se2.between(start, end), np.add.reduceat(terms, kept[:-1], axis=0)
