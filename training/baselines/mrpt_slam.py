"""The SLAM programs of MRPT (Debian's ``mrpt-apps``) over a drive: ``icp-slam`` and ``rbpf-slam``.

Settings are those of MRPT's examples, in ``mrpt/`` beside this module. Both programs take wheels. They get a scan
whenever the wheels say that the robot moved by so much; poses of the scans between follow by the wheels.
"""

import math
import os
import resource
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan
from training.baselines.rawlog import RawScan, write_rawlog
from training.data.lidar_drives import LidarDrive

Program = Literal["icp-slam", "rbpf-slam"]

_SETTINGS = Path(__file__).parent / "mrpt"
_SHOWN_WORDS = 40  # of the end of a program's output


@dataclass(frozen=True)
class MrptConfig:
    """What a program of MRPT gets of a drive.

    A frame every ``step_m`` or ``step_deg`` by the wheels, its scan thinned to at most ``most_rays``. A program that
    takes longer than ``limit_s`` is stopped.
    """

    step_m: float = 0.2
    step_deg: float = 5.0
    most_rays: int = 361
    limit_s: float = 1200.0

    def __post_init__(self) -> None:
        if min(self.step_m, self.step_deg, self.limit_s) <= 0.0 or self.most_rays < 2:
            raise ValueError(
                f"step_m, step_deg, limit_s, most_rays are {self.step_m}, {self.step_deg}, {self.limit_s}, "
                f"{self.most_rays}; expected positive numbers, and at least 2 rays"
            )


@dataclass(frozen=True, eq=False)
class MrptRun:
    """What a program gave: poses ``(scans, 3)`` at ``stamps_ns`` ``(scans,)``, and its computing time."""

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray
    took_s: float


class MrptError(RuntimeError):
    """A program of MRPT failed: one line with the end of its output."""


def missing(program: Program) -> str:
    """Why the program cannot run on this machine, in a few words, or nothing."""
    return "" if shutil.which(program) else f"{program} is not installed (Debian: mrpt-apps)"


def run(program: Program, drive: LidarDrive, config: MrptConfig) -> MrptRun:
    """Run a program over a drive with wheels.

    Raises:
        ValueError: the drive has no wheels.
        MrptError: the program failed, took too long or gave another number of poses.
    """
    if not drive.wheels:
        raise ValueError(f"{drive.name} has no wheel odometry; expected some, as {program} takes it")
    stamps_ns = drive.scan_stamps_ns
    wheels = _wheels_at(drive, stamps_ns)
    frames = _frames(wheels, config)
    scans = [_scan(drive.scans[frame], drive.mounting, config.most_rays) for frame in frames]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        motions = np.concatenate((np.zeros((1, 3)), _between(wheels[frames[:-1]], wheels[frames[1:]])))
        write_rawlog(folder / "drive.rawlog", stamps_ns[frames], motions, scans)
        settings = (_SETTINGS / f"{program}.ini").read_text().replace(
            "[MappingApplication]\n", "[MappingApplication]\nlogOutput_dir = out\n", 1
        )  # fmt: skip
        (folder / "settings.ini").write_text(settings)
        took_s = _execute(program, folder, config.limit_s)
        poses = _read(program, folder / "out")
    if len(poses) != len(frames):
        raise MrptError(f"{program} gave {len(poses)} poses of {drive.name}; expected {len(frames)}")
    frame_of = np.searchsorted(frames, np.arange(len(stamps_ns)), side="right") - 1
    since = _between(wheels[frames[frame_of]], wheels)
    return MrptRun(stamps_ns, _composed(poses[frame_of], since), took_s)


def _execute(program: Program, folder: Path, limit_s: float) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [program, "settings.ini", "drive.rawlog"]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise MrptError(f"{program} took longer than {limit_s:g} s") from None
    if done.returncode != 0:
        raise MrptError(f"{program} ended with {done.returncode}: {' '.join(done.stdout.split()[-_SHOWN_WORDS:])}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _read(program: Program, folder: Path) -> np.ndarray:
    """Poses ``(frames, 3)``: of the filter the most likely particle's whole path, as it is at the end."""
    if program == "rbpf-slam":
        return np.loadtxt(folder / "most_likely_path.txt", ndmin=2)[1:, :3]  # after where it began
    return np.loadtxt(folder / "log_estimated_path.txt", ndmin=2)[:, 1:4]


def _wheels_at(drive: LidarDrive, stamps_ns: np.ndarray) -> np.ndarray:
    """The wheels' poses ``(n, 3)`` at the scans' stamps."""
    known = np.array([pose.stamp_ns for pose in drive.wheels], dtype=np.int64)
    poses = np.stack([pose.pose_xyyaw for pose in drive.wheels])
    columns = (poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    start = stamps_ns[0]
    return np.stack([np.interp((stamps_ns - start) * 1e-9, (known - start) * 1e-9, part) for part in columns], axis=-1)


def _frames(wheels: np.ndarray, config: MrptConfig) -> np.ndarray:
    """The scans that become frames: a step after the one before, by the way that the wheels went."""
    way = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(wheels[:, :2], axis=0).T))))
    turn = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(wheels[:, 2])))))
    steps = np.floor(way / config.step_m + turn / math.radians(config.step_deg))
    return np.flatnonzero(np.concatenate(([True], np.diff(steps) > 0.0)))


def _scan(scan: LidarScan, mounting: Mounting, most_rays: int) -> RawScan:
    """A scan as MRPT takes it: rays from right to left, the laser turned to their middle."""
    every = -(-len(scan.ranges) // most_rays)
    ranges = scan.ranges[::every].astype(np.float64)
    step = scan.angle_increment * every * (-1.0 if mounting.upside_down else 1.0)
    first = -scan.angle_min if mounting.upside_down else scan.angle_min
    view = step * (len(ranges) - 1)
    x, y, yaw = mounting.sensor_xyyaw
    limit = scan.range_max if scan.range_max > 0.0 else math.inf
    returned = np.isfinite(ranges) & (ranges > max(scan.range_min, 0.0)) & (ranges < limit)
    order = slice(None) if step > 0.0 else slice(None, None, -1)
    return RawScan(np.array((x, y, yaw + first + 0.5 * view)), ranges[order], returned[order], abs(view))


def _between(origins: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Each pose seen from its origin ``(n, 3)``."""
    cosine, sine = np.cos(origins[:, 2]), np.sin(origins[:, 2])
    x, y = (poses[:, :2] - origins[:, :2]).T
    turn = np.remainder(poses[:, 2] - origins[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.stack((cosine * x + sine * y, cosine * y - sine * x, turn), axis=-1)


def _composed(origins: np.ndarray, motions: np.ndarray) -> np.ndarray:
    cosine, sine = np.cos(origins[:, 2]), np.sin(origins[:, 2])
    x = origins[:, 0] + cosine * motions[:, 0] - sine * motions[:, 1]
    y = origins[:, 1] + sine * motions[:, 0] + cosine * motions[:, 1]
    return np.stack((x, y, origins[:, 2] + motions[:, 2]), axis=-1)
