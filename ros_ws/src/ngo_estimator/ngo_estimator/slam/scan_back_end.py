"""The back end of a lidar, or of several robots with one each: a graph of key scans, verified loops, warm starts."""

import math
from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep, check_step
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_scan import no_scan
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.geometry.planar_motion import between, compose, transformed
from ngo_estimator.graph.corrector import CorrectedGraph, Corrector, GraphProblem, normal_equations
from ngo_estimator.graph.normal_equations import NormalEquations
from ngo_estimator.graph.path_covariance import covariances_of
from ngo_estimator.graph.pose_graph import OPEN, PoseGraph
from ngo_estimator.graph.redundant_nodes import redundant_nodes
from ngo_estimator.graph.relative_poses import BELIEVED, RelativePoses
from ngo_estimator.graph.robust import Robust
from ngo_estimator.graph.segments import anchors, joined_parts, segment_of
from ngo_estimator.graph.sparsification import largest_variances
from ngo_estimator.loops.key_scan_store import KeyScanStore
from ngo_estimator.loops.scan_loop_candidates import covariance_windows
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.loops.scan_loops import ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.loops.thinned_loops import without_nodes
from ngo_estimator.loops.walls_seen_through import profile_rays
from ngo_estimator.slam.back_end import BackEnd, ClosedLoops, WhichLoops, require_sound
from ngo_estimator.slam.localisation import Localiser
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.own_map import OwnMap
from ngo_estimator.slam.scan_matcher import ScanMatcher

_KEYS_PER_OPTIMISED = 20
"""For each so many nodes an optimisation waits for one more key scan."""

_KEYS_PER_SURPRISED = 400
"""The same where a loop surprises."""

_MOVED_M = 0.5
"""Where an optimisation moves a key scan that far, the map is another one to search in."""


class ScanBackEnd(BackEnd):
    """Takes frames, keeps key scans and their loops, and optimises all of them together."""

    _finder: ScanLoopFinder

    def __init__(self, config: ScanGraphConfig) -> None:
        self._floor = np.diag((config.step_m**2, config.step_m**2, math.radians(config.step_deg) ** 2))
        super().__init__(PoseGraph(self._floor))
        self.config = config
        self._scans = KeyScanStore()
        self._finder = ScanLoopFinder(config)
        self._is_key = False  # whether the newest frame is a node, whose loops nobody has looked for
        self._corrector: Corrector = Robust(least_scale=1.0)
        # Loops when the graph was last solved without a warm start, and the scale of variances that was found.
        self._loops_from_nothing, self._scale = 0, np.ones(1)
        self._own_map = OwnMap(config)
        self._other_maps: dict[int, OwnMap] = {}  # by rank, of the streams that go on, but the last
        self._parts = np.zeros(0, np.int64)  # the part of the map that each segment is in, when that was asked last
        self._claimed = np.zeros(0, np.int64)  # used loops by which the robot was found since the last optimisation

    def key_step(self, key: int) -> KeyScanStep:
        """A key scan and the step to it, as the odometry had them; of old scans rays tell what loops ask of them."""
        scan = self._scans[key]
        if len(scan.points) and not len(scan.ranges):
            angles, ranges = profile_rays(self._finder.views.profiles[key].astype(np.float64))
            scan = replace(scan, angles=angles, ranges=ranges)
        from_stamp_ns = self._scans[max(0, key - 1)].stamp_ns
        if key == 0:
            return KeyScanStep(scan, from_stamp_ns, np.zeros(3), OPEN)  # nobody knows it
        graph, step = self.graph, key - 1
        given, published = (of[step] - self._floor for of in (graph.step_covariance, graph.published_covariance))
        factors = np.sqrt(np.diagonal(published) / np.diagonal(given))
        return KeyScanStep(scan, from_stamp_ns, graph.relative[step].copy(), given, factors)

    def checked(self, step: RelativeStep) -> RelativeStep:
        """See ``BackEnd.checked``; covariances are bounded."""
        check_step(step, 0, None)
        covariance = bounded(step.covariance)
        return step if np.array_equal(covariance, step.covariance) else replace(step, covariance=covariance)

    def begin_at(self, step: RelativeStep) -> None:
        """Take the first frame. Where its scan is missing, it adds no points to submaps."""
        self._scans.append(no_scan(step.from_stamp_ns) if step.origin_scan is None else step.origin_scan)

    def append(self, step: RelativeStep, joins: bool = False) -> None:
        """Take a step, with its key scan where there is one.

        Where another odometry goes on in another place, it ends at a key scan. Where it begins a segment, nobody
        measured it: it tells where the robot is taken to be until a loop does.
        """
        covariance = bounded(step.covariance)
        if step.segment:
            covariance = OPEN
            self.graph.open_segment()
        self.graph.append(step.relative_xyyaw, covariance, joins or step.segment)
        if step.key is not None:
            self._add_key(step.key, joins)
            self._own_map.follow(self.graph)
            self._scans.append(step.key.scan)
            self._is_key = True

    def _add_key(self, key: KeyScanStep, joins: bool) -> None:
        """Make the newest frame, which ends at a key scan, a node."""
        if key.from_key_stamp_ns == self._scans[-1].stamp_ns and not joins:
            # Registration in the same key scans: errors of the steps between do not add up.
            covariance = bounded(key.covariance)
            self.graph.add_node(covariance, covariance * np.outer(key.factors, key.factors))
        else:
            self.graph.add_node(bounded(self.graph.since_covariance))

    def keep_nodes(self) -> np.ndarray:
        """Let go of the frames between nodes; returns the old numbers of those that stay ``(n,)``."""
        frames = self.graph.frames
        kept = np.union1d(frames.nodes, (len(frames) - 1,))
        frames.keep(kept)
        self.closed = replace(self.closed, pairs=np.searchsorted(kept, self.closed.pairs))
        return kept

    def may_join(self, step: RelativeStep) -> bool:
        """Whether another odometry may go on from this step's frame, which needs a key scan."""
        return step.key is not None

    @property
    def _has_new_node(self) -> bool:
        return self._is_key

    def _take_in(self) -> bool:
        self._is_key = False
        if not self._guarded("the search for loops", self._look_for_loops):
            self._waiting = 0
        return self._waiting > self._wait

    @property
    def _wait(self) -> int:
        """Key scans for which a loop waits."""
        # An optimisation takes longer the more nodes there are: its cost for each key must not grow.
        return max(self.config.keys_between, len(self.graph) // _KEYS_PER_OPTIMISED)

    def _look_for_loops(self) -> None:
        """Ask for loops of the newest key."""
        begin = int(self.graph.streams[-1])
        if (len(self.graph) - 1 - begin) % self.config.loops.every == 0:
            graph, joining = self.graph, self._joining_loops
            windows = self._windows(joining)
            fresh = self._finder.find(self._scans, graph.poses, windows, segments=graph.borders, begin=begin)
            self._scans.compact()
            believed = self._finder.believed(fresh, graph)
            if len(believed):
                surprises = self._finder.use(believed, graph)
                waited = self._wait - len(graph) // _KEYS_PER_SURPRISED if surprises else 1
                self._waiting = max(self._waiting, waited)
            self._parts = joined_parts(graph.segments, joining.pairs)
            if self._own_map.contradicted(self._scans, self._finder.views, graph, windows, self._parts):
                self._part_newest_segment()
                return
            astray = self._own_map.astray(self._scans, self._finder.views, graph, windows, len(fresh) > 0)
            if astray is not None:
                graph.part_at(astray)
                self._part_newest_segment()
                return
            self._claim(self._own_map.look(self._scans, self._finder.views, graph, windows, self._parts))
        self._waiting += self._waiting > 0

    def _claim(self, loops: ScanLoops) -> None:
        """Take loops by which the robot was found again in its own map; the next optimisation judges them."""
        if len(loops):
            first = len(self._finder.used)
            self._finder.use(self._finder.add(loops), self.graph)
            self._claimed = np.concatenate((self._claimed, np.arange(first, len(self._finder.used))))
            self._waiting = self._wait + 1

    def _part_newest_segment(self) -> None:
        """Take back what joined the newest segment with others: it lies elsewhere."""
        first = self.graph.frames.nodes[self.graph.segments[-1]]
        self._drop_loops(lambda frames: (frames < first).any(1) & (frames >= first).any(1))
        self._waiting = self._wait + 1

    def _windows(self, loops: ScanLoops) -> np.ndarray:
        """Half widths ``(keys, 3)`` of the search around each key scan, as the graph knows the newest from there."""
        graph = self.graph
        edges = np.concatenate((graph.edges, loops.pairs))
        covariance = np.concatenate((graph.step_covariance, loops.covariance))
        variance = np.concatenate((graph.step_variance, largest_variances(loops.covariance)))
        variance[graph.segments[1:] - 1] = math.inf
        known = covariances_of(graph.poses, edges, covariance, variance, len(graph) - 1)
        return covariance_windows(self.config.windows, known)

    @property
    def _joining_loops(self) -> ScanLoops:
        """Loops that join keys: of two segments only those that the last optimisation believed."""
        loops = self.used_loops
        weight = np.zeros(len(loops))
        weight[: len(self.closed)] = self.closed.weight
        return self._joining(loops, weight)

    def _joining(self, loops: ScanLoops, weight: np.ndarray) -> ScanLoops:
        """Those that join keys, where they have this weight ``(n,)``."""
        first, last = segment_of(self.graph.segments, loops.pairs).T
        return loops[(first == last) | (weight > BELIEVED)]

    def begin_stream(self, rank: int, ends: bool) -> None:
        """Begin another stream of steps with the next one, which begins a segment; all work is done.

        ``ends``: the stream before has ended, and is never gone on with.
        """
        if not ends:
            self._other_maps[int(self.graph.ranks[-1])] = self._own_map
        self._own_map = OwnMap(self.config)
        self.graph.begin_stream(rank)

    def go_on_with(self, rank: int) -> np.ndarray:
        """Let the next step go on with another stream; all work is done.

        Returns:
            The old numbers of all frames ``(frames,)`` in their new order.
        """
        self._other_maps[int(self.graph.ranks[-1])] = self._own_map
        self._own_map = self._other_maps.pop(rank)
        order, frames = self.graph.go_on_with(rank)
        number = np.argsort(order)
        self._finder.reorder(self._scans, order)
        self._scans.reorder(order)
        for own_map in self._own_maps:
            own_map.renumber(number)
        self.closed = replace(self.closed, pairs=np.argsort(frames)[self.closed.pairs])
        self._parts = joined_parts(self.graph.segments, self._joining_loops.pairs)
        return frames

    @property
    def _own_maps(self) -> tuple[OwnMap, ...]:
        return *self._other_maps.values(), self._own_map

    def places(self, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The part of the map of each of some nodes ``(n,)``, and the node ``(n,)`` at which that part begins."""
        segments = self.graph.segments
        if len(self._parts) != len(segments):
            self._parts = joined_parts(segments, self._joining_loops.pairs)
        own = segment_of(segments, nodes)
        return self._parts[own], self._anchors(self._parts)[own]

    def _anchors(self, parts: np.ndarray) -> np.ndarray:
        """The node ``(s,)`` at which the part of the map begins that each segment is in; the first for one robot."""
        graph = self.graph
        if not graph.is_shared:
            return np.zeros_like(parts)
        return anchors(graph.segments, parts, graph.ranks[graph.stream_of(graph.segments)])

    @property
    def lost_since(self) -> int | None:
        """The frame from which on nobody knows where the newest is in the map, for no loop joins its segment."""
        segments = self.graph.segments
        if len(segments) == 1:
            return None
        known = np.flatnonzero(self._parts == 0)
        last = int(known[-1]) if len(known) else 0  # of the segments that are joined with the first
        return None if last == len(segments) - 1 else int(self.graph.frames.nodes[segments[last + 1]])

    def _thin(self) -> None:
        """Let go of key scans whose places newer ones show; what their edges said goes to their neighbours."""
        graph, loops, count = self.graph, self.used_loops, len(self.graph)
        newest = self._newest
        stays = newest.copy()
        stays[graph.ends_of_segments] = True
        for own_map in self._own_maps:
            stays[own_map.looks] = True
        part = self._parts[segment_of(graph.segments, np.arange(count))]
        leaves = redundant_nodes(graph.poses, graph.borders, part, stays, count - self.config.most_scans)
        if leaves.any():
            thinned = without_nodes(graph.poses, graph.steps, loops, self.closed.weight, leaves)
            graph.let_go(~leaves, thinned.bridges)
            self._scans.thin(~leaves)
            self._finder.thin(~leaves, thinned.loops, newest)
            for own_map in self._own_maps:
                own_map.thin(~leaves)
            self._loops_from_nothing = min(self._loops_from_nothing, len(thinned.loops))
            self._close(self.used_loops, thinned.weights)

    @property
    def _newest(self) -> np.ndarray:
        """The newest key scans ``(keys,)`` of each stream that goes on: loops to come are measured with them, or agree
        with theirs."""
        graph, loops, nodes = self.graph, self.config.loops, np.arange(len(self.graph))
        stream = graph.stream_of(nodes)
        goes_on = np.isin(graph.ranks, (*self._other_maps, graph.ranks[-1]))[stream]
        many = max(loops.submap_keys, loops.source_keys, loops.neighbour_keys + 1)
        newest: np.ndarray = goes_on & (nodes > graph.stream_ends[stream] - many)
        return newest

    def _close(self, loops: ScanLoops, weights: np.ndarray) -> None:
        """Say what is thought of the loops that are used ``(n,)``."""
        variance = np.diagonal(loops.covariance, axis1=1, axis2=2) / np.maximum(weights, 1e-12)[:, None]
        self.closed = ClosedLoops(self.graph.frames.nodes[loops.pairs], loops.relative, np.sqrt(variance), weights)

    def matcher(self, origin: MapOrigin) -> ScanMatcher:
        """Compares scans with the key scans as they are; they lie in ``map`` as ``origin`` says."""
        poses = origin.poses(self.graph.poses.copy())
        parts, _ = self.places(np.arange(len(self.graph)))
        return ScanMatcher(self._scans[:], poses, self._finder.views, self.config.loops, parts=parts)

    def localiser(self, origin: MapOrigin) -> Localiser:
        """Localises in the key scans as they are; raises ``ValueError`` where none has a point."""
        return Localiser(self.matcher(origin))

    @property
    def used_loops(self) -> ScanLoops:
        """The loops that the graph needs."""
        return self._finder.loops[self._finder.used]

    def measurements(self) -> tuple[RelativePoses, RelativePoses]:
        """The steps from each node to the next, and the loops that the graph needs."""
        loops = self.used_loops
        measured = RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)
        return self.graph.steps, measured

    def _drop_loops(self, which: WhichLoops) -> int:
        # What was thought of the others says which parts of the map are joined until all are optimised again.
        used, closed = self._finder.used[: len(self.closed)].copy(), self.closed
        removed = super()._drop_loops(which)
        self.closed = closed[np.isin(used, self._finder.used)]
        return removed

    def _forget_solution(self) -> None:
        self._loops_from_nothing = 0
        self._claimed = self._claimed[:0]  # they are numbered by the loops that are used

    @property
    def waiting_loops(self) -> int:
        """Loops that wait for an optimisation, or for others that agree."""
        return len(self._finder.used) - len(self.closed) + len(self._finder.doubted)

    def belief(self) -> np.ndarray:
        """Of the last optimisation in each of ``measurements``' loops ``(n,)``; NaN in those that came since."""
        return np.concatenate((self.closed.weight, np.full(len(self._finder.used) - len(self.closed), np.nan)))

    def _optimise(self) -> None:
        self._waiting = 0
        loops, claimed = self.used_loops, self._claimed
        self._claimed = claimed[:0]
        solution = None
        if len(claimed):
            solution = self._corrected(self._found_poses(loops[claimed]), anew=True)
            if not (solution.loop_weights[claimed] > BELIEVED).any():
                solution = None
        if solution is None:
            solution = self._corrected(self.graph.poses)
        parts = joined_parts(self.graph.segments, self._joining(loops, solution.loop_weights).pairs)
        ends = self._end_covariances(solution, parts) if len(self.graph) > 1 else [self.graph.end]
        for end in ends:
            require_sound(solution.poses, end if end.any() else np.eye(3))  # none where the map begins
        self._loops_from_nothing, self._scale = solution.loops_from_nothing, np.array((solution.scale,))
        self.scales = solution.step_scale, solution.loop_scale
        self.graph.move(solution.poses, *ends)
        self._close(loops, solution.loop_weights)
        self._parts = parts
        if self.graph.largest_move_m > _MOVED_M:
            for own_map in self._own_maps:
                own_map.map_changed()
        if len(self.graph) > self.config.most_scans + self.config.most_scans // 10:
            self._thin()

    def _corrected(self, poses: np.ndarray, anew: bool = False) -> CorrectedGraph:
        """The solution from these poses ``(keys, 3)`` on; ``anew``, without what the last one believed."""
        steps, measured = self.graph.steps_at(poses), self.measurements()[1]
        problem = GraphProblem(poses, steps, measured, np.ones(len(measured)))
        return self._corrector.correct(problem, None if anew else self._warm_start(problem))

    def _found_poses(self, claimed: ScanLoops) -> np.ndarray:
        """Poses of all keys ``(keys, 3)`` with two parts of the map put together as the last claimed loop says."""
        poses, (earlier, later) = self.graph.poses.copy(), claimed.pairs[-1]
        part = self._parts[segment_of(self.graph.segments, np.arange(len(self.graph)))]
        if part[earlier] != part[later]:
            found = compose(poses[earlier], claimed.relative[-1])
            if part[earlier] < part[later]:
                moves, motion = part == part[later], compose(found, between(poses[later], np.zeros(3)))
            else:
                moves, motion = part == part[earlier], compose(poses[later], between(found, np.zeros(3)))
            poses[moves] = se2.compose(motion, poses[moves])
        return poses

    def _warm_start(self, problem: GraphProblem) -> CorrectedGraph | None:
        """The last solution, whose nodes the newer ones follow; None where there is none."""
        if self._loops_from_nothing == 0:
            return None
        sound = np.ones(len(problem.steps))
        scale, before = float(self._scale[0]), self._loops_from_nothing
        return CorrectedGraph(problem, problem.poses, self.closed.weight, sound, 0.0, scale, loops_from_nothing=before)

    def _end_covariances(self, solution: CorrectedGraph, parts: np.ndarray) -> list[np.ndarray]:
        """Covariance ``(3, 3)`` of the last node of each stream, seen from where its part of the map begins, with the
        steps as they are published.

        Neighbouring scans err together, so that small residuals do not say that covariances are stated too large. An
        edge that fits badly says less.
        """
        steps, loops = self.graph.published_steps, solution.problem.loops
        edges = (
            (steps, _soft_weights(solution.problem.steps, solution.poses, self.config.kernel)),
            (loops, solution.loop_weights * _soft_weights(loops, solution.poses, self.config.kernel)),
        )
        equations = normal_equations(solution.poses, *edges)
        ends = self.graph.stream_ends
        begins = self._anchors(parts)[segment_of(self.graph.segments, ends)]
        pairs = zip(begins.tolist(), ends.tolist(), strict=True)
        return [_seen_from(equations, solution.poses, begin, end) for begin, end in pairs]

    def finish(self) -> bool:
        """Optimise until nothing moves any more; returns whether there was anything to optimise, and it worked."""
        self.fault = ""
        return len(self._finder.used) > 0 and self._guarded("an optimisation", self._optimise)

    def walls(self, most: int) -> np.ndarray:
        """Points ``(n, 2)`` of all key scans in the map, thinned to about ``most``."""
        every = max(1, -(-self._scans.points // most))
        placed = self.graph.poses[: len(self._scans)]  # before the first step the origin has no scan
        parts = [transformed(pose, scan.points[::every]) for pose, scan in zip(placed, self._scans, strict=True)]
        return np.concatenate(parts) if parts else np.zeros((0, 2))

    SAVED = (
        "graph", "_scans", "_finder", "_own_map", "_parts", "_claimed", "_waiting", "closed",
        "_loops_from_nothing", "_scale",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        require(len(self._scans) == len(self.graph), f"there are not {len(self.graph)} key scans")
        joined, used = self.closed.pairs, len(self._finder.used)
        require(bool((joined >= 0).all()), "loops join frames that are not there")
        require(
            len(self.closed) <= used and self._loops_from_nothing >= 0 and self._scale[0] > 0.0,
            "an optimisation is of loops that are not there",
        )
        parts, claimed = self._parts, self._claimed
        require(
            self._own_map.fits(len(self.graph))
            and len(parts) <= len(self.graph.segments)
            and bool(((parts >= 0) & (parts <= np.arange(len(parts)))).all())
            and bool(((claimed >= 0) & (claimed < used)).all()),
            "key scans are searched, parts of the map named, or loops claimed that are not there",
        )
        require(self._waiting >= 0, f"an optimisation waits for {self._waiting} key scans")


def _seen_from(equations: NormalEquations, poses: np.ndarray, begin: int, end: int) -> np.ndarray:
    """Covariance ``(3, 3)`` of a node's pose, along the axes of the map, where the node ``begin`` is known."""
    if begin == end:
        return np.zeros((3, 3))
    if 0 in (begin, end):
        joint = np.zeros((6, 6))
        row = 3 * (begin == 0)
        joint[row : row + 3, row : row + 3] = equations.covariance([max(begin, end)])
    else:
        joint = equations.covariance((begin, end))
    x, y = poses[end, :2] - poses[begin, :2]
    # An error of the first moves and turns the other.
    jacobian = np.concatenate((-np.array(((1.0, 0.0, -y), (0.0, 1.0, x), (0.0, 0.0, 1.0))), np.eye(3)), axis=1)
    covariance: np.ndarray = jacobian @ joint @ jacobian.T
    return covariance


def _soft_weights(edges: RelativePoses, poses: np.ndarray, kernel: float) -> np.ndarray:
    """Weights ``(n,)`` of edges by a Cauchy kernel of this width, in deviations."""
    squared = (edges.residuals(poses) ** 2).sum(1)
    weights: np.ndarray = 1.0 / (1.0 + squared / kernel**2)
    return weights
