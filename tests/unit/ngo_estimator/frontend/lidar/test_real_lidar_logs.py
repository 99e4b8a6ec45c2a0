"""The local estimator on real logs of the Freiburg SLAM benchmark, before any loop closure.

Skipped unless NGO_LIDAR_LOGS names the folder that holds mit-csail.clf.gz and mit-csail.relations.
"""

import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array, between, wrap
from ngo_recordings.scan_stream import LidarScan

FOLDER = os.environ.get("NGO_LIDAR_LOGS")

pytestmark = pytest.mark.skipif(not FOLDER, reason="NGO_LIDAR_LOGS does not name a folder with real logs")


def csail() -> tuple[list[int], Array, Array]:
    """Stamps (ns), ranges ``(n, 361)`` and the wheels' poses ``(n, 3)``."""
    assert FOLDER is not None
    stamps, ranges, wheels = [], [], []
    with gzip.open(Path(FOLDER) / "mit-csail.clf.gz", "rt") as log:
        for fields in map(str.split, log):
            if fields[0] != "FLASER":
                continue
            count = int(fields[1])
            ranges.append([float(number) for number in fields[2 : 2 + count]])
            wheels.append([float(number) for number in fields[2 + count : 5 + count]])
            stamps.append(round(float(fields[8 + count]) * 1e6) * 1000)
    return stamps, np.array(ranges), np.array(wheels)


def relation_errors(stamps: list[int], poses: Array) -> tuple[float, float]:
    """Mean translational (m) and rotational error (deg) over the relations within the log."""
    assert FOLDER is not None
    relations = np.loadtxt(Path(FOLDER) / "mit-csail.relations")
    seconds, yaw = np.array(stamps) * 1e-9, np.unwrap(poses[:, 2])
    errors = []
    for first, second, x, y, *_, turn in relations:
        if first < seconds[0] - 0.01 or second > seconds[-1] + 0.01:
            continue
        a, b = (
            np.array([np.interp(at, seconds, column) for column in (poses[:, 0], poses[:, 1], yaw)])
            for at in (first, second)
        )
        moved = between(a, b)
        errors.append((math.hypot(moved[0] - x, moved[1] - y), abs(math.degrees(wrap(moved[2] - turn)))))
    mean: Array = np.mean(errors, axis=0)
    return float(mean[0]), float(mean[1])


@pytest.mark.parametrize("with_wheels", [True, False])
def test_mit_csail_is_followed_open_loop(with_wheels: bool) -> None:
    stamps, ranges, wheel_poses = csail()
    lidar, poses = MixtureLidar(), [np.zeros(3)]
    for stamp, measured, wheel_pose in zip(stamps, ranges, wheel_poses, strict=True):
        if with_wheels:
            lidar.add_wheels(stamp, wheel_pose)
        lidar.add_scan(LidarScan(stamp, -0.5 * math.pi, math.radians(0.5), measured, 0.05, 81.9, 0.0, "laser"))
        poses += [step.odom_xyyaw for step in lidar.ready()]
    poses += [step.odom_xyyaw for step in lidar.ready(at_end=True)]
    metres, degrees = relation_errors(stamps, np.array(poses))
    assert degrees < 0.5
    if with_wheels:
        assert lidar.lag_s == pytest.approx(0.12, abs=0.04)
    else:
        assert metres < 0.09
