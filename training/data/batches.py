"""Batches of frames and motions, from a simulator or from recordings, and their mirror images."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import NO_ACTION
from training.data.data_source import MIRRORED_ACTIONS

Batch = dict[str, Tensor]

ACTION_HISTORY = 12
"""Actions that a batch holds for each step; a network reads as many of the latest ones as it was made for."""


def action_histories(actions: np.ndarray) -> Tensor:
    """The latest actions ``(..., steps, ACTION_HISTORY)`` of each step, its own last, of ``(..., steps)`` actions."""
    latest = torch.from_numpy(actions).long()
    return torch.nn.functional.pad(latest, (ACTION_HISTORY - 1, 0), value=NO_ACTION).unfold(-1, ACTION_HISTORY, 1)


def relative_poses(poses_xyyaw: np.ndarray) -> Tensor:
    """Relative poses ``(frames - 1, 3)``, float32, of ``(frames, 3)`` global poses."""
    poses = torch.from_numpy(poses_xyyaw)
    return se2.between(poses[:-1], poses[1:]).float()


def seen_from_first(poses_xyyaw: np.ndarray) -> np.ndarray:
    """Poses ``(frames, 3)`` in the frame of the first one."""
    poses = torch.from_numpy(np.asarray(poses_xyyaw, dtype=np.float64))
    return se2.between(poses[:1], poses).numpy()


def alike(poses_xyyaw: np.ndarray, radius_m: float, limit_rad: float) -> np.ndarray:
    """Which pairs of poses ``(n, 3)`` are at one place, near in position and heading ``(n, n)``."""
    xy, yaw = poses_xyyaw[:, :2], poses_xyyaw[:, 2]
    near = np.linalg.norm(xy[:, None] - xy[None], axis=-1) < radius_m
    turn = np.abs(np.remainder(yaw[:, None] - yaw[None] + np.pi, 2.0 * np.pi) - np.pi)
    return near & (turn <= limit_rad)


def mirrored(batch: Batch) -> Batch:
    """The batch seen in a mirror: pictures flipped left to right, left and right actions and motions exchanged."""
    result = dict(batch)
    for name, value in batch.items():
        if name in ("earlier", "later", "a", "b", "images"):
            result[name] = value.flip(-2)
        elif name == "ranges":
            result[name] = value.flip(-1)
        elif name in ("relative", "poses", "twist"):
            result[name] = value * value.new_tensor([1.0, -1.0, -1.0])
        elif name == "action":
            result[name] = value.new_tensor((*MIRRORED_ACTIONS, NO_ACTION))[value]
    return result


def reversed_in_time(batch: Batch) -> Batch:
    """Frame pairs (without actions) as a robot meets them that drives the same way backwards."""
    origin = torch.zeros_like(batch["relative"])
    relative = se2.between(batch["relative"], origin)
    twist = {"twist": -batch["twist"]} if "twist" in batch else {}
    return {**batch, "earlier": batch["later"], "later": batch["earlier"], "relative": relative, **twist}


@dataclass(frozen=True)
class Share:
    """Which of the ``ranks`` processes that train together this is: each gets as many groups of mazes of its own."""

    rank: int = 0
    ranks: int = 1

    def __post_init__(self) -> None:
        if not 0 <= self.rank < self.ranks:
            raise ValueError(f"rank is {self.rank} of {self.ranks}; expected 0 to {self.ranks - 1}")


ALL = Share()
