"""The graph of key scans behind the online trajectory of a lidar: nodes by motion, verified loops, warm starts.

Node ``k`` is the pose of key scan ``k``; node 0, the first frame, is the origin of ``map``. A robot that stands adds no
node. Frames between two nodes follow them by odometry.
"""

import math
import time
from dataclasses import dataclass, field

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import Arrays, part, require, taken, taken_integer, under
from ngo_estimator.geometry import planar_arrays
from ngo_estimator.geometry.key_scan import no_scan
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.geometry.planar_motion import between, compose, propagated, transformed
from ngo_estimator.online.key_scan_store import KeyScanStore
from ngo_estimator.online.map_origin import MapOrigin
from ngo_estimator.online.scan_matcher import ScanMatcher
from ngo_estimator.optimizer.scan_loop_candidates import WindowConfig, distance_windows, graph_distances
from ngo_estimator.optimizer.scan_loop_config import ScanLoopConfig
from ngo_estimator.optimizer.scan_loop_finder import ScanLoopFinder
from ngo_estimator.optimizer.scan_loop_thinning import WALLS_M, largest_variances, needed_loops
from ngo_estimator.optimizer.scan_loops import ScanLoops
from ngo_estimator.optimizer.scan_pose_graph import RelativePoses, ScanPoseGraph
from ngo_estimator.optimizer.ways_through_graph import way_covariances

_MOST_ITERATIONS = 30
"""Until nothing moves any more, at the end of a recording."""

_KEYS_PER_OPTIMISED = 20
"""For each so many nodes an optimisation waits for one more key scan."""

_KEYS_PER_SURPRISED = 400
"""The same where a loop surprises."""


@dataclass(frozen=True)
class ScanGraphConfig:
    """How key scans are optimised.

    An optimisation takes ``iterations`` at most, and begins once ``keys_between`` key scans came since the last one, or
    at once where a new loop is ``surprise`` deviations off the graph and ``surprise_m`` at the walls. The Cauchy kernel
    on steps and loops is ``kernel`` deviations wide. A loop is left out where a way through the graph joins its keys
    with at most ``redundant`` times its variance, unless it is that far off. Where the robot may be outside of the
    widest window, ``agreeing_beyond`` loops must agree with one. ``step_m`` and ``step_deg`` are deviations
    that are added to each step's covariance: registration in the same few key scans does not see them. About
    ``most_scans`` key scans are kept; where there are more, places that many of them show lose some. Their poses stay.
    """

    loops: ScanLoopConfig = field(default_factory=ScanLoopConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    iterations: int = 5
    keys_between: int = 8
    surprise: float = 3.0
    surprise_m: float = 0.06
    redundant: float = 15.0
    agreeing_beyond: int = 8
    kernel: float = 3.0
    step_m: float = 0.005
    step_deg: float = 0.15
    most_scans: int = 4000

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.keys_between < 1 or self.most_scans < 100 or self.agreeing_beyond < 0:
            raise ValueError(
                f"iterations, keys_between, most_scans, agreeing_beyond are {self.iterations}, {self.keys_between}, "
                f"{self.most_scans}, {self.agreeing_beyond}; expected at least 1, 1, 100 and 0"
            )
        positive = (self.surprise, self.surprise_m, self.redundant, self.kernel, self.step_m, self.step_deg)
        if not all(0.0 < value < math.inf for value in positive):
            raise ValueError(
                f"surprise, surprise_m, redundant, kernel, step_m, step_deg are {positive}; expected positive numbers"
            )


class ScanGraph:
    """Takes frames, keeps key scans and their loops, and optimises all of them together."""

    def __init__(self, config: ScanGraphConfig) -> None:
        self.config = config
        self.odometry = GrowingRows((3,), np.float64)
        """Poses of all frames by the relative poses alone, the first at the origin."""
        self.odometry.append(np.zeros(3))
        self._frames = GrowingRows((), np.int64)  # of the nodes
        self._nodes = GrowingRows((3,), np.float64)
        self._steps = GrowingRows((3,), np.float64)
        self._step_covariance = GrowingRows((3, 3), np.float64)  # for the optimisation
        self._published_covariance = GrowingRows((3, 3), np.float64)
        self._step_variance = GrowingRows((), np.float64)  # the largest of each
        self._scans = KeyScanStore()
        self._key_stamp_ns = 0
        self._finder = ScanLoopFinder(config.loops)
        self._since = np.zeros((3, 3))  # covariance of the newest frame, seen from the last node
        self._end = np.zeros((3, 3))  # covariance of the last node in the map
        self._running: ScanPoseGraph | None = None
        self._rows = np.zeros(0, np.int64)
        self._left = 0
        self._waiting = 0  # keys since the last optimisation, where there is a loop that it has not seen
        self._before = np.zeros((1, 3))
        self._joins = GrowingRows((), np.int64)  # frames from which on another odometry goes on, nodes all of them
        self._doubted = np.zeros(0, np.int64)  # accepted loops for which too few speak as yet
        self._used = GrowingRows((), np.int64)  # loops that the graph needs, among all that were verified
        self._loop_rows = np.zeros(0, np.int64)  # of the last optimisation, among all that were verified
        self.loop_weights = np.zeros(0)
        """Of the loops in the last optimisation ``(loops,)``, zero to one."""
        self.took_s = 0.0
        """Computing time of the last optimisation."""
        self.optimized = False
        """Whether an optimisation ended since the newest frame came."""
        self.fault = ""
        """What failed since the newest frame came, in words. Everything is then as it was before, but for the loops."""

    @property
    def keys(self) -> int:
        """Key scans so far."""
        return len(self._nodes)

    @property
    def running(self) -> bool:
        """Whether an optimisation has begun that is not done."""
        return self._running is not None

    @property
    def largest_move_m(self) -> float:
        """How far the last optimisation moved a node at most."""
        moved = self._nodes.values[: len(self._before), :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    def begin_at(self, step: RelativeStep) -> None:
        """Take the first frame, before the first step. Where its scan is missing, it adds no points to submaps."""
        self._scans.append(no_scan(step.from_stamp_ns) if step.origin_scan is None else step.origin_scan)
        self._frames.append(0)
        self._nodes.append(np.zeros(3))
        self._key_stamp_ns = step.from_stamp_ns

    def append(
        self, relative: np.ndarray, covariance: np.ndarray, key: KeyScanStep | None, joins: bool = False
    ) -> bool:
        """Take a step ``(3,)`` with its covariance ``(3, 3)``; returns whether it is time to optimise.

        With ``joins`` the step, which ends at a key scan, is where another odometry goes on, in another place.
        """
        self.optimized, self.fault = False, ""
        self.odometry.append(compose(self.odometry.values[-1], relative.astype(np.float64)))
        if joins:
            self._joins.append(len(self.odometry) - 1)
        since = self._since_key()
        self._since = propagated(self._since, since, relative, covariance)
        if key is None:
            return False
        if self._running is not None:  # what comes now adds a node to those that it is about
            try:
                self.advance(self._left)
            except Exception as error:  # it may cost an optimisation, and nothing else
                self.fail(error)
        known = key.from_key_stamp_ns == self._key_stamp_ns and not joins
        # Registration in the same key scans: errors of the steps between do not add up.
        if known:
            covariance = bounded(key.covariance)
            self._complete(key, since, covariance, covariance * np.outer(key.factors, key.factors))
        else:
            covariance = bounded(self._since)
            self._complete(key, since, covariance, covariance)
        try:
            return self._look_for_loops()
        except Exception as error:  # numerics of a library, or a fault of ours: it may cost loops, and nothing else
            self.fail(error, "the search for loops")
            return False

    def fail(self, error: Exception, work: str = "an optimisation") -> None:
        """Leave undone what has begun, and keep why: every node is where it was."""
        self.fault = f"{work} failed, {type(error).__name__}: {' '.join(str(error).split())}"
        self._running, self._waiting = None, 0

    def _since_key(self) -> np.ndarray:
        """Pose ``(3,)`` of the newest frame, seen from the last node."""
        since: np.ndarray = between(self.odometry.values[int(self._frames.values[-1])], self.odometry.values[-1])
        return since

    def _complete(self, key: KeyScanStep, since: np.ndarray, covariance: np.ndarray, published: np.ndarray) -> None:
        config = self.config
        floor = np.diag((config.step_m**2, config.step_m**2, math.radians(config.step_deg) ** 2))
        self._steps.append(since)
        self._step_covariance.append(covariance + floor)
        self._step_variance.append(largest_variances((covariance + floor)[None])[0])
        self._published_covariance.append(published + floor)
        pose = compose(self._nodes.values[-1], since)
        self._end = propagated(self._end, pose, since, published + floor)
        self._nodes.append(pose)
        self._frames.append(len(self.odometry) - 1)
        self._scans.append(key.scan)
        self._key_stamp_ns = key.scan.stamp_ns
        self._since = np.zeros((3, 3))

    def _look_for_loops(self) -> bool:
        """Ask for loops of the newest key; returns whether an optimisation is due."""
        # An optimisation takes longer the more nodes there are: its cost for each key must not grow.
        wait = max(self.config.keys_between, self.keys // _KEYS_PER_OPTIMISED)
        if (self.keys - 1) % self.config.loops.every == 0:
            poses, used = self._nodes.values, self.used_loops.pairs
            windows = distance_windows(self.config.windows, graph_distances(poses, used, self.keys - 1))
            fresh = self._finder.find(self._scans, poses, windows)
            self._save_memory()
            believed = self._believed(np.concatenate((self._doubted, fresh)))
            if len(believed):
                surprises = self._use(believed)
                self._waiting = max(self._waiting, wait - self.keys // _KEYS_PER_SURPRISED if surprises else 1)
        self._waiting += self._waiting > 0
        return self._waiting > wait

    def _use(self, rows: np.ndarray) -> bool:
        """Take those newly accepted loops into the graph that it needs; returns whether one surprises."""
        loops, known, config = self._finder.loops[rows], self.used_loops, self.config
        measured = RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)
        off = (measured.residuals(self._nodes.values) ** 2).sum(1)
        at_walls = np.tile(np.diag((1.0, 1.0, WALLS_M)), (len(rows), 1, 1))
        moved = (RelativePoses(loops.pairs, loops.relative, at_walls).residuals(self._nodes.values) ** 2).sum(1)
        surprising = (off > config.surprise**2) & (moved > config.surprise_m**2)
        chain = np.arange(self.keys - 1)
        needed = needed_loops(
            np.concatenate((np.stack((chain, chain + 1), axis=1), known.pairs)),
            np.concatenate((self._step_variance.values, largest_variances(known.covariance))),
            loops.pairs,
            largest_variances(loops.covariance),
            surprising,
            config.redundant,
        )
        for row in rows[needed]:
            self._used.append(row)
        return bool(surprising.any())

    def _believed(self, rows: np.ndarray) -> np.ndarray:
        """Those of the accepted loops that the graph may use; others wait for as long as more may agree with them.

        A search tells a place from others within its window. A robot that may be farther away may be in another place
        that looks alike, which was not searched: then more loops must agree.
        """
        if len(rows) == 0:
            return rows
        config, windows = self.config, self.config.windows
        loops, known = self._finder.loops[rows], self.used_loops
        chain = np.arange(self.keys - 1)
        covariance = way_covariances(
            self._nodes.values,
            np.concatenate((np.stack((chain, chain + 1), axis=1), known.pairs)),
            np.concatenate((self._step_covariance.values, known.covariance)),
            loops.pairs,
        )
        metres = windows.deviations * np.sqrt(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1])
        turn = windows.deviations * np.sqrt(covariance[:, 2, 2])
        searched = (metres <= windows.most_m) & (turn <= math.radians(windows.most_deg))
        believed = searched | (loops.agreeing >= config.agreeing_beyond)
        may_grow = loops.pairs[:, 1] >= self.keys - 1 - config.loops.neighbour_keys
        self._doubted = rows[~believed & may_grow]
        return rows[believed]

    def _save_memory(self) -> None:
        """Bound the memory of scans that the finder has seen."""
        self._scans.compact()
        most = self.config.most_scans
        if self._scans.kept > most + most // 10:
            newest = self.config.loops.submap_keys
            self._finder.forget(self._scans.forget(self._scans.kept - most, self._nodes.values, newest))

    def matcher(self, origin: MapOrigin) -> ScanMatcher:
        """Compares scans with the key scans as they are; they lie in ``map`` as ``origin`` says."""
        return ScanMatcher(
            self._scans[:], origin.poses(self._nodes.values.copy()), self._finder.views, self.config.loops
        )

    @property
    def used_loops(self) -> ScanLoops:
        """The loops that the graph needs."""
        return self._finder.loops[self._used.values]

    def measurements(self) -> tuple[RelativePoses, RelativePoses]:
        """The steps from each node to the next, and the loops that the graph needs."""
        loops = self.used_loops
        measured = RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)
        return self._chain(self._step_covariance.values), measured

    def begin(self) -> None:
        """Begin to optimise all nodes."""
        began = time.perf_counter()
        self._rows = self._used.values.copy()
        steps, measured = self.measurements()
        gates = np.ones(len(self._rows))
        self._running = ScanPoseGraph(steps, measured, gates, self._nodes.values, self.config.kernel)
        self._left = self.config.iterations
        self._waiting = 0
        self.took_s = time.perf_counter() - began

    def _chain(self, covariance: np.ndarray) -> RelativePoses:
        """The steps between the nodes, with covariances ``(keys - 1, 3, 3)``."""
        chain = np.arange(self.keys - 1)
        return RelativePoses.of_covariances(np.stack((chain, chain + 1), axis=1), self._steps.values, covariance)

    def advance(self, iterations: int) -> bool:
        """Run so many iterations of what has begun; returns whether it is done, and every node at its new pose.

        An error leaves every node where it was.
        """
        running = self._running
        if running is None:
            raise RuntimeError("no optimisation has begun")
        began = time.perf_counter()
        for _ in range(min(iterations, self._left)):
            running.iterate()
            self._left = 0 if running.converged else self._left - 1
        self.took_s += time.perf_counter() - began
        if self._left:
            return False
        end = self._end
        if self.keys > 1:
            end = running.covariance(self._chain(self._published_covariance.values), self.keys - 1)
        if not (np.isfinite(running.poses).all() and np.isfinite(end).all() and (np.diagonal(end) > 0.0).all()):
            raise ArithmeticError("poses or their covariances came out as no numbers")
        self._running = None
        self._before = self._nodes.values.copy()
        self._nodes.values[:] = running.poses
        self._loop_rows, self.loop_weights = self._rows, running.weights
        self._end, self.optimized = end, True
        return True

    def abandon(self) -> None:
        """Leave undone what has begun."""
        if self._running is not None:
            self._running, self._waiting = None, self.config.keys_between

    @property
    def unfinished(self) -> bool:
        """Whether an optimisation has begun, or a loop waits for one."""
        return self.running or self._waiting > 0

    @property
    def window_fill(self) -> float:
        """All key scans are optimised: there is no window to fill."""
        return 0.0

    def finish(self) -> bool:
        """Optimise until nothing moves any more; returns whether there was anything to optimise, and it worked."""
        self.fault = ""
        if self._running is None:
            if len(self._used) == 0:
                return False
            self.begin()
        self._left = _MOST_ITERATIONS
        return self._running is not None and self.advance(self._left)

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame, behind the last node by odometry, and its covariance ``(3, 3)``."""
        since = self._since_key()
        pose = compose(self._nodes.values[-1], since)
        return pose, propagated(self._end, pose, since, self._since)

    def frame_poses(self, before: bool = False, nodes: np.ndarray | None = None) -> np.ndarray:
        """Poses of all frames ``(frames, 3)``, as they are or as they were before the last optimisation.

        The difference between two nodes and their odometry is spread evenly over the frames between. With ``nodes``
        ``(nodes, 3)`` these are the poses of the nodes.
        """
        nodes = (self._nodes.values if nodes is None else nodes).copy()
        if before:  # nodes that came since follow the last of those
            last = len(self._before) - 1
            since = planar_arrays.between(nodes[last], nodes[last:])
            nodes[: last + 1] = self._before
            nodes[last:] = planar_arrays.compose(self._before[-1], since)
        odometry, at = self.odometry.values, self._frames.values
        starts, ends = nodes, odometry[at]
        frames = np.arange(len(odometry))
        segment = np.searchsorted(at, frames, side="right") - 1
        within = planar_arrays.between(ends[segment], odometry)
        bent = np.zeros_like(starts)
        bent[:-1] = planar_arrays.between(starts[:-1], starts[1:]) - planar_arrays.between(ends[:-1], ends[1:])
        bent[:, 2] = planar_arrays.wrap(bent[:, 2])
        share = (frames - at[segment]) / np.append(np.diff(at), 1)[segment]
        ends_at = np.append(at[1:], -1)  # the motion that nobody saw is the one that is corrected
        share[np.isin(ends_at, self._joins.values)[segment]] = 0.0
        return planar_arrays.compose(starts[segment], within + share[:, None] * bent[segment])

    def walls(self, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all key scans in the map, thinned to about ``most``."""
        every = max(1, -(-self._scans.points // most))
        parts = [
            transformed(pose, scan.points[::every]) for pose, scan in zip(self._nodes.values, self._scans, strict=True)
        ]
        return np.concatenate(parts) if parts else np.zeros((0, 2))

    def _rows_of(self) -> dict[str, GrowingRows]:
        return {
            "odometry": self.odometry,
            "frames": self._frames,
            "joins": self._joins,
            "nodes": self._nodes,
            "steps": self._steps,
            "step_covariance": self._step_covariance,
            "published_covariance": self._published_covariance,
            "step_variance": self._step_variance,
            "used": self._used,
        }

    def state(self) -> Arrays:
        """All that later steps depend on, for ``restore``.

        Of an optimisation in progress that is the number of its iterations: nothing that it began with has changed.
        """
        return {
            **{name: rows.values for name, rows in self._rows_of().items()},
            **under("scans", self._scans.state()),
            **under("finder", self._finder.state()),
            "key_stamp_ns": np.array(self._key_stamp_ns, np.int64),
            "since": self._since,
            "end": self._end,
            "waiting": np.array(self._waiting),
            "doubted": self._doubted,
            "before": self._before,
            "loop_rows": self._loop_rows,
            "loop_weights": self.loop_weights,
            "iterations": np.array(-1 if self._running is None else self.config.iterations - self._left),
        }

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()`` into a graph without any frame; raises ``StateError``."""
        for name, rows in self._rows_of().items():
            rows.restore(arrays, name)
        self._scans.restore(part(arrays, "scans"))
        self._finder.restore(part(arrays, "finder"))
        self._key_stamp_ns = taken_integer(arrays, "key_stamp_ns", -(2**63))
        self._since, self._end = taken(arrays, "since", np.float64, 3, 3), taken(arrays, "end", np.float64, 3, 3)
        self._before = taken(arrays, "before", np.float64, -1, 3)
        self._loop_rows = taken(arrays, "loop_rows", np.int64, -1)
        self._doubted = taken(arrays, "doubted", np.int64, -1)
        self.loop_weights = taken(arrays, "loop_weights", np.float64, len(self._loop_rows))
        self._check()
        done, waiting = taken_integer(arrays, "iterations", -1), taken_integer(arrays, "waiting")
        require(done < self.config.iterations, f"an optimisation has run {done} iterations already")
        if done >= 0:
            self.begin()
            self.advance(done)
        self._waiting = waiting

    def _check(self) -> None:
        """Raise ``StateError`` where the parts of a restored state do not belong together."""
        keys, frames, found = self.keys, self._frames.values, len(self._finder.loops)
        of_steps = (self._steps, self._step_covariance, self._published_covariance, self._step_variance)
        steps = {len(rows) for rows in of_steps}
        require(
            keys > 0 and len(self._scans) == len(frames) == keys and steps == {keys - 1},
            f"there are not {keys} key scans, and a step less",
        )
        of_loops = (self._loop_rows, self._doubted, self._used.values)
        ordered = frames[0] == 0 and (np.diff(frames) > 0).all() and frames[-1] < len(self.odometry)
        require(
            bool(ordered)
            and 1 <= len(self._before) <= keys
            and all(bool(((rows >= 0) & (rows < found)).all()) for rows in of_loops)
            and bool(np.isin(self._joins.values, frames[1:]).all()),
            "frames, nodes or loops are named that are not there",
        )

    @property
    def loop_frames(self) -> np.ndarray:
        """Frames ``(loops, 2)`` that the loops of the last optimisation join."""
        frames: np.ndarray = self._frames.values[self._finder.loops.pairs[self._loop_rows]]
        return frames

    @property
    def loop_relative(self) -> np.ndarray:
        """What these loops measured ``(loops, 3)``."""
        return self._finder.loops.relative[self._loop_rows]

    @property
    def loop_std(self) -> np.ndarray:
        """Deviations ``(loops, 3)`` of what they measured, in which their weights are accounted for."""
        variance = np.diagonal(self._finder.loops.covariance, axis1=1, axis2=2)[self._loop_rows]
        return np.sqrt(variance / np.maximum(self.loop_weights, 1e-12)[:, None])
