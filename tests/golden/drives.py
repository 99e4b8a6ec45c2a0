"""Stored drives, one a world: the frames and actions of a robot, and the trajectory that the shipped weights made."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.frame_pairing import PairedFrame
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate

FOLDER = Path(__file__).parent
WEIGHTS = FOLDER.parents[1] / "ros_ws/src/ngo_estimator/weights"
WORLDS = ("maze2d", "maze3d")
FIRST_STAMP_NS = 1_000_000_000


@dataclass(frozen=True)
class GoldenDrive:
    """A drive of ``n`` frames through a maze, and the expected result.

    ``frames`` ``(n, height, width, channels)`` of the world's type, ``actions`` ``(n - 1,)`` between them,
    ``period_ns`` () between two stamps, ``truth`` ``(n, 3)`` the true poses seen from the first frame (m, m, rad).
    ``poses`` ``(n, 3)`` and ``covariance`` ``(3, 3)`` are the expected corrected poses and the
    covariance of the last one, in ``map``.
    """

    frames: np.ndarray
    actions: np.ndarray
    period_ns: np.ndarray
    truth: np.ndarray
    poses: np.ndarray
    covariance: np.ndarray

    @classmethod
    def load(cls, world: str) -> GoldenDrive:
        """The stored drive of a world."""
        with np.load(FOLDER / f"{world}.npz") as stored:
            return cls(**{field.name: stored[field.name] for field in fields(cls)})

    def save(self, world: str) -> None:
        """Store the drive as the one of a world."""
        np.savez_compressed(FOLDER / f"{world}.npz", **vars(self))


def estimates(drive: GoldenDrive, local: LocalOdometry, at_once: int = 1) -> list[RelativeStep]:
    """The relative poses that the local odometry makes of the frames, so many at once."""
    frames = []
    for number, frame in enumerate(drive.frames):
        action = int(drive.actions[number - 1]) if number and local.uses_action else None
        frames.append(PairedFrame(FIRST_STAMP_NS + number * int(drive.period_ns), frame, action))
    found = [each for at in range(0, len(frames), at_once) for each in local.update_all(frames[at : at + at_once])]
    return [step for step in found if isinstance(step, RelativeStep)]


def corrected(steps: list[RelativeStep], online: OnlineTrajectory) -> tuple[Trajectory, TrajectoryUpdate]:
    """The trajectory after the last step, and the last update."""
    for step in steps:
        update = online.update(step)
    trajectory = online.trajectory()
    assert trajectory is not None
    return trajectory, update


def position_rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    """Root mean square error (m) of positions."""
    return float(np.sqrt(np.square(poses[:, :2] - truth[:, :2]).sum(axis=1).mean()))


def largest_difference(poses: np.ndarray, expected: np.ndarray) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) between two trajectories."""
    difference = poses - expected
    angle = np.remainder(difference[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return float(np.hypot(difference[:, 0], difference[:, 1]).max()), float(np.abs(angle).max())
