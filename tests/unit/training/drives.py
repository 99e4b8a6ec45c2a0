"""Recordings of a robot that drives rounds on a circle and sees noise."""

import math
from collections.abc import Container
from pathlib import Path

import numpy as np

from tests.unit.ngo_recordings.messages import image, odometry, pose, twist, write_mcap

SHAPE = (12, 16, 3)
PERIOD_S = 0.1
STEP_M = 0.1
HEIGHT_M = 0.4
RADIUS_M = 2.0


def picture(frame: int, seed: int) -> np.ndarray:
    return np.random.default_rng([seed, frame]).integers(0, 256, SHAPE, dtype=np.uint8)


def poses(frames: int, seed: int, step_m: float = STEP_M) -> np.ndarray:
    """True poses ``(frames, 3)``; drives begin at different places of the circle."""
    angle = seed + np.arange(frames) * 2.0 * math.asin(0.5 * step_m / RADIUS_M)
    yaw = (angle + math.pi / 2 + math.pi) % math.tau - math.pi
    return np.stack((RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), yaw), axis=1)


def write(
    path: Path,
    frames: int,
    seed: int,
    step_m: float = STEP_M,
    truth_topic: str = "/ground_truth",
    without_frames: Container[int] = (),
    without_poses: Container[int] = (),
) -> None:
    entries = []
    for k, (x, y, yaw) in enumerate(poses(frames, seed, step_m)):
        stamp_ns = round((1.0 + k * PERIOD_S) * 1e9)
        if k not in without_poses:
            at = pose(float(x), float(y), float(yaw), HEIGHT_M)
            entries.append((truth_topic, stamp_ns, odometry(stamp_ns, at, twist(0.0, 0.0, 0.0))))
        if k not in without_frames:
            entries.append(("/image", stamp_ns, image(stamp_ns, picture(k, seed))))
    path.unlink(missing_ok=True)
    write_mcap(path, entries)
