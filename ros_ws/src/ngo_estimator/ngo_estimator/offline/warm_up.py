"""Compiles what the odometry of a lidar runs before the first scan comes: the first time it takes some ten seconds."""

import math

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.intake.lidar_intake import LidarIntake
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan

_STEP_NS = 100_000_000
_RAYS = 180
_HALF_M = np.array([6.0, 4.0])  # of the room
_STEP_M = 0.35
_STEPS = 60
_OWN_RAYS, _OWN_M = 4, 0.15  # rays that see the robot itself, and how far away
_SILENT = range(3, 13)  # Steps without wheels: without them other things are run.


def warm_up_odometry() -> list[RelativeStep]:
    """Drive to and fro in a room of four walls, long enough that loops can be looked for; returns the steps."""
    odometry = LidarIntake(MixtureLidar(), lambda frame: Mounting(np.zeros(3)))
    steps: list[RelativeStep] = []
    angles = np.linspace(-math.pi, math.pi, _RAYS, endpoint=False)
    pose, first = np.array([-4.0, 0.5, 0.1]), None
    for step in range(_STEPS):
        first = pose if first is None else first
        directions = np.stack((np.cos(angles + pose[2]), np.sin(angles + pose[2])), axis=1)
        with np.errstate(divide="ignore"):
            ranges = ((np.sign(directions) * _HALF_M - pose[:2]) / directions).min(axis=1)
        ranges[:_OWN_RAYS] = _OWN_M
        if step not in _SILENT:
            odometry.add_wheels(step * _STEP_NS, between(first, pose))
        increment = 2.0 * math.pi / _RAYS
        odometry.add_scan(LidarScan(step * _STEP_NS, -math.pi, increment, ranges, 0.05, 30.0, 0.0, "laser"))
        steps += odometry.ready()
        turn = math.pi if step % 15 == 14 else 0.02
        pose = compose(pose, np.array([_STEP_M, 0.0, turn]))
    return steps
