"""Compiles what the estimators run before the first frame comes: the first time it takes some ten seconds."""

import math

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.odometry.lidar_odometry import LidarOdometry
from ngo_estimator.online.online_trajectory import OnlineTrajectory
from ngo_estimator.online.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan

_RAYS = 180
_HALF_M = np.array([6.0, 4.0])  # of the room
_STEP_M = 0.45
_STEPS = 60
_STEP_NS = 100_000_000
_BLOCKS = 12  # of a drive through a ring of so many steps, which closes loops from its second turn on
_RING = 32


def warm_up() -> None:
    """Drive to and fro in a room of four walls, long enough that loops are looked for."""
    odometry, online = LidarOdometry(), ScanTrajectory()
    angles = np.linspace(-math.pi, math.pi, _RAYS, endpoint=False)
    pose, first = np.array([-4.0, 0.5, 0.1]), None
    for step in range(_STEPS):
        first = pose if first is None else first
        directions = np.stack((np.cos(angles + pose[2]), np.sin(angles + pose[2])), axis=1)
        with np.errstate(divide="ignore"):
            ranges = ((np.sign(directions) * _HALF_M - pose[:2]) / directions).min(axis=1)
        odometry.add_wheels(step * _STEP_NS, between(first, pose))
        increment = 2.0 * math.pi / _RAYS
        odometry.add_scan(LidarScan(step * _STEP_NS, -math.pi, increment, ranges, 0.05, 30.0, 0.0, "laser"))
        for estimate in odometry.ready():
            online.update(estimate)
        turn = math.pi if step % 15 == 14 else 0.02
        pose = compose(pose, np.array([_STEP_M, 0.0, turn]))
    online.finish()


def warm_up_networks(trajectory: OnlineTrajectory) -> None:
    """Drive round and round until loops are closed, and forget it: ``trajectory`` is empty before and afterwards."""
    features, code = trajectory.feature_sizes
    codes = np.random.default_rng(0).uniform(0.5, 1.0, (_RING, code)).astype(np.float32)
    turn = 2.0 * math.pi / _RING
    relative, pose = np.array([0.1, 0.0, turn]), np.zeros(3)
    for step in range(1, _BLOCKS * trajectory.block + 1):
        pose = compose(pose, relative)
        trajectory.update(
            RelativeStep(
                stamp_ns=step * _STEP_NS,
                from_stamp_ns=(step - 1) * _STEP_NS,
                relative_xyyaw=relative,
                covariance=np.diag([1e-4, 1e-4, 1e-5]),
                origin_stamp_ns=0,
                odom_xyyaw=pose,
                motion_feature=np.zeros(features, np.float32),
                place_code=codes[step % _RING],
                from_place_code=codes[0] if step == 1 else None,
            )
        )
    trajectory.finish()
    trajectory.reset()
