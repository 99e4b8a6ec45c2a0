"""A robot with a 3D lidar or a depth camera knows its way as one with a lidar does."""

import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array, between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRun
from ngo_estimator.offline.recorded import RecordedRun
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.laser_scan import LidarScan
from ngo_recordings.scan_stream import WheelPose
from ngo_recordings.space_scan import cloud_scan, depth_scan
from tests.unit.ngo_estimator.ray_casting import ROOM, cast
from tests.unit.ngo_recordings import messages as m

SENSOR = np.array((0.1, 0.0, 0.2))
HEIGHT_M = 0.5  # above the floor
STEPS = 80


def cloud(sensor: Array, stamp_ns: int, noise: np.random.Generator) -> LidarScan:
    """Of 16 rings, with 1 cm of noise."""
    azimuths = np.radians(np.arange(-180.0, 180.0, 0.5))
    elevations = np.radians(np.linspace(-15.0, 15.0, 16))[:, None]
    reach = np.broadcast_to(cast(ROOM, sensor, azimuths), (16, len(azimuths)))
    reach = np.where(elevations < 0.0, np.minimum(reach, HEIGHT_M / np.tan(np.abs(elevations))), reach)
    reach = reach + noise.normal(0.0, 0.01, reach.shape)
    points = (reach * np.cos(azimuths), reach * np.sin(azimuths), reach * np.tan(elevations))
    fields = {name: values.ravel().astype("f4") for name, values in zip("xyz", points, strict=True)}
    return cloud_scan(m.cloud(stamp_ns, fields), "/points")


def depth(sensor: Array, stamp_ns: int, noise: np.random.Generator) -> LidarScan:
    """Of a camera of 87 degrees, with noise that grows with the square of the depth, and is the same in a column."""
    width, height = 320, 40
    focal = 0.5 * width / math.tan(math.radians(43.5))
    angles = np.arctan((0.5 * (width - 1) - np.arange(width)) / focal)
    ahead = cast(ROOM, sensor, angles) * np.cos(angles)
    ahead = ahead + noise.normal(0.0, 0.0016, width) * ahead**2
    image = m.image(stamp_ns, np.broadcast_to(ahead.astype("f4")[None, :, None], (height, width, 1)), "32FC1")
    k = np.array((focal, 0.0, 0.5 * (width - 1), 0.0, focal, 0.5 * (height - 1), 0.0, 0.0, 1.0))
    return depth_scan(image, SimpleNamespace(k=k, height=height, width=width), "/depth")


@pytest.mark.parametrize(("sensor", "at_most_m"), [(cloud, 0.02), (depth, 0.05)])
def test_a_robot_that_sees_in_space_knows_its_way(
    sensor: Callable[[Array, int, np.random.Generator], LidarScan], at_most_m: float
) -> None:
    """Wheels that count 5 % too much are up to 0.19 m off."""
    noise, pose, made, poses = np.random.default_rng(0), np.array((1.0, 1.0, 0.2)), [], []
    for k in range(STEPS):
        stamp_ns = 10**12 + k * 10**8
        made.append(WheelPose(stamp_ns, between(np.array((1.0, 1.0, 0.2)), pose) * (1.05, 1.05, 1.0)))
        made.append(sensor(compose(pose, SENSOR), stamp_ns, noise))
        poses.append(pose)
        pose = compose(pose, np.array((0.06, 0.0, 0.03)))
    run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), Mounting(SENSOR))
    whole = next(event for event in run.run(made) if isinstance(event, RecordedRun)).trajectory
    expected = np.array([between(poses[0], each) for each in poses])
    off_m = np.linalg.norm((whole.poses_xyyaw - expected)[:, :2], axis=1).max()
    assert off_m < at_most_m
