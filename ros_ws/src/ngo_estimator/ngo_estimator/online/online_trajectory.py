"""The online trajectory: relative poses in, the whole corrected trajectory out (no ROS here)."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import CheckpointError, load_optimizer, load_place
from ngo_estimator.data.relative_step import (
    LARGEST_VALUE,
    RESTART_AFTER_NS,
    DuplicateStep,
    LateStep,
    RelativeStep,
    check_step,
)
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.networks.pose_aggregation import in_block_poses
from ngo_estimator.online.meta_graph import MetaGraph
from ngo_estimator.optimizer.meta_poses import OptimizedTrajectory
from ngo_estimator.optimizer.neural_graph_optimizer import NeuralGraphOptimizer

_VARIANCES = (1e-12, 1e4)  # what lies below or above is as good as exact or unknown, and float32 has no room for it


@dataclass(frozen=True)
class TrajectoryUpdate:
    """What a step changed; its size does not depend on how long the trajectory is.

    ``pose_xyyaw`` (3,) of the newest frame, corrected, in ``map``, whose origin is the first frame, with its
    ``covariance`` (3, 3), that of the first frame being zero; ``map_from_odom_xyyaw`` (3,). ``frames``
    counts all of the trajectory. ``optimized`` says whether this step ended an optimisation, ``restarted`` whether it
    began a new trajectory, ``gap`` whether steps before it were lost and composed from the odometry.
    ``largest_move_m`` is how far this step moved a pose at most, ``closed_loops`` how many loop candidates the
    optimizer believes (a weight over one half), ``window_fill`` the share of the window that is in use. ``fault`` says
    what failed inside, empty where nothing did: the trajectory goes on by odometry then. The arrays are read-only and
    stay as they are.
    """

    stamp_ns: int
    pose_xyyaw: np.ndarray
    covariance: np.ndarray
    map_from_odom_xyyaw: np.ndarray
    frames: int
    optimized: bool
    restarted: bool
    gap: bool
    largest_move_m: float
    closed_loops: int
    window_fill: float
    fault: str = ""


@dataclass(frozen=True)
class Trajectory:
    """The whole trajectory: ``n`` frames, the first at the origin of ``map``.

    ``stamps_ns`` (n,) int64; ``poses_xyyaw`` (n, 3) corrected, in ``map``; ``odometry_xyyaw`` (n, 3) as the local
    odometry has it; ``online_xyyaw`` (n, 3) each corrected pose as it was when its frame was the newest; ``moved_m``
    (n,) how far the last step moved each pose; ``odometry_std`` (n - 1, 3) of what leads from each frame to the next.
    ``loops`` (e, 2) frame indices, earlier first, with ``loop_weights`` (e,) of zero to one, ``loop_relative_xyyaw``
    (e, 3), the later frame as it was seen from the earlier one, and ``loop_std`` (e, 3) in which the weight is
    accounted for. The arrays are read-only and stay as they are.
    """

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray
    odometry_xyyaw: np.ndarray
    online_xyyaw: np.ndarray
    moved_m: np.ndarray
    odometry_std: np.ndarray
    loops: np.ndarray
    loop_weights: np.ndarray
    loop_relative_xyyaw: np.ndarray
    loop_std: np.ndarray


class OnlineTrajectory:
    """Keeps the trajectory and re-optimises it whenever a meta-pose is complete.

    Between two meta-poses the newest frames follow the last corrected one by odometry. The last ``window_frames`` are
    optimised together; up to so many steps the result is that of ``optimize_offline``, but for overlaps, which are
    looked for under the poses of then. Of the poses before, at most ``key_frames`` (and a few more for a while) are
    optimised with them; all others move with these, and loops are closed with their frames. So the cost of a step does
    not depend on how long the trajectory is.

    An optimisation takes several iterations. All are run at the step that completes a meta-pose, or, so that no step
    takes much longer than the others, ``iterations_per_step`` at it and at each of those after it: the same result, a
    few steps later.
    """

    def __init__(
        self,
        optimizer: NeuralGraphOptimizer,
        pair_head: PairHead | None,
        window_frames: int = 2000,
        key_frames: int = 128,
        iterations_per_step: int = 0,
    ) -> None:
        block = optimizer.config.aggregation.block
        if window_frames < 2 * block:
            raise ValueError(f"window_frames is {window_frames}; expected at least {2 * block}, two meta-poses")
        if key_frames < 2:
            raise ValueError(f"key_frames is {key_frames}; expected at least 2")
        if optimizer.config.loops and pair_head is None:
            raise ValueError("an optimizer with loops needs a pair head")
        if optimizer.config.registrations and (pair_head is None or pair_head.config.registration is None):
            raise ValueError("an optimizer that registers ranges needs a pair head whose codes hold them")
        registers = optimizer.config.registrations and pair_head is not None and pair_head.config.registers_odometry
        if registers and optimizer.config.smoother is not None:
            raise ValueError(
                "a smoother learned from steps that are not registered; expected a registration of loops alone"
            )
        self._optimizer, self._pair_head = optimizer.eval(), pair_head
        self._block = block
        self._window = window_frames // block * block
        if iterations_per_step < 0:
            raise ValueError(f"iterations_per_step is {iterations_per_step}; expected 0 (all at once) or more")
        self._code_length = None if pair_head is None else pair_head.config.code_length
        self._key_frames = key_frames
        iterations = optimizer.config.iterations
        # An optimisation must be done when the next one begins, a block later.
        self._iterations_per_step = (
            max(iterations_per_step, -(-iterations // block)) if iterations_per_step else iterations
        )
        self.reset()

    @classmethod
    def load(
        cls,
        weights: Path,
        window_frames: int = 2000,
        world: str | None = None,
        key_frames: int = 128,
        iterations_per_step: int = 0,
    ) -> "OnlineTrajectory":
        """Load the networks in the folder ``weights``; raises ``CheckpointError``, of one clear line."""
        optimizer, description = load_optimizer(weights, world)
        if not optimizer.config.loops:
            return cls(optimizer, None, window_frames, key_frames, iterations_per_step)
        place, place_description = load_place(weights, description["world"])
        expected = description.get("place_encoder_sha256", place_description["sha256"])
        if place_description["sha256"] != expected:
            raise CheckpointError(
                f"{weights}: the optimizer was trained with another place encoder than the one beside it"
            )
        return cls(optimizer, place.pair_head, window_frames, key_frames, iterations_per_step)

    @property
    def block(self) -> int:
        """Steps in a meta-pose: the optimizer runs once in so many steps."""
        return self._block

    @property
    def window_frames(self) -> int:
        """Steps that are optimised together."""
        return self._window

    def reset(self) -> None:
        """Forget everything: the next step begins a new trajectory."""
        self._stamps = GrowingRows((), np.int64)
        self._odometry = GrowingRows((3,), np.float64)
        self._odometry_std = GrowingRows((3,), np.float32)
        self._online = GrowingRows((3,), np.float64)
        self._graph = MetaGraph(self._optimizer, self._pair_head, self._window // self._block, self._key_frames)
        self._origin_stamp_ns = 0
        self._last_odom = np.zeros(3)
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._optimized = False

    @property
    def _count(self) -> int:
        """Steps so far."""
        return max(0, len(self._stamps) - 1)

    def update(self, step: RelativeStep, optimize: bool = True) -> TrajectoryUpdate:
        """Take the next step.

        A step that begins after the last frame means lost steps: the motion between is composed from the odometry
        poses. A step of an odometry with another origin begins a new trajectory, for the motion between is unknown;
        so does one that lies ``RESTART_AFTER_NS`` or more in the past, or ``LARGEST_VALUE`` away. Without ``optimize``
        the newest frame follows the one before it by odometry alone; the next meta-pose that is optimised takes all of
        them in.

        Raises:
            RejectedStep: values that are not finite, too large or of the wrong shape, a stamp that came already, or one
                that is a little late. The trajectory is as it was before.
        """
        check_step(step, self._optimizer.config.aggregation.motion_feature_size, self._code_length)
        restarted, gap = False, False
        relative, variance = step.relative_xyyaw, np.diagonal(step.covariance)
        if self._count:
            last = int(self._stamps.values[-1])
            if step.stamp_ns <= last - RESTART_AFTER_NS or step.origin_stamp_ns != self._origin_stamp_ns:
                self.reset()
                restarted = True
            elif step.stamp_ns <= last:
                kind = DuplicateStep if step.stamp_ns == last else LateStep
                raise kind(f"step to {step.stamp_ns} ns came when the trajectory was at {last} ns already")
            elif step.from_stamp_ns != last:
                relative, variance = self._over_gap(step, last)
                gap = bool(np.abs(relative).max() <= LARGEST_VALUE)
                if not gap:  # it would be so at every step to come
                    self.reset()
                    restarted, relative, variance = True, step.relative_xyyaw, np.diagonal(step.covariance)
        if self._count == 0:
            self._begin(step)
        completed = self._append(step, relative, np.clip(variance, *_VARIANCES))
        self._optimized = False
        if not optimize:
            self._graph.abandon()
        elif completed:
            self._graph.begin()
        if self._graph.running:
            self._optimized = self._advance(self._iterations_per_step)
        self._online.append(self._pose)
        return self._result(restarted, gap)

    def _advance(self, iterations: int) -> bool:
        done = self._graph.advance(iterations)
        if done:
            self._pose, self._covariance = self._graph.newest()
        return done

    @property
    def unfinished(self) -> bool:
        """Whether an optimisation has begun that later steps, or ``finish``, are to end."""
        return self._graph.running

    @property
    def optimization_s(self) -> float:
        """Computing time of the last optimisation that was ended, over all steps that it was spread over."""
        return self._graph.took_s

    def finish(self) -> TrajectoryUpdate | None:
        """Run what is left of an optimisation that has begun, when no more steps come; None where there is none."""
        if not self._graph.running:
            return None
        self._optimized = self._advance(self._optimizer.config.iterations)
        return self._result(restarted=False, gap=False)

    def trajectory(self) -> Trajectory | None:
        """The whole trajectory as it is now, or None before the first step."""
        if self._count == 0:
            return None
        graph = self._graph
        poses, moved = self._poses(graph.nodes()), np.zeros(self._count + 1)
        if self._optimized:
            moved[:-1] = np.linalg.norm((poses - self._poses(graph.nodes(before=True)))[:-1, :2], axis=1)
        return Trajectory(
            stamps_ns=_read_only(self._stamps.values),
            poses_xyyaw=_read_only(poses),
            odometry_xyyaw=_read_only(self._odometry.values),
            online_xyyaw=_read_only(self._online.values),
            moved_m=_read_only(moved),
            odometry_std=_read_only(self._odometry_std.values),
            loops=_read_only(graph.loop_frames),
            loop_weights=_read_only(graph.loop_weights),
            loop_relative_xyyaw=_read_only(graph.loop_relative),
            loop_std=_read_only(graph.loop_std),
        )

    def _poses(self, node_poses: np.ndarray) -> np.ndarray:
        """Poses of all frames ``(steps + 1, 3)`` with these nodes; within blocks as ``frame_poses`` has them."""
        nodes, odometry = torch.from_numpy(node_poses), torch.from_numpy(self._graph.odometry.values)
        starts = odometry[: len(nodes) * self._block : self._block].unsqueeze(1)
        whole = (len(nodes) - 1) * self._block
        in_blocks = se2.between(starts[:-1], odometry[1 : whole + 1].unflatten(0, (-1, self._block))).unsqueeze(0)
        steps = se2.between(nodes[:-1], nodes[1:]).unsqueeze(0)
        corrected = se2.compose(nodes[:-1].unsqueeze(1), in_block_poses(in_blocks, steps)[0]).flatten(0, 1)
        tail = se2.compose(nodes[-1:], se2.between(starts[-1], odometry[whole + 1 :]))
        return torch.cat((nodes[:1], corrected, tail)).numpy()

    def _over_gap(self, step: RelativeStep, last_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Relative pose and variances from the last frame that is known to the one of ``step``.

        The variance of the step stands for all that were lost, in proportion to the time that they took.
        """
        odom = torch.from_numpy(np.stack((self._last_odom, step.odom_xyyaw)))
        relative = se2.between(odom[0], odom[1]).numpy()
        longer = (step.stamp_ns - last_ns) / (step.stamp_ns - step.from_stamp_ns)
        return relative, np.diagonal(step.covariance) * max(longer, 1.0)

    def _begin(self, step: RelativeStep) -> None:
        self._origin_stamp_ns = step.origin_stamp_ns
        odom = torch.from_numpy(step.odom_xyyaw)
        before = se2.compose(odom, se2.inverse(torch.from_numpy(step.relative_xyyaw)))
        if self._pair_head is not None:
            self._graph.begin_at(step.from_place_code)
        self._stamps.append(step.from_stamp_ns)
        self._odometry.append(before.numpy())
        self._online.append(np.zeros(3))

    def _append(self, step: RelativeStep, relative: np.ndarray, variance: np.ndarray) -> bool:
        code = step.place_code if self._pair_head is not None else np.zeros(0, np.float32)
        self._pose = se2.compose(torch.from_numpy(self._pose), torch.from_numpy(relative.astype(np.float64))).numpy()
        self._covariance = propagate(self._covariance, self._pose, relative, np.diag(variance))
        completed = self._graph.append(relative, 0.5 * np.log(variance), step.motion_feature, code)
        self._stamps.append(step.stamp_ns)
        self._odometry.append(step.odom_xyyaw)
        self._odometry_std.append(np.sqrt(variance))
        self._last_odom = np.array(step.odom_xyyaw)
        return completed

    def _result(self, restarted: bool, gap: bool) -> TrajectoryUpdate:
        graph = self._graph
        map_from_odom = se2.compose(torch.from_numpy(self._pose), se2.inverse(torch.from_numpy(self._last_odom)))
        return TrajectoryUpdate(
            stamp_ns=int(self._stamps.values[-1]),
            pose_xyyaw=_read_only(self._pose.copy()),
            covariance=_read_only(0.5 * (self._covariance + self._covariance.T)),
            map_from_odom_xyyaw=_read_only(map_from_odom.numpy()),
            frames=self._count + 1,
            optimized=self._optimized,
            restarted=restarted,
            gap=gap,
            largest_move_m=graph.largest_move_m if self._optimized else 0.0,
            closed_loops=int((graph.loop_weights > 0.5).sum()),
            window_fill=graph.window_fill,
        )


@torch.inference_mode()
def optimize_offline(
    optimizer: NeuralGraphOptimizer,
    pair_head: PairHead | None,
    relative: Tensor,
    log_std: Tensor,
    motion_features: Tensor,
    place_codes: Tensor,
    origin_code: Tensor | None = None,
) -> OptimizedTrajectory:
    """Optimise one trajectory ``(steps, ...)`` of any number of steps; those after the last whole block follow it.

    Arguments as in ``NeuralGraphOptimizer``, without the batch; ``pair_head`` with loops only, and ``origin_code``
    ``(1, code_length)``, the place code of the first frame, where it is known. ``poses`` of the result is ``(1, steps,
    3)``.
    """
    steps = relative.shape[0]
    block = optimizer.config.aggregation.block
    whole = steps // block * block
    if whole == 0:
        raise ValueError(f"{steps} steps make no meta-pose; expected at least {block}")
    inputs = [value[:whole].unsqueeze(0).float() for value in (relative, log_std, motion_features, place_codes)]
    loops = None
    if optimizer.config.loops:
        if pair_head is None:
            raise ValueError("an optimizer with loops needs a pair head")
        origin = None if origin_code is None else origin_code.float()
        inputs[:2] = optimizer.registered(inputs[0], inputs[1], inputs[3], pair_head, origin)
        loops = optimizer.find_loops(inputs[0], inputs[3], pair_head)
    result: OptimizedTrajectory = optimizer(*inputs[:3], loops)
    if whole == steps:
        return result
    tail = se2.compose(result.poses[:, -1:], se2.r2g(relative[whole:].unsqueeze(0).float()))
    return replace(result, poses=torch.cat((result.poses, tail), dim=1))


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view
