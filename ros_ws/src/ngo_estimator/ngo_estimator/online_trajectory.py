"""The online trajectory: relative poses in, the whole corrected trajectory out (no ROS here)."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from ngo_estimator import se2
from ngo_estimator.checkpoint import CheckpointError, load_optimizer, load_place
from ngo_estimator.local_odometry import RESTART_AFTER_NS
from ngo_estimator.neural_graph_optimizer import NeuralGraphOptimizer, OptimizedTrajectory
from ngo_estimator.place_encoder import PairHead
from ngo_estimator.planar_covariance import propagate

LARGEST_VALUE = 1e4
"""Largest size of a coordinate (m, rad), feature or code: beyond it the optimizer's float32 has no room to compute."""

LARGEST_ODOMETRY = 1e9
"""Largest size of a coordinate (m, rad) of the pose in ``odom``, which enters in float64 only."""

_VARIANCES = (1e-12, 1e4)  # what lies below or above is as good as exact or unknown, and float32 has no room for it


class RejectedStep(ValueError):
    """A relative pose that cannot be used; the trajectory is as it was before."""


class DuplicateStep(RejectedStep):
    """A step to the frame that is the newest already."""


class LateStep(RejectedStep):
    """A step to a frame that is a little older than the newest one."""


@dataclass(frozen=True)
class RelativeStep:
    """One step of the local odometry; the fields are those of ``LocalEstimate``."""

    stamp_ns: int
    from_stamp_ns: int
    relative_xyyaw: np.ndarray
    covariance: np.ndarray
    origin_stamp_ns: int
    odom_xyyaw: np.ndarray
    motion_feature: np.ndarray
    place_code: np.ndarray


@dataclass(frozen=True)
class TrajectoryUpdate:
    """What a step changed; its size does not depend on how long the trajectory is.

    ``pose_xyyaw`` (3,) of the newest frame, corrected, in ``map``, whose origin is the first frame, with its
    ``covariance`` (3, 3), as if the pose where the window begins were exact; ``map_from_odom_xyyaw`` (3,). ``frames``
    counts all of the trajectory. ``optimized`` says whether this step ran the optimizer, ``restarted`` whether it
    began a new trajectory, ``gap`` whether steps before it were lost and composed from the odometry.
    ``largest_move_m`` is how far this step moved a pose at most, ``closed_loops`` how many loop candidates the
    optimizer believes (a weight over one half), ``window_fill`` the share of the window that is in use. The arrays are
    read-only and stay as they are.
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


@dataclass(frozen=True)
class Trajectory:
    """The whole trajectory: ``n`` frames, the first at the origin of ``map``.

    ``stamps_ns`` (n,) int64; ``poses_xyyaw`` (n, 3) corrected, in ``map``; ``odometry_xyyaw`` (n, 3) as the local
    odometry has it; ``online_xyyaw`` (n, 3) each corrected pose as it was when its frame was the newest; ``moved_m``
    (n,) how far the last step moved each pose; ``loops`` (e, 2) frame indices, earlier first, with ``loop_weights``
    (e,) of zero to one. The arrays are read-only and stay as they are.
    """

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray
    odometry_xyyaw: np.ndarray
    online_xyyaw: np.ndarray
    moved_m: np.ndarray
    loops: np.ndarray
    loop_weights: np.ndarray


class OnlineTrajectory:
    """Keeps the trajectory and re-optimises it whenever a meta-pose is complete.

    Between two meta-poses the newest frames follow the last corrected one by odometry. After ``n`` steps the result
    is that of ``optimize_offline`` on the first ``n``. Only the last ``window_frames`` are optimised: older poses
    stay where they were when they left the window.
    """

    def __init__(self, optimizer: NeuralGraphOptimizer, pair_head: PairHead | None, window_frames: int = 2000) -> None:
        block = optimizer.config.aggregation.block
        if window_frames < 2 * block:
            raise ValueError(f"window_frames is {window_frames}; expected at least {2 * block}, two meta-poses")
        if optimizer.config.loops and pair_head is None:
            raise ValueError("an optimizer with loops needs a pair head")
        self._optimizer, self._pair_head = optimizer.eval(), pair_head
        self._block = block
        self._window = window_frames // block * block
        self.reset()

    @classmethod
    def load(cls, weights: Path, window_frames: int = 2000, world: str | None = None) -> "OnlineTrajectory":
        """Load the networks in the folder ``weights``; raises ``CheckpointError``, of one clear line."""
        optimizer, description = load_optimizer(weights, world)
        if not optimizer.config.loops:
            return cls(optimizer, None, window_frames)
        place, place_description = load_place(weights, description["world"])
        expected = description.get("place_encoder_sha256", place_description["sha256"])
        if place_description["sha256"] != expected:
            raise CheckpointError(
                f"{weights}: the optimizer was trained with another place encoder than the one beside it"
            )
        return cls(optimizer, place.pair_head, window_frames)

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
        self._count = 0  # steps
        self._window_start = 0  # first step in the window, at a boundary of blocks
        self._stamps = _Rows((), np.int64)
        self._poses = _Rows((3,), np.float64)
        self._odometry = _Rows((3,), np.float64)
        self._online = _Rows((3,), np.float64)
        self._moved = np.zeros(0)
        self._relative = _Rows((3,), np.float32)
        self._log_std = _Rows((3,), np.float32)
        self._motion: _Rows | None = None
        self._codes: _Rows | None = None
        self._origin_stamp_ns = 0
        self._last_odom = np.zeros(3)
        self._loops = np.zeros((0, 2), np.int64)
        self._loop_weights = np.zeros(0)
        self._covariance = np.zeros((3, 3))

    def update(self, step: RelativeStep, optimize: bool = True) -> TrajectoryUpdate:
        """Take the next step.

        A step that begins after the last frame means lost steps: the motion between is composed from the odometry
        poses. A step of an odometry with another origin begins a new trajectory, for the motion between is unknown;
        so does one that lies ``RESTART_AFTER_NS`` or more in the past. Without ``optimize`` the newest frame follows the
        one before it by odometry alone; the next meta-pose that is optimised takes all of them in.

        Raises:
            RejectedStep: values that are not finite, too large or of the wrong shape, a stamp that came already, or one
                that is a little late. The trajectory is as it was before.
        """
        self._check(step)
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
                gap = True
        if self._count == 0:
            self._begin(step)
        self._append(step, relative, np.clip(variance, *_VARIANCES))
        optimized = optimize and self._count % self._block == 0
        self._moved = np.zeros(self._count + 1)
        if optimized:
            self._moved[:-1] = self._optimize()
        self._online.append(self._poses.values[-1])
        return self._result(optimized, restarted, gap)

    def trajectory(self) -> Trajectory | None:
        """The whole trajectory as it is now, or None before the first step."""
        if self._count == 0:
            return None
        return Trajectory(
            stamps_ns=self._stamps.frozen(),
            poses_xyyaw=self._poses.frozen(),
            odometry_xyyaw=self._odometry.frozen(),
            online_xyyaw=self._online.frozen(),
            moved_m=_read_only(self._moved),
            loops=_read_only(self._loops),
            loop_weights=_read_only(self._loop_weights),
        )

    def _check(self, step: RelativeStep) -> None:
        config = self._optimizer.config
        vectors = {
            "relative_xyyaw": (step.relative_xyyaw, (3,)),
            "covariance": (step.covariance, (3, 3)),
            "odom_xyyaw": (step.odom_xyyaw, (3,)),
            "motion_feature": (step.motion_feature, (config.aggregation.motion_feature_size,)),
        }
        if self._pair_head is not None:
            vectors["place_code"] = (step.place_code, (self._pair_head.config.code_size,))
        for name, (value, shape) in vectors.items():
            if value.shape != shape:
                raise RejectedStep(f"{name} is of shape {value.shape}; expected {shape}")
            if not np.isfinite(value).all():
                raise RejectedStep(f"{name} has values that are not finite")
            if name != "covariance":
                _check_size(name, value, LARGEST_ODOMETRY if name == "odom_xyyaw" else LARGEST_VALUE)
        if not (np.diagonal(step.covariance) > 0.0).all():
            raise RejectedStep(
                f"covariance has the variances {np.diagonal(step.covariance).tolist()}; expected positive ones"
            )
        if step.from_stamp_ns >= step.stamp_ns:
            raise RejectedStep(f"step goes from {step.from_stamp_ns} ns to {step.stamp_ns} ns; expected a later end")

    def _over_gap(self, step: RelativeStep, last_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Relative pose and variances from the last frame that is known to the one of ``step``.

        The variance of the step stands for all that were lost, in proportion to the time that they took.
        """
        odom = torch.from_numpy(np.stack((self._last_odom, step.odom_xyyaw)))
        relative = se2.between(odom[0], odom[1]).numpy()
        _check_size("the motion over lost steps", relative, LARGEST_VALUE)
        longer = (step.stamp_ns - last_ns) / (step.stamp_ns - step.from_stamp_ns)
        return relative, np.diagonal(step.covariance) * max(longer, 1.0)

    def _begin(self, step: RelativeStep) -> None:
        self._origin_stamp_ns = step.origin_stamp_ns
        odom = torch.from_numpy(step.odom_xyyaw)
        before = se2.compose(odom, se2.inverse(torch.from_numpy(step.relative_xyyaw)))
        self._stamps.append(step.from_stamp_ns)
        self._poses.append(np.zeros(3))
        self._odometry.append(before.numpy())
        self._online.append(np.zeros(3))
        self._motion = _Rows(step.motion_feature.shape, np.float32)
        self._codes = _Rows((0,) if self._pair_head is None else step.place_code.shape, np.float32)

    def _append(self, step: RelativeStep, relative: np.ndarray, variance: np.ndarray) -> None:
        assert self._motion is not None and self._codes is not None
        pose = se2.compose(torch.from_numpy(self._poses.values[-1]), torch.from_numpy(relative.astype(np.float64)))
        self._stamps.append(step.stamp_ns)
        self._poses.append(pose.numpy())
        self._odometry.append(step.odom_xyyaw)
        self._relative.append(relative)
        self._log_std.append(0.5 * np.log(variance))
        self._motion.append(step.motion_feature)
        self._codes.append(step.place_code if self._pair_head is not None else ())
        self._covariance = propagate(self._covariance, pose.numpy(), relative, np.diag(variance))
        self._last_odom = np.array(step.odom_xyyaw)
        self._count += 1

    def _optimize(self) -> np.ndarray:
        """Re-optimise the window; returns how far each pose but the newest moved, (count,) m."""
        assert self._motion is not None and self._codes is not None
        self._window_start = max(self._window_start, self._count - self._window)
        inside = slice(self._window_start, self._count)
        result = optimize_offline(
            self._optimizer,
            self._pair_head,
            *(
                torch.from_numpy(rows.values[inside])
                for rows in (self._relative, self._log_std, self._motion, self._codes)
            ),
        )
        before = self._poses.values.copy()
        start = torch.from_numpy(before[self._window_start])
        poses = se2.compose(start, result.poses[0].double())
        self._poses.replace(self._window_start + 1, poses.numpy())
        rotation = se2.rotate(start[2].expand(2), torch.eye(2, dtype=torch.float64)).mT
        map_from_window = torch.block_diag(rotation, torch.ones(1, 1, dtype=torch.float64))
        covariance = map_from_window @ result.end_covariance()[0] @ map_from_window.mT
        self._covariance = covariance.numpy()
        if result.loops is not None and result.loop_weights is not None:
            valid = result.loops.valid[0]
            ends = (result.loops.end[0][valid] + 1) * self._block
            frames = torch.stack((result.loops.frame[0][valid] + 1, ends), dim=-1)
            self._loops = frames.numpy() + self._window_start
            self._loop_weights = result.loop_weights[0][valid].double().numpy()
        return np.linalg.norm(self._poses.values[:-1, :2] - before[:-1, :2], axis=1)

    def _result(self, optimized: bool, restarted: bool, gap: bool) -> TrajectoryUpdate:
        pose = self._poses.values[-1].copy()
        map_from_odom = se2.compose(torch.from_numpy(pose), se2.inverse(torch.from_numpy(self._last_odom)))
        return TrajectoryUpdate(
            stamp_ns=int(self._stamps.values[-1]),
            pose_xyyaw=_read_only(pose),
            covariance=_read_only(0.5 * (self._covariance + self._covariance.T)),
            map_from_odom_xyyaw=_read_only(map_from_odom.numpy()),
            frames=self._count + 1,
            optimized=optimized,
            restarted=restarted,
            gap=gap,
            largest_move_m=float(self._moved.max()),
            closed_loops=int((self._loop_weights > 0.5).sum()),
            window_fill=min(1.0, self._count / self._window),
        )


@torch.inference_mode()
def optimize_offline(
    optimizer: NeuralGraphOptimizer,
    pair_head: PairHead | None,
    relative: Tensor,
    log_std: Tensor,
    motion_features: Tensor,
    place_codes: Tensor,
) -> OptimizedTrajectory:
    """Optimise one trajectory ``(steps, ...)`` of any number of steps; those after the last whole block follow it.

    Arguments as in ``NeuralGraphOptimizer``, without the batch; ``pair_head`` with loops only.
    ``poses`` of the result is ``(1, steps, 3)``.
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
        loops = optimizer.find_loops(inputs[0], inputs[3], pair_head)
    result: OptimizedTrajectory = optimizer(*inputs[:3], loops)
    if whole == steps:
        return result
    tail = se2.compose(result.poses[:, -1:], se2.r2g(relative[whole:].unsqueeze(0).float()))
    return replace(result, poses=torch.cat((result.poses, tail), dim=1))


class _Rows:
    """A growing array of equal rows; earlier views stay valid and unchanged unless ``replace`` copies."""

    def __init__(self, shape: tuple[int, ...], dtype: type) -> None:
        self._buffer: np.ndarray = np.zeros((256, *shape), dtype)
        self._used = 0

    @property
    def values(self) -> np.ndarray:
        return self._buffer[: self._used]

    def append(self, row: object) -> None:
        if self._used == len(self._buffer):
            self._buffer = np.concatenate((self._buffer, np.zeros_like(self._buffer)))
        self._buffer[self._used] = row
        self._used += 1

    def replace(self, start: int, rows: np.ndarray) -> None:
        """Overwrite the rows from ``start`` in a copy, so that views handed out stay as they are."""
        self._buffer = self._buffer.copy()
        self._buffer[start : start + len(rows)] = rows

    def frozen(self) -> np.ndarray:
        """A read-only view of all rows."""
        return _read_only(self.values)


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def _check_size(name: str, value: np.ndarray, limit: float) -> None:
    if (largest := np.abs(value).max(initial=0.0)) > limit:
        raise RejectedStep(f"{name} has values as large as {largest:g}; expected at most {limit:g}")
