"""Compiles what trajectories of networks run before the first frame comes: the first time it takes some ten seconds."""

import math

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.slam.online_trajectory import OnlineTrajectory

_STEP_NS = 100_000_000
_BLOCKS = 12  # of a drive through a ring of so many steps, which closes loops from its second turn on
_RING = 32


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
