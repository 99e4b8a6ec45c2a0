"""The odometry of a graph of meta-poses: steps, and the blocks of steps between its nodes."""

from collections.abc import Callable

import numpy as np
import torch

from ngo_estimator.data.row_buffers import GrowingRows, SlidingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.graph.key_frames import KeyFrames
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.ngo.pose_aggregation import block_variances, poses_in_blocks
from ngo_estimator.ngo.registered_odometry import registered_steps
from ngo_estimator.slam.step_log import StepLog

_NOTICED_LATE = 16
"""Frames before the first unfamiliar one that were taken for familiar and may not have been: their mean decides."""

_STD = (1e-6, 1e2)
"""What a step's deviation is limited to (m or rad)."""


class OdometryBlocks:
    """Takes steps, and makes blocks of them, which it states in the graph: registered, aggregated and smoothed.

    Networks leave blocks near unfamiliar frames as they are.

    Args:
        log: of the steps as they came.
        graph: its last nodes are the ends of the last blocks; their owner appends the frames.
        keys: before the window; steps from them stay as they are.
    """

    def __init__(
        self,
        optimizer: NeuralGraphOptimizer,
        pair_head: PairHead | None,
        window: int,
        log: Callable[[], StepLog],
        graph: PoseGraph,
        keys: KeyFrames,
    ) -> None:
        self._optimizer, self._pair_head = optimizer, pair_head
        self._block, self._context = optimizer.block, optimizer.config.context
        self._scale = optimizer.config.covariance_scale
        self._log, self._graph, self._keys = log, graph, keys
        registers = pair_head is not None and pair_head.config.registers_odometry
        self.registrations = optimizer.config.registrations if registers else 0
        """Of each step; 0: steps stay as they came."""
        config = optimizer.config.aggregation
        recalled = -(-_NOTICED_LATE // self._block) + 1
        steps_kept = (2 * self._context + 2 + recalled) * self._block
        self._relative = SlidingRows((3,), np.float32, steps_kept)
        self._log_std = SlidingRows((3,), np.float32, steps_kept)
        self._motion = SlidingRows((config.motion_feature_size,), np.float32, steps_kept)
        self._familiar = SlidingRows((), np.bool_, steps_kept)
        blocks_kept = max(window, self._context) + 2
        self.optimized_std = SlidingRows((3,), np.float64, blocks_kept)
        """Deviations with which the last optimisation believed each block."""
        self.features = SlidingRows((config.width,), np.float32, blocks_kept)
        """Of each block; without a network there are none."""
        self.fixed = SlidingRows((), np.bool_, blocks_kept)
        """Whether networks leave a block as it is."""
        self._blind = GrowingRows((3,), np.float64)
        self._recalled = 0  # block from which on frames turned out to be unfamiliar

    @property
    def steps(self) -> int:
        """Steps so far."""
        return len(self._relative)

    @property
    def blocks(self) -> int:
        """Whole blocks so far."""
        return len(self.fixed)

    @property
    def blind(self) -> np.ndarray:
        """Variance of the unfamiliar steps of each block ``(blocks, 3)``."""
        return self._blind.values

    @property
    def is_familiar(self) -> bool:
        """Whether there is a newest frame, and it is familiar."""
        return len(self._familiar) > 0 and bool(self._familiar.slice(len(self._familiar) - 1)[0])

    def append(self, relative: np.ndarray, variance: np.ndarray, motion: np.ndarray, familiar: bool) -> None:
        """Take a step ``(3,)``, that to the newest of the frames."""
        self._relative.append(relative)
        self._log_std.append(0.5 * np.log(variance))
        self._motion.append(motion)
        self._familiar.append(familiar)

    def register(self, codes: np.ndarray, code_before: np.ndarray | None) -> None:
        """Measure the newest steps again, those behind the last whole block.

        Args:
            codes: place codes ``(block, code_length)`` of their frames; code_before: of the frame before them.
        """
        first = self.blocks * self._block
        if self._pair_head is None or self.registrations == 0 or not self._familiar.slice(first).all():
            return
        if self._graph.frames.last_join > first:
            return  # the frames were seen from two places
        before = None if code_before is None else torch.from_numpy(code_before).unsqueeze(0)
        rows = self._relative.slice(first), self._log_std.slice(first), codes
        steps, deviations, of_frames = (torch.from_numpy(values).unsqueeze(0) for values in rows)
        relative, log_std = registered_steps(
            self._pair_head, steps, deviations, of_frames, self._block, self.registrations, before
        )
        self._relative.replace(first, relative[0].numpy())
        self._log_std.replace(first, log_std[0].numpy())
        odometry = torch.from_numpy(self._graph.frames.odometry)
        odometry[first + 1 :] = se2.compose(odometry[first], se2.r2g(relative[0].double()))

    def complete(self) -> None:
        """Make a block of the newest steps, and its end a node."""
        in_block, std = self._in_blocks(self.blocks * self._block)
        self._blind.append(self._blind_variance(self.blocks))
        self.optimized_std.append(std[0])
        self.fixed.append(False)
        self._graph.add_node()
        self._state(self.blocks - 1, in_block[0, :, -1], std)

    def _state(self, first: int, relative: torch.Tensor, std: torch.Tensor) -> None:
        """State the blocks from number ``first`` on in the graph, with relative poses and deviations ``(n, 3)``."""
        node = first + len(self._graph) - 1 - self.blocks
        left = max(0, len(self._keys) - node)  # so many lie before the window by now
        self._graph.restate(node + left, relative[left:].numpy(), std[left:].double().square().numpy())

    def _in_blocks(self, first: int, stop: int | None = None) -> tuple[torch.Tensor, torch.Tensor]:
        """Poses within the blocks of steps from number ``first`` on, and the deviations ``(blocks, 3)`` of blocks."""
        rows = self._relative.slice(first, stop), self._log_std.slice(first, stop)
        relative, log_std = (torch.from_numpy(values).unsqueeze(0) for values in rows)
        in_block = poses_in_blocks(relative, self._block)
        return in_block, block_variances(in_block, log_std).sqrt()[0]

    def recall(self) -> int:
        """Take the newest frames back, which were taken for familiar; returns the number of their first step."""
        first = max(0, len(self._familiar) - _NOTICED_LATE)
        self._familiar.slice(first)[:] = False
        self._recalled = min(first // self._block, self.blocks)
        if self.registrations and self._recalled < self.blocks:
            self._unregister(self._recalled)
        for block in range(self._recalled, self.blocks):
            self.blind[block] = self._blind_variance(block)
        return first

    def _unregister(self, first: int) -> None:
        """Take the steps from block ``first`` on as the odometry had them."""
        log, began = self._log(), first * self._block
        odometry, std = log.odometry.values[began : len(self._relative) + 1], log.odometry_std.values[began:]
        relative = se2.between(torch.from_numpy(odometry[:-1]), torch.from_numpy(odometry[1:]))
        self._relative.replace(began, relative.numpy())
        self._log_std.replace(began, np.log(std[: len(relative)].clip(*_STD)))
        own = torch.from_numpy(self._graph.frames.odometry)
        own[began + 1 :] = se2.compose(own[began], se2.r2g(relative))
        in_block, block_std = self._in_blocks(began, self.blocks * self._block)
        self._state(first, in_block[0, :, -1], block_std)

    def _blind_variance(self, block: int) -> np.ndarray:
        """Variance ``(3,)`` of the unfamiliar steps of a block, as the odometry has it."""
        ends = block * self._block, (block + 1) * self._block
        log_std, familiar = (rows.slice(*ends) for rows in (self._log_std, self._familiar))
        variance: np.ndarray = np.exp(2.0 * log_std.astype(np.float64))[~familiar].sum(axis=0) * self._scale
        return variance

    def aggregate(self) -> None:
        """Features and smoothed odometry of the blocks that the newest one changes, and of itself."""
        block = self.blocks - 1
        if not self._optimizer.config.network and self._optimizer.config.smoother is None:
            return
        changed = max(0, min(block, self._recalled) - self._context)
        self._recalled = block + 1
        start = max(0, changed - self._context)
        ends = start * self._block, (block + 1) * self._block
        inputs = (torch.from_numpy(rows.slice(*ends)) for rows in (self._relative, self._log_std, self._motion))
        steps = self._optimizer.aggregate(*(rows.unsqueeze(0) for rows in inputs))
        if steps.features is not None:
            self.features.replace(changed, steps.features[0, changed - start :].numpy())
        familiar = self._familiar.slice(*ends).reshape(-1, self._block)
        fixed = _near(np.atleast_1d(~familiar.all(axis=1)), self._context)
        self.fixed.replace(changed, fixed[changed - start :])
        if self._optimizer.config.smoother is not None:
            in_blocks, std = self._in_blocks(*ends)
            stays = torch.from_numpy(fixed).unsqueeze(-1)
            raw, smooth = (in_blocks[0, :, -1], std), (steps.relative[0], steps.std[0])
            stated = (torch.where(stays, *both)[changed - start :] for both in zip(raw, smooth, strict=True))
            self._state(changed, *stated)

    _OF_STEPS = ("_relative", "_log_std", "_motion", "_familiar")
    _OF_BLOCKS = ("optimized_std", "fixed")
    SAVED = (*_OF_STEPS, *_OF_BLOCKS, "_blind", "_recalled", "features")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        steps, blocks = self.steps, self.blocks
        require(
            steps // self._block == blocks == len(self._blind)
            and {len(getattr(self, name)) for name in self._OF_STEPS} == {steps}
            and {len(getattr(self, name)) for name in self._OF_BLOCKS} == {blocks}
            and len(self._graph.frames) == steps + 1
            and self._graph.frames.nodes[-1] == self._block * blocks,
            f"{steps} steps and {blocks} meta-poses do not belong together",
        )
        require(self._recalled >= 0, f"frames are recalled from meta-pose {self._recalled} on")


def _near(found: np.ndarray, reach: int) -> np.ndarray:
    """Which of ``n`` rows ``(n,)`` are one of those ``found``, or at most ``reach`` rows away from one."""
    rows = (np.flatnonzero(found)[:, None] + np.arange(-reach, reach + 1)).ravel()
    near = np.zeros(len(found), np.bool_)
    near[rows[(rows >= 0) & (rows < len(found))]] = True
    return near
