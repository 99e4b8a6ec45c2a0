"""Several robots in one map: each has a stream of steps, and all of them one graph (no ROS here).

A stream is what one start of a robot's odometry gives. The first robot's map is the map of all. Another robot, or one
that starts anew, begins a segment that nobody has measured: it has a map of its own until the search in the own map
finds where it is, as for a robot that was carried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ngo_estimator.data.relative_step import RESTART_AFTER_NS, DuplicateStep, LateStep, RelativeStep
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.geometry.planar_motion import between, compose, propagated, turned_covariance
from ngo_estimator.geometry.se2 import between as between_all
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from ngo_estimator.trajectory.g2o import PlanarGraph

_MOST_WAITING = 100
"""Steps without a key scan that wait until their robot's next key scan, at most."""


@dataclass(frozen=True)
class FleetUpdate:
    """What a step of one robot changed.

    ``update`` has the robot's pose in its map. ``map_of`` is the robot whose own map that is, None where it is the one
    of all. ``begins``: the robot's odometry began with this step.
    """

    update: TrajectoryUpdate
    map_of: str | None
    begins: bool


@dataclass
class _Stream:
    """Of one start of a robot's odometry: where it is, and steps that the graph does not have yet."""

    rank: int
    origin_stamp_ns: int
    stamp_ns: int
    odom_xyyaw: np.ndarray  # of the newest frame in the graph
    waiting: list[RelativeStep] = field(default_factory=list)


class Fleet:
    """Takes the steps of several robots into one trajectory, in the order in which they come.

    A robot's steps are in their order. Those of different robots may come late, their clocks may differ, and a robot
    may be silent for as long as it likes.

    Args:
        core: the trajectory, without a frame.
        robots: their names; the first one's map is the map of all.
    """

    def __init__(self, core: ScanTrajectory, robots: Sequence[str]) -> None:
        if len(set(robots)) != len(robots) or not robots:
            raise ValueError(f"robots are {list(robots)}; expected one or more different names")
        self.core, self.robots = core, tuple(robots)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.core.reset()
        self._streams: dict[str, _Stream] = {}
        self._starts: dict[str, list[int]] = {robot: [] for robot in self.robots}  # ranks of all its streams
        self._common = 0  # rank of the stream with which the map of all begins

    def update(self, robot: str, step: RelativeStep, optimize: bool = True) -> FleetUpdate:
        """Take the next step of a robot.

        A step without a key scan waits for one if another robot was the last to have one: it is answered by odometry.

        Raises:
            RejectedStep: as of ``ScanTrajectory.update``; a robot begins without a key scan.
        """
        stream = self._streams.get(robot)
        step = self.core.back_end.checked(step)
        begins = stream is None or _restarted(stream, step)
        if stream is not None and not begins:
            _check_later(stream, step)
            if self._waits(stream, step):
                stream.waiting.append(step)
                stream.stamp_ns = step.stamp_ns
                update = replace(self.core.newest(), optimized=False, largest_move_m=0.0)
                return FleetUpdate(self._placed(robot, step, update), self.map_of(robot), begins=False)
            self._take_waiting(stream, optimize)
            begins = self.core.begins_anew(step)
        if stream is None or begins:
            update = self._begin(robot, step, optimize)
        else:
            stream.stamp_ns, stream.odom_xyyaw = step.stamp_ns, step.odom_xyyaw
            update = self.core.update(step, optimize)
        return FleetUpdate(self._placed(robot, step, update), self.map_of(robot), begins)

    def _begin(self, robot: str, step: RelativeStep, optimize: bool) -> TrajectoryUpdate:
        before = self._streams.get(robot)
        if before is not None:
            self._take_waiting(before, optimize)
            if self._has_hardly_begun(robot) and len(self.core.back_end.graph.ranks) == 1:
                self.reset()
        rank = self._new_rank(robot)
        update = self.core.begin_stream(step, rank, before is not None, optimize)
        self._common = min(self._common, rank)
        self._starts[robot].append(rank)
        self._streams[robot] = _Stream(rank, step.origin_stamp_ns, step.stamp_ns, step.odom_xyyaw)
        return update

    def _new_rank(self, robot: str) -> int:
        """That of the stream with which the map of all begins is the lowest."""
        if not self._starts[robot]:
            return self.robots.index(robot)
        count = len(self.robots) + sum(map(len, self._starts.values()))
        return self._common - 1 if self._has_hardly_begun(robot) else count

    def _has_hardly_begun(self, robot: str) -> bool:
        """Whether the map of all shows too little to find anybody in it, and only its owner ``robot`` was there.

        Then it begins with the robot's next start, or nobody would ever be in it again.
        """
        back_end, graph = self.core.back_end, self.core.back_end.graph
        if robot != self.robots[0] or not self._starts[robot]:
            return False
        begin = int(graph.streams[graph.ranks == self._common][0])
        keys = int((back_end.places(np.arange(len(graph)))[1] == begin).sum())
        others = [begins for name, begins in zip(self._streams, self._places()[1], strict=True) if name != robot]
        return keys < back_end.config.loops.submap_keys and begin not in others

    def _waits(self, stream: _Stream, step: RelativeStep) -> bool:
        is_last = int(self.core.back_end.graph.ranks[-1]) == stream.rank
        return not is_last and step.key is None and len(stream.waiting) < _MOST_WAITING

    def _take_waiting(self, stream: _Stream, optimize: bool) -> None:
        """Take the steps of a robot that wait, and let its next one follow them."""
        self.core.go_on_with(stream.rank)
        for step in stream.waiting:
            if not self.core.begins_anew(step):  # it went impossibly far: the next one begins anew
                self.core.update(step, optimize)
                stream.odom_xyyaw = step.odom_xyyaw
        stream.waiting.clear()

    def correct(self) -> bool:
        """Do the work that the newest step made due; returns whether poses have changed."""
        update = self.core.correct()
        return update is not None and update.optimized

    def finish(self) -> bool:
        """Optimise what is left, when no more steps come; returns whether poses have changed."""
        return self.core.finish() is not None

    def again(self, robot: str, last: FleetUpdate) -> FleetUpdate:
        """A robot's ``last`` update as it would be now."""
        pose, covariance = self.pose(robot)
        odom = compose(between(last.update.map_from_odom_xyyaw, np.zeros(3)), last.update.pose_xyyaw)
        return FleetUpdate(self._at(last.update, pose, covariance, odom), self.map_of(robot), begins=False)

    def map_of(self, robot: str) -> str | None:
        """The robot whose own map this robot is in, the first of those that are there; None: in the map of all."""
        parts, begins = self._places()
        graph = self.core.back_end.graph
        own = list(self._streams).index(robot)
        if begins[own] in graph.streams[graph.ranks == self._common]:
            return None
        there = [name for name, part in zip(self._streams, parts, strict=True) if part == parts[own]]
        return min(there, key=self.robots.index)

    def _places(self) -> tuple[np.ndarray, np.ndarray]:
        """The part of the map in which each robot is, and where that begins; in the order of ``_streams``."""
        graph = self.core.back_end.graph
        ends = dict(zip(graph.ranks.tolist(), graph.stream_ends.tolist(), strict=True))
        return self.core.back_end.places(np.array([ends[stream.rank] for stream in self._streams.values()]))

    def _begin_pose(self, robot: str) -> np.ndarray:
        """Where the robot's map begins in the graph ``(3,)``."""
        begins = self._places()[1]
        pose: np.ndarray = self.core.back_end.graph.poses[begins[list(self._streams).index(robot)]]
        return pose

    def _placed(self, robot: str, step: RelativeStep, update: TrajectoryUpdate) -> TrajectoryUpdate:
        """What an update says, with the robot's newest pose in its map."""
        at = self._at(update, *self.pose(robot), step.tf_odom_xyyaw)
        return replace(at, stamp_ns=step.stamp_ns)

    @staticmethod
    def _at(update: TrajectoryUpdate, pose: np.ndarray, covariance: np.ndarray, odom: np.ndarray) -> TrajectoryUpdate:
        """An update with another pose, whose robot is at ``odom`` ``(3,)`` on TF."""
        map_from_odom = compose(pose, between(odom, np.zeros(3)))
        return replace(
            update,
            pose_xyyaw=pose,
            covariance=0.5 * (covariance + covariance.T),
            map_from_odom_xyyaw=map_from_odom,
            restarted=False,
            lost_since_ns=None,
        )

    def pose(self, robot: str) -> tuple[np.ndarray, np.ndarray]:
        """A robot's newest pose ``(3,)`` in its map, and its covariance ``(3, 3)`` there."""
        stream, begin = self._streams[robot], self._begin_pose(robot)
        pose, covariance = self.core.back_end.graph.newest_of(stream.rank)
        odom = stream.odom_xyyaw
        for step in stream.waiting:
            since = between(odom, step.odom_xyyaw)
            covariance = propagated(covariance, compose(pose, since), since, bounded(step.covariance))
            pose, odom = compose(pose, since), step.odom_xyyaw
        return between(begin, pose), turned_covariance(-float(begin[2]), covariance)

    def walls(self, robot: str, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all robots' key scans in the map in which a robot is, thinned to about ``most``."""
        points = self.core.walls(most)
        at = np.column_stack((points, np.zeros(len(points))))
        return np.asarray(between_all(self._begin_pose(robot), at)[:, :2])

    def planar_graph(self) -> PlanarGraph | None:
        """The graph of all robots, in the map of all; None before the first step.

        A robot that is not in that map lies anywhere: the step to it says next to nothing.
        """
        graph, nodes = self.core.planar_graph(), self.core.back_end.graph
        begin = nodes.streams[nodes.ranks == self._common]
        if graph is None or len(begin) == 0:
            return graph
        return replace(graph, poses=between_all(graph.poses[begin[0]], graph.poses))

    def trajectory(self, robot: str) -> Trajectory | None:
        """The frames of a robot that are in the map in which it is now, in that map; None before its first step.

        Where its clock went back, the frames from there on alone. ``online_xyyaw`` is as the graph had it, in no map.
        """
        whole = self.core.trajectory() if robot in self._streams else None
        if whole is None:
            return None
        back_end = self.core.back_end
        graph, nodes = back_end.graph, back_end.graph.frames.nodes
        node = np.searchsorted(nodes, np.arange(len(whole.stamps_ns)), side="right") - 1
        parts = back_end.places(node)[0]
        here = self._places()[0][list(self._streams).index(robot)]
        ranks = graph.rank_of_frames
        rows: list[np.ndarray] = []
        for rank in reversed(self._starts[robot]):
            stream = np.flatnonzero((ranks == rank) & (parts == here))
            if rows and len(stream) and whole.stamps_ns[stream[-1]] >= whole.stamps_ns[rows[0][0]]:
                break
            rows[:0] = [stream] if len(stream) else []
        return _part_of(whole, np.concatenate(rows), self._begin_pose(robot))


def _restarted(stream: _Stream, step: RelativeStep) -> bool:
    return step.origin_stamp_ns != stream.origin_stamp_ns or step.stamp_ns <= stream.stamp_ns - RESTART_AFTER_NS


def _check_later(stream: _Stream, step: RelativeStep) -> None:
    if step.stamp_ns <= stream.stamp_ns:
        kind = DuplicateStep if step.stamp_ns == stream.stamp_ns else LateStep
        raise kind(f"step to {step.stamp_ns} ns came when the robot was at {stream.stamp_ns} ns already")


def _part_of(whole: Trajectory, frames: np.ndarray, begin: np.ndarray) -> Trajectory:
    """The trajectory of some frames ``(n,)``, poses seen from ``begin`` ``(3,)``, and the loops among them."""
    number = np.full(len(whole.stamps_ns), -1)
    number[frames] = np.arange(len(frames))
    loops = number[whole.loops]
    own = (loops >= 0).all(1)
    return Trajectory(
        whole.stamps_ns[frames],
        between_all(begin, whole.poses_xyyaw[frames]),
        whole.odometry_xyyaw[frames],
        whole.online_xyyaw[frames],
        whole.moved_m[frames],
        whole.odometry_std[frames[1:] - 1],
        loops[own],
        whole.loop_weights[own],
        whole.loop_relative_xyyaw[own],
        whole.loop_std[own],
    )
