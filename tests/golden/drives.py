"""Stored drives of cameras: the frames and actions of a robot, and its true poses."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.frame_pairing import PairedFrame
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from tests.golden import net
from tests.golden.net import FIRST_STAMP_NS, JITTER, STORED, Run, save_arrays
from training.data.lidar_drives import TruePoses

WEIGHTS = net.WEIGHTS
WORLDS = ("maze2d", "maze3d")  # Whose first drive is one of each world that other tests use.


@dataclass(frozen=True, eq=False)
class GoldenDrive:
    """A drive of ``n`` frames through a maze or a Doom map.

    ``frames`` ``(n, height, width, channels)`` of the world's type, ``actions`` ``(n - 1,)`` between them,
    ``period_ns`` () between two stamps, ``truth`` ``(n, 3)`` the true poses seen from the first frame (m, m, rad).
    """

    world: str
    frames: np.ndarray
    actions: np.ndarray
    period_ns: np.ndarray
    truth: np.ndarray

    @classmethod
    def load(cls, name: str) -> GoldenDrive:
        """The stored drive of a name, which begins with its world."""
        with np.load(STORED / f"{name}.npz") as stored:
            arrays = {field.name: stored[field.name] for field in fields(cls) if field.name != "world"}
        return cls(name.partition("_")[0], **arrays)

    def save(self, name: str) -> None:
        """Store the drive under a name."""
        save_arrays(STORED / f"{name}.npz", {key: value for key, value in vars(self).items() if key != "world"})

    @property
    def stamps_ns(self) -> np.ndarray:
        """Stamps ``(n,)`` of the frames."""
        return FIRST_STAMP_NS + np.arange(len(self.frames)) * int(self.period_ns)

    @property
    def true_poses(self) -> TruePoses:
        """The truth at the frames' stamps."""
        return TruePoses(self.stamps_ns, self.truth)

    def copy(self, seed: int) -> GoldenDrive:
        """The drive with bytes of its pictures one off, up or down or not at all; with other values ``JITTER`` off."""
        rng = np.random.default_rng(seed)
        if self.frames.dtype == np.uint8:
            off = rng.integers(-1, 2, self.frames.shape)
            return replace(self, frames=np.clip(self.frames + off, 0, 255).astype(np.uint8))
        jitter = rng.uniform(-JITTER, JITTER, self.frames.shape)
        return replace(self, frames=(self.frames + jitter).astype(self.frames.dtype))

    def run(self) -> Run:
        """Both estimators over the drive, with the shipped weights."""
        weights = WEIGHTS / self.world
        online, covariances = OnlineTrajectory.load(weights, world=self.world), [np.zeros((3, 3))]
        for step in estimates(self, LocalOdometry.load(weights, self.world)):
            update = online.update(step)
            assert not update.fault, update.fault
            covariances.append(update.covariance)
        online.finish()
        trajectory = online.trajectory()
        assert trajectory is not None
        return Run(trajectory, np.stack(covariances), int((trajectory.loop_weights > 0.5).sum()))


def estimates(drive: GoldenDrive, local: LocalOdometry, at_once: int = 1) -> list[RelativeStep]:
    """The relative poses that the local odometry makes of the frames, so many at once."""
    frames = []
    for number, (frame, stamp_ns) in enumerate(zip(drive.frames, drive.stamps_ns.tolist(), strict=True)):
        action = int(drive.actions[number - 1]) if number and local.uses_action else None
        frames.append(PairedFrame(stamp_ns, frame, action))
    found = [each for at in range(0, len(frames), at_once) for each in local.update_all(frames[at : at + at_once])]
    return [step for step in found if isinstance(step, RelativeStep)]


def corrected(steps: list[RelativeStep], online: OnlineTrajectory) -> tuple[Trajectory, TrajectoryUpdate]:
    """The trajectory after the last step, and the last update."""
    for step in steps:
        update = online.update(step)
    trajectory = online.trajectory()
    assert trajectory is not None
    return trajectory, update
