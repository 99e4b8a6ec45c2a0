"""The graph of meta-poses behind the online trajectory: key frames, a window, and loops between any of them.

Counted in blocks: node ``b`` is the pose after ``b`` blocks of frames, node 0 the first frame, the origin of ``map``.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ngo_estimator.data.row_buffers import GrowingRows, SlidingRows
from ngo_estimator.data.state_arrays import Arrays, part, require, taken, taken_indices, taken_integer, under
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.planar_motion import all_between, between, carried, chained, compose, frames_between_nodes
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.networks.pose_aggregation import block_variances, poses_in_blocks
from ngo_estimator.online.blind_stretches import shrunk_corrections, summed_variances
from ngo_estimator.online.kept_loops import KeptLoops
from ngo_estimator.online.key_frames import KeyFrame, KeyFrames
from ngo_estimator.online.online_loops import OnlineLoops
from ngo_estimator.online.place_map import PlaceMap
from ngo_estimator.online.step_log import StepLog
from ngo_estimator.optimizer.loop_closure import Loops
from ngo_estimator.optimizer.meta_poses import Correction, MetaSteps, OptimizedMetaPoses, Solution
from ngo_estimator.optimizer.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.optimizer.normal_equations import FactorisedInformation
from ngo_estimator.optimizer.registered_odometry import registered_steps

_MOST_DRIFT = 4.0
"""How much the variance between a key frame and the newest pose is taken to be more than the graph says."""

_FRESH = 2
"""Blocks since the last optimisation up to which poses say what frames share."""

_AGAIN = 8
"""Blocks after which what shares a frame's walls is looked for once more: its pose knows of loops that came later."""

_TOLD_LATE = 16
"""Frames before the first unfamiliar one that were taken for familiar and may not have been: a mean over them tells."""

_RESUMED = 1
"""Results of an optimisation that goes on from the last solution."""

_BUFFERS = ("relative", "log_std", "motion", "steps", "std", "optimized_std", "features", "familiar", "fixed")
"""Names of the newest rows: the first three and ``familiar`` of each step, the others of each block; without a network
there are no features."""

_STD = (1e-6, 1e2)
"""What a step's deviation is limited to (m or rad)."""

_SHRUNK = 1e-5
"""By less (m or rad) are poses those of the solution: a hundredth of what corrections are good to."""

_LEAST_INFORMATION = 1e-12
"""Of a loop, 1/m^2 or 1/rad^2: with less it might as well not be there."""


_Work = tuple[str, Callable[[int], None]]
"""A piece of taking in a block: what it is called where it fails, and what does it for the block of a number."""


@dataclass
class _Running:
    """An optimisation in progress, of which so many ``parts`` were done."""

    iterations: Iterator[OptimizedMetaPoses]
    keys: np.ndarray
    first: int
    numbers: np.ndarray
    runs_network: bool
    anneals: bool
    parts: int = 0
    result: OptimizedMetaPoses | None = None

    @property
    def done(self) -> bool:
        """Whether the result is the last one."""
        return self.result is not None and self.result.left == 0


@dataclass(frozen=True)
class _Corrections:
    """What the network gave when it ran last, ``(iterations, blocks, 3)``, for the blocks from number ``first`` on."""

    first: int
    adjustment: np.ndarray
    stiffness: np.ndarray

    @classmethod
    def of(cls, first: int, given: Sequence[Correction]) -> "_Corrections":
        """Of all iterations of one optimisation."""
        arrays = (torch.cat(parts).numpy() for parts in zip(*given, strict=True))
        return cls(first, *arrays)

    def for_blocks(self, first: int, last: int) -> list[Correction]:
        """The same for the blocks ``first`` to ``last`` (not included): newer ones are no less stiff than the last."""
        stiffness, adjustment = self.stiffness[:, first - self.first :], self.adjustment[:, first - self.first :]
        iterations, seen, _ = stiffness.shape
        new = np.zeros((iterations, last - first - seen, 3), np.float32)
        rows = np.hstack((adjustment, new)), np.hstack((stiffness, new + stiffness[:, -1:]))
        pairs = zip(*(torch.from_numpy(array).unsqueeze(1) for array in rows), strict=True)
        return [Correction(*pair) for pair in pairs]


class MetaGraph:
    """Takes frames, keeps nodes, and optimises those of the window together with the key frames before it.

    The network runs for each ``network_every``-th block; between, what it gave is taken again. For each
    ``anneal_every``-th block all loops are judged from the odometry on; between, only new ones.
    """

    def __init__(
        self,
        optimizer: NeuralGraphOptimizer,
        pair_head: PairHead | None,
        window: int,
        key_frames: int,
        network_every: int = 1,
        anneal_every: int = 1,
        log: Callable[[], StepLog] = StepLog,
    ) -> None:
        self._optimizer, self._pair_head = optimizer, pair_head
        self._block, self._window = optimizer.block, window
        self._scale = optimizer.config.covariance_scale
        self._context = optimizer.config.context
        self._log = log  # of the steps as they came
        recalled = -(-_TOLD_LATE // self._block) + 1
        keep = (2 * self._context + 2 + recalled) * self._block
        self.odometry = GrowingRows((3,), np.float64)
        self.odometry.append(np.zeros(3))
        self._relative = SlidingRows((3,), np.float32, keep)
        self._log_std = SlidingRows((3,), np.float32, keep)
        config = optimizer.config.aggregation
        self._motion = SlidingRows((config.motion_feature_size,), np.float32, keep)
        blocks_kept = max(window, self._context) + 2
        self._steps = SlidingRows((3,), np.float32, blocks_kept)
        self._std = SlidingRows((3,), np.float32, blocks_kept)
        self._optimized_std = SlidingRows((3,), np.float64, blocks_kept)
        self._features = SlidingRows((config.width,), np.float32, blocks_kept)
        self._familiar = SlidingRows((), np.bool_, keep)  # steps
        self._fixed = SlidingRows((), np.bool_, blocks_kept)  # blocks that networks leave as they are
        self._blind = GrowingRows((3,), np.float64)  # variance of the unfamiliar steps of each block
        self._recalled = 0  # block from which on frames turned out to be unfamiliar
        self._pose, self._covariance = np.zeros(3), np.zeros((3, 3))  # of the newest frame
        self._nodes = GrowingRows((3,), np.float64)
        self._nodes.append(np.zeros(3))
        self._first = 0  # node where the window begins
        self._keys = KeyFrames(key_frames)
        self._kept = np.zeros((0, 3))  # poses of key frames when some were let go last
        self._gone = np.zeros(0, np.int64)  # nodes between these
        self._loops: OnlineLoops | None = None
        registers = pair_head is not None and pair_head.config.registers_odometry
        self._registrations = optimizer.config.registrations if registers else 0  # of steps of the odometry
        self._origin_code: np.ndarray | None = None
        if optimizer.config.loops:
            assert pair_head is not None
            self._loops = OnlineLoops(pair_head, optimizer.config.search, self._block, window, self.odometry)
        self._end = np.zeros((3, 3))  # covariance of the last node that was optimised, in the map
        self._information: FactorisedInformation | None = None  # of the last optimisation
        self._result_keys, self._result_first, self._result_last = np.zeros(0, np.int64), 0, 0
        self.loop_frames = np.zeros((0, 2), np.int64)
        """Frames that the loops of the last optimisation join, what was measured, its deviations, and the weights."""
        self.loop_relative, self.loop_std, self.loop_weights = np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
        self._work: list[tuple[_Work, ...]] = []  # parts that are left of taking in the newest block
        self._begun = False
        self._running: _Running | None = None
        self._network_every, self._anneal_every = network_every, anneal_every
        self._shrunk = False  # whether corrections of the last result were shrunk
        self._annealed = 0  # blocks when all loops were judged last
        self._corrections: _Corrections | None = None
        self._begun_s = 0.0
        self.optimized, self.fault = False, ""
        """Whether an optimisation ended, and what failed, since the newest frame came."""
        self.took_s = 0.0
        """Computing time of the last optimisation that was ended, over all steps that it was spread over."""
        self._active, self._before = np.zeros(0, np.int64), np.zeros((0, 3))
        self._joins = GrowingRows((), np.int64)  # frames from which on another odometry goes on

    @property
    def blocks(self) -> int:
        """Whole blocks so far."""
        return len(self._nodes) - 1

    @property
    def window_fill(self) -> float:
        """Share of the window that is in use."""
        return min(1.0, (len(self.odometry) - 1) / (self._window * self._block))

    @property
    def largest_move_m(self) -> float:
        """How far the last optimisation moved a node at most."""
        moved = self._nodes.values[self._active, :2] - self._before[:, :2]
        return float(np.hypot(moved[:, 0], moved[:, 1]).max(initial=0.0))

    def begin_at(self, origin_code: np.ndarray | None) -> None:
        """Take the place code of the first frame, where it is known, before the first step."""
        self._origin_code = origin_code

    def append(
        self,
        relative: np.ndarray,
        variance: np.ndarray,
        motion: np.ndarray,
        code: np.ndarray,
        joins: bool = False,
        familiar: bool = True,
    ) -> bool:
        """Take a step ``(3,)`` with its variances, motion feature and place code; whether it completed a block.

        With ``joins`` the step is where another odometry goes on, in another place.
        A frame that is not ``familiar`` closes no loops, and networks leave the odometry around it as it is. Its
        variances are honest, so that ``covariance_scale`` is not for them. The first one recalls those before it.
        """
        self.optimized, self.fault = False, ""
        if not familiar:
            code, variance = np.zeros_like(code), variance / self._scale
            if len(self._familiar) and self._familiar.slice(len(self._familiar) - 1)[0]:
                self._recall()
        log_std = 0.5 * np.log(variance)
        step = relative.astype(np.float64)
        self._pose = compose(self._pose, step)
        self._covariance = propagate(self._covariance, self._pose, relative, np.diag(variance))
        self.odometry.append(compose(self.odometry.values[-1], step))
        if joins:
            self._joins.append(len(self.odometry) - 1)
        self._relative.append(relative)
        self._log_std.append(log_std)
        self._motion.append(motion)
        self._familiar.append(familiar)
        if self._loops is not None:
            self._loops.append(code)
        if (len(self.odometry) - 1) % self._block:
            return False
        try:
            self.finish()  # what comes now changes the nodes that it is about
        except Exception as error:  # it may cost an optimisation, and nothing else
            self.fail(error)
        self._complete_block()
        return True

    @torch.inference_mode()
    def _complete_block(self) -> None:
        block = self.blocks
        count = (block + 1) * self._block
        try:
            self._register(count - self._block)
        except Exception as error:  # numerics of a library, or a fault of ours: the steps stay as they came
            self.fail(error, "the registration of steps")
        steps = torch.from_numpy(self._relative.slice(count - self._block)).unsqueeze(0)
        in_block = poses_in_blocks(steps, self._block)
        log_std = torch.from_numpy(self._log_std.slice(count - self._block)).unsqueeze(0)
        std = block_variances(in_block, log_std).sqrt()[0, 0]
        self._steps.append(in_block[0, 0, -1])
        self._std.append(std)
        self._optimized_std.append(std)
        relative = between(*self.odometry.values[[-1 - self._block, -1]])
        self._nodes.append(compose(self._nodes.values[-1], relative))
        self._fixed.append(False)
        self._blind.append(self._blind_variance(block))
        self._work = self._all_work()

    def _all_work(self) -> list[tuple[_Work, ...]]:
        """What is to be done for a new block before it is optimised, in parts of about the same length."""
        aggregate: _Work = ("taking in a meta-pose", self._aggregate)
        if not self._optimizer.config.loops:
            return [(aggregate,)]
        look, measure, again, shared = (
            ("the search for loops", search)
            for search in (self._look_for_places, self._measure_places, self._find_again, self._find_shared)
        )
        parts: list[tuple[_Work, ...]] = [(aggregate,), (look, measure)]
        if self._registrations:  # then nothing is smoothed, which takes longer than features
            parts = [(look,), (measure, aggregate)]
        return [(again,), *parts, (shared,)] if self._optimizer.config.search.overlaps > 0 else parts

    @property
    def work(self) -> int:
        """The most parts of an update: registering and taking in a block, the network's preparation, and iterations."""
        config = self._optimizer.config
        return (self._registrations > 0) + len(self._all_work()) + config.network + config.iterations

    def _do(self, part: tuple[_Work, ...]) -> None:
        """Do a part; what fails may cost loops or features, and nothing else."""
        for name, work in part:
            try:
                work(self.blocks - 1)
            except Exception as error:  # numerics of a library, or a fault of ours
                self.fault = _said(error, name)

    @torch.inference_mode()
    def _settle(self) -> None:
        """Do all that is left of taking in the newest block."""
        while self._work:
            self._do(self._work.pop(0))
        self._make_room()

    @property
    def _fresh(self) -> bool:
        """Whether poses say what frames share."""
        return self.blocks - self._result_last <= _FRESH

    def _find_again(self, block: int) -> None:
        """Look once more for overlaps of a slightly older block."""
        if self._loops is not None and self._fresh and block - _AGAIN >= self._first:
            self._loops.find_overlaps(block - _AGAIN, self._first, self._nodes.values)

    def _look_for_places(self, block: int) -> None:
        """Look for frames like those of the newest block."""
        if self._loops is not None:
            self._loops.look(block, self._first, self._keys)

    def _measure_places(self, block: int) -> None:
        """Measure the loops to these frames."""
        if self._loops is not None:
            self._limit_drift(self._loops.measure())

    def _find_shared(self, block: int) -> None:
        """Look for overlaps of the newest block."""
        if self._loops is not None and self._fresh:
            self._limit_drift(self._loops.find_overlaps(block, self._first, self._nodes.values, self._keys))

    def _limit_drift(self, found: KeptLoops) -> None:
        if self._loops is not None and len(self._keys) and len(found):
            self._loops.limit_drift(found, self._drift(found))

    def _make_room(self) -> None:
        """Let the window slide."""
        while self.blocks - self._first > self._window:
            self._slide()
        if self._keys.crowded:
            self._thin()

    def _register(self, first: int) -> None:
        """Measure the newest block again, which begins with the step of number ``first``."""
        if self._loops is None or self._pair_head is None or self._registrations == 0:
            return
        if self._joins.values[-1:].max(initial=0) > first:
            return  # its frames were seen from two places
        if not self._familiar.slice(first).all():
            return
        before = self._origin_code if first == 0 else self._loops.codes(first - 1)[0]
        origin_code = None if before is None else torch.from_numpy(before).unsqueeze(0)
        rows = self._relative.slice(first), self._log_std.slice(first), self._loops.codes(first)
        steps, deviations, codes = (torch.from_numpy(values).unsqueeze(0) for values in rows)
        relative, log_std = registered_steps(
            self._pair_head, steps, deviations, codes, self._block, self._registrations, origin_code
        )
        self._relative.replace(first, relative[0].numpy())
        self._log_std.replace(first, log_std[0].numpy())
        odometry = torch.from_numpy(self.odometry.values)
        odometry[first + 1 :] = se2.compose(odometry[first], se2.r2g(relative[0].double()))

    @torch.inference_mode()
    def _recall(self) -> None:
        """Take the newest frames back, which were taken for familiar: their loops, and what was registered by them."""
        self.abandon()  # it has their loops
        first = max(0, len(self._familiar) - _TOLD_LATE)
        self._familiar.slice(first)[:] = False
        if self._loops is not None:
            self._loops.recall(first)
        self._recalled = min(first // self._block, self.blocks)
        if self._registrations and self._recalled < self.blocks:
            self._unregister(self._recalled)
        for block in range(self._recalled, self.blocks):
            self._blind.values[block] = self._blind_variance(block)

    def _unregister(self, first: int) -> None:
        """Take the steps from block ``first`` on as the odometry had them."""
        log, began = self._log(), first * self._block
        odometry, std = log.odometry.values[began : len(self._relative) + 1], log.odometry_std.values[began:]
        relative = se2.between(torch.from_numpy(odometry[:-1]), torch.from_numpy(odometry[1:]))
        self._relative.replace(began, relative.numpy())
        self._log_std.replace(began, np.log(std[: len(relative)].clip(*_STD)))
        own = torch.from_numpy(self.odometry.values)
        own[began + 1 :] = se2.compose(own[began], se2.r2g(relative))
        whole = slice(began, self.blocks * self._block)
        in_block, log_std = (
            torch.from_numpy(rows.slice(whole.start, whole.stop)).unsqueeze(0)
            for rows in (self._relative, self._log_std)
        )
        in_block = poses_in_blocks(in_block, self._block)
        self._steps.replace(first, in_block[0, :, -1].numpy())
        self._std.replace(first, block_variances(in_block, log_std).sqrt()[0].numpy())

    def _blind_variance(self, block: int) -> np.ndarray:
        """Variance ``(3,)`` of the unfamiliar steps of a block, as the odometry has it."""
        rows = slice(block * self._block, (block + 1) * self._block)
        log_std, familiar = (of.slice(rows.start, rows.stop) for of in (self._log_std, self._familiar))
        variance: np.ndarray = np.exp(2.0 * log_std.astype(np.float64))[~familiar].sum(axis=0) * self._scale
        return variance

    def _aggregate(self, block: int) -> None:
        """Features and smoothed odometry of the blocks that the newest one changes, and of itself."""
        if not self._optimizer.config.network and self._optimizer.config.smoother is None:
            return
        changed = max(0, min(block, self._recalled) - self._context)
        self._recalled = block + 1
        start = max(0, changed - self._context)
        rows = (self._relative, self._log_std, self._motion)
        ends = start * self._block, (block + 1) * self._block
        inputs = [torch.from_numpy(r.slice(*ends)).unsqueeze(0) for r in rows]
        steps = self._optimizer.aggregate(*inputs)
        if steps.features is not None:
            self._features.replace(changed, steps.features[0, changed - start :].numpy())
        fixed = self._near_unfamiliar(start, block + 1)
        self._fixed.replace(changed, fixed[changed - start :])
        if self._optimizer.config.smoother is not None:
            in_blocks = poses_in_blocks(inputs[0], self._block)
            own = in_blocks[..., -1, :], block_variances(in_blocks, inputs[1]).sqrt()
            stays = torch.from_numpy(fixed).unsqueeze(-1)
            kept = self._steps, self._std
            for buffer, smoothed, raw in zip(kept, (steps.relative, steps.std), own, strict=True):
                buffer.replace(changed, torch.where(stays, raw[0], smoothed[0])[changed - start :].numpy())

    def _near_unfamiliar(self, start: int, end: int) -> np.ndarray:
        """Which blocks ``start`` to ``end`` (not included) are so near to an unfamiliar frame that networks see it."""
        familiar = self._familiar.slice(start * self._block, end * self._block)
        unfamiliar = np.atleast_1d(~familiar.reshape(-1, self._block).all(axis=1))
        reach = np.arange(-self._context, self._context + 1)
        near = (np.flatnonzero(unfamiliar)[:, None] + reach).ravel()
        found = np.zeros(len(unfamiliar), np.bool_)
        found[near[(near >= 0) & (near < len(found))]] = True
        return found

    def _slide(self) -> None:
        """Move the window by a block: its first node becomes a key frame."""
        node = self._first
        relative = between(*self._nodes.values[[node, node + 1]])
        variance = self._optimized_std.slice(node, node + 1)[0] ** 2
        if self._loops is not None:
            self._keys.add(self._loops.key_frame(node, relative, variance))
        else:
            nothing = np.zeros((self._block, 0), np.float32)
            self._keys.add(KeyFrame(node, relative, variance, nothing, nothing, np.zeros((self._block, 3))))
        self._first += 1
        if self._loops is not None:
            self._loops.leave(self._first)

    def _thin(self) -> None:
        """Let some key frames go; what lies between those that stay moves with them from now on."""
        nodes, variance = self._keys.nodes, self._keys.variance
        self._nodes.values[:] = self.nodes()
        poses = self._nodes.values[nodes]
        stay = self._keys.thin(poses)
        if self._loops is not None:
            self._loops.reattach(nodes, stay, poses, variance)
        self._kept = poses[stay]
        inside = np.arange(self._first)
        self._gone = inside[~np.isin(inside, self._keys.nodes)]

    def nodes(self, before: bool = False) -> np.ndarray:
        """Poses of all nodes ``(blocks + 1, 3)``, as they are or as they were before the last optimisation."""
        nodes: np.ndarray = self._nodes.values.copy()
        if before:
            nodes[self._active] = self._before
        if len(self._gone):
            keys = self._keys.nodes[: len(self._kept)]
            old, new = torch.from_numpy(self._kept), torch.from_numpy(nodes[keys])
            segment = np.searchsorted(keys, self._gone, side="right") - 1
            bent = se2.between(new[:-1], new[1:]) - se2.between(old[:-1], old[1:])
            bent = se2.wrapped(bent)
            share = torch.from_numpy((self._gone - keys[segment]) / (keys[segment + 1] - keys[segment]))
            relative = se2.between(old[segment], torch.from_numpy(nodes[self._gone]))
            nodes[self._gone] = se2.compose(new[segment], relative + share[:, None] * bent[segment]).numpy()
        return nodes

    def _drift(self, found: KeptLoops) -> np.ndarray:
        """How far candidates to key frames may be off at most, as variances ``(n, 3)``; infinite for all others.

        The odometry alone would let a pose of long ago lie anywhere; the loops that were closed since say more.
        """
        limits = np.full((len(found), 3), np.inf)
        if self._information is None or self._result_last < self._first:
            return limits  # nothing was optimised, or all of what was lies behind the window by now
        last = int(len(self._result_keys) + self._result_last - self._result_first)
        since = self._std.slice(self._result_last).astype(np.float64)
        travelled = self._nodes.values[self._result_last + 1 :, :2] - self._nodes.values[-1, :2]
        own = (since**2).sum(0) + np.array([1.0, 1.0, 0.0]) * (since[:, 2] ** 2 @ (travelled**2).sum(1))
        for k in np.flatnonzero(found.start < self._first):
            start = int(np.searchsorted(self._result_keys, found.start[k]))
            if start >= len(self._result_keys) or self._result_keys[start] != found.start[k]:
                continue
            covariance = np.zeros((6, 6))
            which = slice(0, 6) if start else slice(3, 6)
            covariance[which, which] = self._information.covariance([start, last] if start else [last])
            x, y = self._nodes.values[self._result_last, :2] - self._nodes.values[found.start[k], :2]
            jacobian = np.hstack((np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]]), -np.eye(3)))
            drift = np.diagonal(jacobian @ covariance @ jacobian.T)
            limits[k] = _MOST_DRIFT * (self._scale * drift + own)
        return limits

    @property
    def running(self) -> bool:
        """Whether an optimisation has begun that is not done."""
        return self._begun

    def begin(self) -> None:
        """Begin to optimise all nodes of the window and the key frames before it."""
        self._begun, self._begun_s = True, 0.0

    @torch.inference_mode()
    def _prepared(self) -> _Running:
        self._make_room()
        keys, first = self._keys.nodes, self._first
        relative = np.concatenate((self._keys.relative, self._steps.slice(first))).astype(np.float32)
        std = np.concatenate((np.sqrt(self._keys.variance), self._std.slice(first))).astype(np.float32)
        known = None if self._network_is_due else self._corrections
        runs_network = self._optimizer.config.network and known is None
        features = None
        if runs_network:
            features = torch.from_numpy(self._features.slice(first)).unsqueeze(0)
        steps = MetaSteps(
            torch.from_numpy(relative).unsqueeze(0), torch.from_numpy(std).unsqueeze(0), features, self.blocks - first
        )
        if (fixed := self._fixed.slice(first)).any():
            steps = replace(steps, fixed=torch.from_numpy(fixed.copy()).unsqueeze(0))
        loops, numbers, solution = None, np.zeros(0, np.int64), None
        if self._loops is not None:
            loops, numbers = self._loops.loops(keys, first, self.blocks)
            loops = self._verified(loops, np.concatenate((keys, np.arange(first, self.blocks + 1))))
            if not self._annealing_is_due:
                solution = Solution(self._relative_nodes(keys, first), *self._loops.weighed(numbers))
        corrections = None if known is None else known.for_blocks(first, self.blocks)
        iterations = self._optimizer.iterate(steps, loops, corrections, solution)
        return _Running(iterations, keys, first, numbers, runs_network, solution is None)

    def _verified(self, loops: Loops, active: np.ndarray) -> Loops:
        """The loops between the ``active`` nodes; none across a blind stretch where place codes alone tell them.

        Nothing limits the motion within it, so that each place that looks alike would do.
        """
        search = self._optimizer.config.search
        if search.registrations or search.least_belief or not self._blind.values.any():
            return loops
        blind = (summed_variances(self._blind.values, active) > 0.0).any(axis=1)
        before = torch.from_numpy(np.concatenate(([0], blind.cumsum())))
        return replace(loops, valid=loops.valid & (before[loops.end + 1] == before[loops.start]))

    def _relative_nodes(self, keys: np.ndarray, first: int) -> torch.Tensor:
        """Relative poses ``(1, n, 3)`` of the key frames and the window's nodes as they are."""
        nodes = self._nodes.values.take(np.concatenate((keys, np.arange(first, self.blocks + 1))), axis=0)
        return torch.from_numpy(all_between(nodes[:-1], nodes[1:])).unsqueeze(0)

    @property
    def _network_is_due(self) -> bool:
        """Whether what the network gave is too old; a short trajectory changes a lot with each block."""
        if self._corrections is None:
            return True
        seen = self._corrections.stiffness.shape[1]
        return self.blocks - self._corrections.first - seen >= min(self._network_every, 1 + seen // 8)

    @property
    def _is_light(self) -> bool:
        """Whether the iterations of this update run no network."""
        if self._running is not None:
            return not self._running.runs_network
        return not (self._optimizer.config.network and self._network_is_due)

    @property
    def _annealing_is_due(self) -> bool:
        """Whether all loops are to be judged anew, from the odometry on."""
        # Across blind stretches the poses are not those of the solution, even where the window has left them behind.
        if self._shrunk or self._blind.values[self._first :].any():
            return True
        seen = self._annealed - self._first
        return self._network_is_due or self.blocks - self._annealed >= min(self._anneal_every, 1 + seen // 8)

    def _iterate(self) -> None:
        """Prepare an optimisation, or run its next iteration; without the network the first one goes with it."""
        if (running := self._running) is None:
            running = self._running = self._prepared()
        if running.parts or not running.runs_network:
            running.result = next(running.iterations)
        running.parts += 1

    @property
    def _parts_left(self) -> int:
        """Parts of the update to come."""
        if self._running is not None and self._running.result is not None:
            return self._running.result.left
        iterations = self._optimizer.config.iterations if self._annealing_is_due else _RESUMED
        return len(self._work) + (self._running is None and not self._is_light) + iterations

    @torch.inference_mode()
    def advance(self, parts: int) -> bool:
        """Do so many parts of the update, or more where it would not be done before the next block is complete.

        Returns:
            Whether it is done, and every node at its new pose.
        """
        if not self._begun:
            raise RuntimeError("no optimisation has begun")
        began = time.perf_counter()
        steps_left = self._block - (len(self.odometry) - 1) % self._block
        if self._registrations and steps_left == self._block:
            parts -= 1  # the step that completed the block has registered it
        now = most = max(parts, -(-self._parts_left // steps_left))
        if self._is_light:  # then the last steps do several parts, as all before iterations are the heavier ones
            now = max(parts, self._parts_left - most * (steps_left - 1))
        for _ in range(min(now, self._parts_left)):
            if self._work:
                self._do(self._work.pop(0))
            else:
                self._iterate()
        self._begun_s += time.perf_counter() - began
        running = self._running
        if running is None or running.result is None or not running.done:
            return False
        end = self._scale * running.result.end_covariance()[0].numpy()
        poses = running.result.meta_relative[-1]
        if not (poses.isfinite().all() and np.isfinite(end).all() and (np.diagonal(end) > 0.0).all()):
            raise ArithmeticError("poses or their covariances came out as no numbers")
        self._running, self._begun, self.took_s = None, False, self._begun_s
        moved = self._apply(running, running.result, end)
        end = end + np.outer(moved, moved)
        self._pose, self._covariance = self._newest(end)
        self.optimized = True
        return True

    @property
    def unfinished(self) -> bool:
        """Whether an optimisation has begun that is not done."""
        return self.running

    def finish(self) -> bool:
        """Do what is left of an optimisation that has begun; returns whether there was one."""
        self._settle()
        if not self._begun:
            return False
        while not self.advance(self.work):
            pass
        return True

    def _apply(self, running: "_Running", result: OptimizedMetaPoses, end: np.ndarray) -> np.ndarray:
        """Take the result; how far the last node is from it ``(3,)``, as unfamiliar frames make corrections unsure."""
        keys, first = running.keys, running.first
        if self._loops is not None and result.loop_weights is not None and result.loop_information is not None:
            self.loop_frames, self.loop_relative = self._loops.edges(running.numbers)
            information = result.loop_information[0].double().numpy()
            self.loop_std = 1.0 / np.sqrt(np.maximum(information, _LEAST_INFORMATION))
            self.loop_weights = result.loop_weights[0].double().numpy()
            self._loops.weigh(running.numbers, self.loop_weights, information)
        poses = chained(result.meta_relative[-1][0].double().numpy())[1:]
        self._active = np.concatenate((keys, np.arange(first, self.blocks + 1)))
        self._before = self._nodes.values.take(self._active, axis=0)
        moved = self._shrink(poses)
        self._nodes.values[self._active[1:]] = poses
        self._optimized_std.replace(first, result.step_std[0, len(keys) :].double().numpy())
        self._end, self._information = end, result.equations
        self._result_keys, self._result_first, self._result_last = keys, first, self.blocks
        if running.anneals:
            self._annealed = self.blocks
        if running.runs_network and self._network_every > 1:
            self._corrections = _Corrections.of(first, result.corrections)
        return moved

    def _shrink(self, poses: np.ndarray) -> np.ndarray:
        """Shrink corrections of the active nodes ``(n, 3)`` across blind stretches; how far the last one moved."""
        self._shrunk = False
        if not self._blind.values.any():
            return np.zeros(3)
        active, log = self._active, self._log().odometry.values
        odometry = se2.between(torch.from_numpy(log[0]), torch.from_numpy(log[active * self._block])).numpy()
        ties = self._loops.ties() if self._loops is not None else (np.zeros((0, 2), np.int64), np.zeros(0))
        variance = summed_variances(self._blind.values, active)
        joined = np.searchsorted(active, ties[0])
        solution = np.vstack((np.zeros(3), poses))
        shrunk = shrunk_corrections(solution, odometry, variance, joined, ties[1])
        self._shrunk = bool(np.abs(shrunk - solution).max() > _SHRUNK)
        moved: np.ndarray = shrunk[-1] - poses[-1]
        poses[:] = shrunk[1:]
        return moved

    def abandon(self) -> None:
        """Leave undone what has begun; the newest block is taken in all the same."""
        self._running, self._begun = None, False
        self._settle()

    def fail(self, error: Exception, work: str = "an optimisation") -> None:
        """Leave undone what has begun, and keep why: every node is where it was."""
        self.abandon()
        self.fault = _said(error, work)

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame and its covariance ``(3, 3)``."""
        return self._pose, self._covariance

    def frame_poses(self, before: bool = False) -> np.ndarray:
        """Poses ``(frames, 3)`` of all frames, as they are or as they were before the last optimisation."""
        return frames_between_nodes(self.nodes(before), self.odometry.values, self._block, self._shares())

    def _shares(self) -> np.ndarray:
        """The share of a block's correction in that of each of its frames ``(1 or blocks, block)``: evenly spread."""
        frames = np.arange(1, self._block + 1, dtype=np.float64)
        even = frames[None] / self._block
        joins = self._joins.values[self._joins.values <= self.blocks * self._block]
        if len(joins) == 0:
            return even
        shares = np.repeat(even, self.blocks, axis=0)
        for frame in joins.tolist():  # the motion that nobody saw is the one that is corrected
            block = (frame - 1) // self._block
            shares[block] = frames >= frame - block * self._block
        return shares

    def places(self) -> PlaceMap:
        """The frames whose place codes are kept; raises ``ValueError`` where none are."""
        if self._loops is None:
            raise ValueError("the optimizer closes no loops, and keeps no place codes; expected one with loops")
        return self._loops.places(self._first * self._block, self._keys, self.frame_poses())

    def _newest(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame, behind the last node by odometry, and its covariance ``(3, 3)``.

        Args:
            covariance: that of the last node in the map ``(3, 3)``.
        """
        whole = self.blocks * self._block
        relative, log_std = (rows.slice(whole).astype(np.float64) for rows in (self._relative, self._log_std))
        return carried(
            self._nodes.values[-1], covariance, self.odometry.values[whole:], relative, np.exp(2.0 * log_std)
        )

    def _buffers(self) -> dict[str, SlidingRows]:
        rows = (
            self._relative, self._log_std, self._motion, self._steps, self._std, self._optimized_std, self._features,
            self._familiar, self._fixed,
        )  # fmt: skip
        return dict(zip(_BUFFERS, rows, strict=True))

    def state(self) -> Arrays:
        """All that later steps depend on, for ``restore``.

        Of an optimisation in progress that is the number of its parts: nothing that its iterations began with has
        changed.
        """
        running, code = self._running, self._origin_code
        iterated = 0 if running is None else running.parts
        known = self._corrections
        arrays = {
            "odometry": self.odometry.values,
            "pose": self._pose,
            "covariance": self._covariance,
            "nodes": self._nodes.values,
            "first": np.array(self._first),
            "blind": self._blind.values,
            "recalled": np.array(self._recalled),
            "annealed": np.array(self._annealed),
            "shrunk": np.array(self._shrunk),
            "kept": self._kept,
            "gone": self._gone,
            "active": self._active,
            "before": self._before,
            "end": self._end,
            "result_keys": self._result_keys,
            "result_ends": np.array((self._result_first, self._result_last)),
            "loop_frames": self.loop_frames,
            "loop_relative": self.loop_relative,
            "loop_std": self.loop_std,
            "loop_weights": self.loop_weights,
            "joins": self._joins.values,
            "origin_code": np.zeros(0, np.float32) if code is None else code,
            "begun": np.array(self._begun),
            "parts_left": np.array(len(self._work)),
            "iterated": np.array(iterated),
            **under("keys", self._keys.state()),
        }
        for name, rows in self._buffers().items():
            arrays |= under(name, rows.state())
        if known is not None:
            own = {"first": np.array(known.first), "adjustment": known.adjustment, "stiffness": known.stiffness}
            arrays |= under("corrections", own)
        if self._information is not None:
            arrays |= under("information", self._information.state())
        return arrays if self._loops is None else arrays | under("loops", self._loops.state())

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()`` into a graph without any frame; raises ``StateError``."""
        self.odometry.restore(arrays, "odometry")
        self._nodes.restore(arrays, "nodes")
        self._blind.restore(arrays, "blind")
        self._recalled, self._annealed = (taken_integer(arrays, name) for name in ("recalled", "annealed"))
        self._shrunk = bool(taken(arrays, "shrunk", np.bool_))
        for name, rows in self._buffers().items():
            rows.restore(part(arrays, name))
        self._pose, self._covariance = (
            taken(arrays, "pose", np.float64, 3),
            taken(arrays, "covariance", np.float64, 3, 3),
        )
        self._first = taken_integer(arrays, "first")
        nothing = (self._block, 0)
        shapes = (nothing, nothing) if self._loops is None else self._loops.key_frame_shapes
        self._keys.restore(part(arrays, "keys"), self.blocks + 1, *shapes)
        self._kept, self._gone = (
            taken(arrays, "kept", np.float64, -1, 3),
            taken_indices(arrays, "gone", self.blocks + 1),
        )
        self._active = taken_indices(arrays, "active", self.blocks + 1)
        self._before = taken(arrays, "before", np.float64, len(self._active), 3)
        self._end = taken(arrays, "end", np.float64, 3, 3)
        self._result_keys = taken_indices(arrays, "result_keys", self.blocks + 1)
        self._result_first, self._result_last = taken(arrays, "result_ends", np.int64, 2).tolist()
        self.loop_frames = taken(arrays, "loop_frames", np.int64, -1, 2)
        for name, shape in (("loop_relative", (3,)), ("loop_std", (3,)), ("loop_weights", ())):
            setattr(self, name, taken(arrays, name, np.float64, len(self.loop_frames), *shape))
        self._joins.restore(arrays, "joins")
        code = taken(arrays, "origin_code", np.float32, -1)
        self._origin_code = code if len(code) else None
        information = part(arrays, "information")
        self._information = FactorisedInformation.from_state(information) if information else None
        if self._loops is not None:
            self._loops.restore(part(arrays, "loops"))
        self._check()
        corrections = part(arrays, "corrections")
        if corrections:
            self._corrections = self._restored_corrections(corrections)
        work, left = self._all_work(), taken_integer(arrays, "parts_left")
        iterated = taken_integer(arrays, "iterated")
        require(left <= len(work), f"{left} parts of an update are left")
        require(iterated <= self._optimizer.config.iterations, f"an optimisation has done {iterated} parts already")
        self._work = work[len(work) - left :]
        self._begun = bool(taken(arrays, "begun", np.bool_))
        require(self._begun or not iterated, "an optimisation has not begun, and iterated")
        require(not (left and iterated), "an optimisation has iterated before its time")
        with torch.inference_mode():
            if self._work and self._work[0][0][1] == self._measure_places:
                self._do((("the search for loops", self._look_for_places),))
            for _ in range(iterated):
                self._iterate()

    def _restored_corrections(self, arrays: Arrays) -> _Corrections:
        first, iterations = taken_integer(arrays, "first"), self._optimizer.config.iterations
        adjustment = taken(arrays, "adjustment", np.float32, iterations, -1, 3)
        stiffness = taken(arrays, "stiffness", np.float32, *adjustment.shape[:2], -1)
        last = first + adjustment.shape[1]
        require(first <= self._first < last <= self.blocks, f"corrections of the blocks {first} to {last} are given")
        return _Corrections(first, adjustment, stiffness)

    def _check(self) -> None:
        """Raise ``StateError`` where the parts of a restored state do not belong together."""
        frames, blocks, counted = len(self.odometry) - 1, self.blocks, self._buffers()
        require(
            frames // self._block == blocks
            and {len(counted[name]) for name in (*_BUFFERS[:3], "familiar")} == {frames}
            and {len(counted[name]) for name in (*_BUFFERS[3:6], "fixed")} == {blocks}
            and len(self._blind) == blocks,
            f"{frames} steps and {blocks} meta-poses do not belong together",
        )
        require(
            0 <= self._result_first <= self._result_last <= blocks
            and self._first == (self._keys.nodes[-1] + 1 if len(self._keys) else 0)
            and len(self._kept) <= len(self._keys)
            and bool((self.loop_frames >= 0).all() and (self.loop_frames <= frames).all())
            and bool((self._joins.values > 0).all() and (self._joins.values <= frames).all()),
            "nodes or key frames are named that are not there",
        )


def _said(error: Exception, work: str) -> str:
    return f"{work} failed, {type(error).__name__}: {' '.join(str(error).split())}"
