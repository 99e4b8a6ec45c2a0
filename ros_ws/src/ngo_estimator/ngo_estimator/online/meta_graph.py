"""The graph of meta-poses behind the online trajectory: key frames, a window, and loops between any of them.

Counted in blocks: node ``b`` is the pose after ``b`` blocks of frames, node 0 the first frame, the origin of ``map``.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch

from ngo_estimator.data.row_buffers import GrowingRows, SlidingRows
from ngo_estimator.data.state_arrays import Arrays, part, require, taken, taken_indices, taken_integer, under
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.networks.pose_aggregation import block_variances, in_block_poses, poses_in_blocks
from ngo_estimator.online.kept_loops import KeptLoops
from ngo_estimator.online.key_frames import KeyFrame, KeyFrames
from ngo_estimator.online.online_loops import OnlineLoops
from ngo_estimator.online.place_map import PlaceMap
from ngo_estimator.optimizer.meta_poses import MetaSteps, OptimizedMetaPoses
from ngo_estimator.optimizer.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.optimizer.normal_equations import FactorisedInformation
from ngo_estimator.optimizer.registered_odometry import registered_steps

_MOST_DRIFT = 4.0
"""How much the variance between a key frame and the newest pose is taken to be more than the graph says."""

_FRESH = 2
"""Blocks since the last optimisation up to which poses say what frames share."""

_AGAIN = 8
"""Blocks after which what shares a frame's walls is looked for once more: its pose knows of loops that came later."""

_BUFFERS = ("relative", "log_std", "motion", "steps", "std", "optimized_std", "features", "familiar", "fixed")
"""Names of the newest rows: the first three and ``familiar`` of each step, the others of each block; without a network
there are no features."""

_LEAST_INFORMATION = 1e-12
"""Of a loop, 1/m^2 or 1/rad^2: with less it might as well not be there."""


@dataclass
class _Running:
    """An optimisation in progress, of which so many iterations are ``left``."""

    iterations: Iterator[OptimizedMetaPoses]
    left: int
    keys: np.ndarray
    first: int
    numbers: np.ndarray
    result: OptimizedMetaPoses | None = None
    took_s: float = 0.0


class MetaGraph:
    """Takes frames, keeps nodes, and optimises those of the window together with the key frames before it."""

    def __init__(
        self, optimizer: NeuralGraphOptimizer, pair_head: PairHead | None, window: int, key_frames: int
    ) -> None:
        self._optimizer, self._pair_head = optimizer, pair_head
        self._block, self._window = optimizer.block, window
        self._scale = optimizer.config.covariance_scale
        self._context = optimizer.config.context
        keep = (2 * self._context + 2) * self._block
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
        self._running: _Running | None = None
        self.optimized, self.fault = False, ""
        """Whether an optimisation ended, and what failed, since the newest frame came."""
        self.took_s = 0.0
        """Computing time of the last optimisation that was ended, over all steps that it was spread over."""
        self._active, self._before = np.zeros(0, np.int64), np.zeros((0, 3))

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
        self, relative: np.ndarray, variance: np.ndarray, motion: np.ndarray, code: np.ndarray, familiar: bool = True
    ) -> bool:
        """Take a step ``(3,)`` with its variances, motion feature and place code; whether it completed a block.

        A frame that is not ``familiar`` closes no loops, and networks leave the odometry around it as it is. Its
        variances are honest, so that ``covariance_scale`` is not for them.
        """
        if not familiar:
            code, variance = np.zeros_like(code), variance / self._scale
        self.optimized, self.fault = False, ""
        log_std = 0.5 * np.log(variance)
        self._pose = se2.compose(torch.from_numpy(self._pose), torch.from_numpy(relative.astype(np.float64))).numpy()
        self._covariance = propagate(self._covariance, self._pose, relative, np.diag(variance))
        last = torch.from_numpy(self.odometry.values[-1])
        self.odometry.append(se2.compose(last, torch.from_numpy(relative.astype(np.float64))).numpy())
        self._relative.append(relative)
        self._log_std.append(log_std)
        self._motion.append(motion)
        self._familiar.append(familiar)
        if self._loops is not None:
            self._loops.append(code)
        if (len(self.odometry) - 1) % self._block:
            return False
        if self._running is not None:  # what comes now changes the nodes that it is about
            try:
                self.advance(self._running.left)
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
        relative = se2.between(*torch.from_numpy(self.odometry.values[[-1 - self._block, -1]]))
        self._nodes.append(se2.compose(torch.from_numpy(self._nodes.values[-1]), relative).numpy())
        self._fixed.append(False)
        if self._optimizer.config.network or self._optimizer.config.smoother is not None:
            self._aggregate(block)
        try:
            self._find_loops(block)
        except Exception as error:  # as above: it may cost loops, and nothing else
            self.fail(error, "the search for loops")
        while self.blocks - self._first > self._window:
            self._slide()
        if self._keys.crowded:
            self._thin()

    def _find_loops(self, block: int) -> None:
        """Look for loops of the newest block, whose number is ``block``, and for overlaps of a slightly older one."""
        if self._loops is None:
            return
        fresh = self.blocks - self._result_last <= _FRESH
        if fresh and block - _AGAIN >= self._first:
            self._loops.find_overlaps(block - _AGAIN, self._first, self._nodes.values)
        found = self._loops.find(block, self._first, self._keys)
        if fresh:
            found = found.and_also(self._loops.find_overlaps(block, self._first, self._nodes.values, self._keys))
        if len(self._keys):
            self._loops.limit_drift(found, self._drift(found))

    def _register(self, first: int) -> None:
        """Measure the newest block again, which begins with the step of number ``first``."""
        if self._loops is None or self._pair_head is None or self._registrations == 0:
            return
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

    def _aggregate(self, block: int) -> None:
        """Features and smoothed odometry of the blocks that the newest one changes, and of itself."""
        changed = max(0, block - self._context)
        start = max(0, changed - self._context)
        rows = (self._relative, self._log_std, self._motion)
        inputs = [torch.from_numpy(r.slice(start * self._block)).unsqueeze(0) for r in rows]
        steps = self._optimizer.aggregate(*inputs)
        if steps.features is not None:
            self._features.replace(changed, steps.features[0, changed - start :].numpy())
        fixed = self._near_unfamiliar(start)
        self._fixed.replace(changed, fixed[changed - start :])
        if self._optimizer.config.smoother is not None:
            in_blocks = poses_in_blocks(inputs[0], self._block)
            own = in_blocks[..., -1, :], block_variances(in_blocks, inputs[1]).sqrt()
            stays = torch.from_numpy(fixed).unsqueeze(-1)
            kept = self._steps, self._std
            for buffer, smoothed, raw in zip(kept, (steps.relative, steps.std), own, strict=True):
                buffer.replace(changed, torch.where(stays, raw[0], smoothed[0])[changed - start :].numpy())

    def _near_unfamiliar(self, start: int) -> np.ndarray:
        """Which blocks from number ``start`` on lie so near to an unfamiliar frame that networks would see it."""
        unfamiliar = np.atleast_1d(~self._familiar.slice(start * self._block).reshape(-1, self._block).all(axis=1))
        reach = np.arange(-self._context, self._context + 1)
        near = (np.flatnonzero(unfamiliar)[:, None] + reach).ravel()
        found = np.zeros(len(unfamiliar), np.bool_)
        found[near[(near >= 0) & (near < len(found))]] = True
        return found

    def _slide(self) -> None:
        """Move the window by a block: its first node becomes a key frame."""
        node = self._first
        ends = torch.from_numpy(self._nodes.values[[node, node + 1]])
        relative, variance = se2.between(ends[0], ends[1]).numpy(), self._optimized_std.slice(node, node + 1)[0] ** 2
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
        return self._running is not None

    @torch.inference_mode()
    def begin(self) -> None:
        """Begin to optimise all nodes of the window and the key frames before it."""
        began = time.perf_counter()
        keys, first = self._keys.nodes, self._first
        relative = np.concatenate((self._keys.relative, self._steps.slice(first))).astype(np.float32)
        std = np.concatenate((np.sqrt(self._keys.variance), self._std.slice(first))).astype(np.float32)
        features = (
            torch.from_numpy(self._features.slice(first)).unsqueeze(0) if self._optimizer.config.network else None
        )
        steps = MetaSteps(
            torch.from_numpy(relative).unsqueeze(0), torch.from_numpy(std).unsqueeze(0), features, self.blocks - first
        )
        if (fixed := self._fixed.slice(first)).any():
            steps = replace(steps, fixed=torch.from_numpy(fixed.copy()).unsqueeze(0))
        loops, numbers = None, np.zeros(0, np.int64)
        if self._loops is not None:
            loops, numbers = self._loops.loops(keys, first, self.blocks)
        self._running = _Running(
            self._optimizer.iterate(steps, loops), self._optimizer.config.iterations, keys, first, numbers
        )
        self._running.took_s = time.perf_counter() - began

    @torch.inference_mode()
    def advance(self, iterations: int) -> bool:
        """Run so many iterations of what has begun; returns whether it is done, and every node at its new pose."""
        running = self._running
        if running is None:
            raise RuntimeError("no optimisation has begun")
        began = time.perf_counter()
        for _ in range(min(iterations, running.left)):
            running.result = next(running.iterations)
            running.left -= 1
        running.took_s += time.perf_counter() - began
        if running.left or running.result is None:
            return False
        end = self._scale * running.result.end_covariance()[0].numpy()
        poses = running.result.meta_relative[-1]
        if not (poses.isfinite().all() and np.isfinite(end).all() and (np.diagonal(end) > 0.0).all()):
            raise ArithmeticError("poses or their covariances came out as no numbers")
        self._running, self.took_s = None, running.took_s
        self._apply(running, running.result)
        self._pose, self._covariance = self._newest(end)
        self.optimized = True
        return True

    @property
    def unfinished(self) -> bool:
        """Whether an optimisation has begun that is not done."""
        return self.running

    def finish(self) -> bool:
        """Run what is left of an optimisation that has begun; returns whether there was one."""
        return self._running is not None and self.advance(self._running.left)

    def _apply(self, running: "_Running", result: OptimizedMetaPoses) -> None:
        keys, first = running.keys, running.first
        if self._loops is not None and result.loop_weights is not None and result.loop_information is not None:
            self.loop_frames, self.loop_relative = self._loops.edges(running.numbers)
            self.loop_std = result.loop_information[0].double().clamp(min=_LEAST_INFORMATION).rsqrt().numpy()
            self.loop_weights = result.loop_weights[0].double().numpy()
            self._loops.weigh(running.numbers, self.loop_weights)
        poses = se2.r2g(result.meta_relative[-1][0].double())
        poses[:, 2] = se2.wrap(poses[:, 2])
        self._active = np.concatenate((keys, np.arange(first, self.blocks + 1)))
        self._before = self._nodes.values[self._active]
        self._nodes.values[self._active[1:]] = poses.numpy()
        self._optimized_std.replace(first, result.step_std[0, len(keys) :].double().numpy())
        self._end, self._information = self._scale * result.end_covariance()[0].numpy(), result.equations
        self._result_keys, self._result_first, self._result_last = keys, first, self.blocks

    def abandon(self) -> None:
        """Leave undone what has begun."""
        self._running = None

    def fail(self, error: Exception, work: str = "an optimisation") -> None:
        """Leave undone what has begun, and keep why: every node is where it was."""
        self.fault = f"{work} failed, {type(error).__name__}: {' '.join(str(error).split())}"
        self.abandon()

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame and its covariance ``(3, 3)``."""
        return self._pose, self._covariance

    def frame_poses(self, before: bool = False) -> np.ndarray:
        """Poses ``(frames, 3)`` of all frames, as they are or as they were before the last optimisation."""
        nodes, odometry = torch.from_numpy(self.nodes(before)), torch.from_numpy(self.odometry.values)
        starts = odometry[: len(nodes) * self._block : self._block].unsqueeze(1)
        whole = (len(nodes) - 1) * self._block
        in_blocks = se2.between(starts[:-1], odometry[1 : whole + 1].unflatten(0, (-1, self._block))).unsqueeze(0)
        steps = se2.between(nodes[:-1], nodes[1:]).unsqueeze(0)
        corrected = se2.compose(nodes[:-1].unsqueeze(1), in_block_poses(in_blocks, steps)[0]).flatten(0, 1)
        tail = se2.compose(nodes[-1:], se2.between(starts[-1], odometry[whole + 1 :]))
        poses: np.ndarray = torch.cat((nodes[:1], corrected, tail)).numpy()
        return poses

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
        odometry = torch.from_numpy(self.odometry.values[whole:])
        poses = se2.compose(torch.from_numpy(self._nodes.values[-1]), se2.between(odometry[0], odometry)).numpy()
        steps, log_std = (rows.slice(whole).astype(np.float64) for rows in (self._relative, self._log_std))
        for pose, step, deviation in zip(poses[1:], steps, log_std, strict=True):
            covariance = propagate(covariance, pose, step, np.diag(np.exp(2.0 * deviation)))
        return poses[-1], covariance

    def _buffers(self) -> dict[str, SlidingRows]:
        rows = (
            self._relative, self._log_std, self._motion, self._steps, self._std, self._optimized_std, self._features,
            self._familiar, self._fixed,
        )  # fmt: skip
        return dict(zip(_BUFFERS, rows, strict=True))

    def state(self) -> Arrays:
        """All that later steps depend on, for ``restore``.

        Of an optimisation in progress that is the number of its iterations: nothing that it began with has changed.
        """
        running, code = self._running, self._origin_code
        done = -1 if running is None else self._optimizer.config.iterations - running.left
        arrays = {
            "odometry": self.odometry.values,
            "pose": self._pose,
            "covariance": self._covariance,
            "nodes": self._nodes.values,
            "first": np.array(self._first),
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
            "origin_code": np.zeros(0, np.float32) if code is None else code,
            "iterations": np.array(done),
            **under("keys", self._keys.state()),
        }
        for name, rows in self._buffers().items():
            arrays |= under(name, rows.state())
        if self._information is not None:
            arrays |= under("information", self._information.state())
        return arrays if self._loops is None else arrays | under("loops", self._loops.state())

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()`` into a graph without any frame; raises ``StateError``."""
        self.odometry.restore(arrays, "odometry")
        self._nodes.restore(arrays, "nodes")
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
        code = taken(arrays, "origin_code", np.float32, -1)
        self._origin_code = code if len(code) else None
        information = part(arrays, "information")
        self._information = FactorisedInformation.from_state(information) if information else None
        if self._loops is not None:
            self._loops.restore(part(arrays, "loops"))
        self._check()
        done = taken_integer(arrays, "iterations", -1)
        require(done < self._optimizer.config.iterations, f"an optimisation has run {done} iterations already")
        if done >= 0:
            self.begin()
            self.advance(done)

    def _check(self) -> None:
        """Raise ``StateError`` where the parts of a restored state do not belong together."""
        frames, blocks, counted = len(self.odometry) - 1, self.blocks, self._buffers()
        require(
            frames // self._block == blocks
            and {len(counted[name]) for name in _BUFFERS[:3]} == {frames}
            and {len(counted[name]) for name in _BUFFERS[3:6]} == {blocks},
            f"{frames} steps and {blocks} meta-poses do not belong together",
        )
        require(
            0 <= self._result_first <= self._result_last <= blocks
            and self._first == (self._keys.nodes[-1] + 1 if len(self._keys) else 0)
            and len(self._kept) <= len(self._keys)
            and bool((self.loop_frames >= 0).all() and (self.loop_frames <= frames).all()),
            "nodes or key frames are named that are not there",
        )
