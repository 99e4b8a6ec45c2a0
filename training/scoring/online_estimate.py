"""The online estimate: each pose as it was when its frame was the newest."""

from collections.abc import Iterator

import numpy as np
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory


def run_online(core: OnlineTrajectory, features: dict[str, np.ndarray]) -> Trajectory:
    """The trajectory after all steps in ``features``, which are those of ``features_of``; ``core`` begins anew."""
    core.reset()
    for step in steps_of(features):
        core.update(step)
    core.finish()
    trajectory = core.trajectory()
    assert trajectory is not None
    return trajectory


def online_poses(core: OnlineTrajectory, features: dict[str, np.ndarray]) -> np.ndarray:
    """Each pose ``(steps + 1, 3)`` as it was first published, the origin in front; arguments as of ``run_online``."""
    return run_online(core, features).online_xyyaw.copy()


def steps_of(features: dict[str, np.ndarray]) -> Iterator[RelativeStep]:
    """The steps in ``features`` as the local odometry would have given them, a nanosecond apart.

    ``unlikeness`` ``(steps,)`` is taken where it is there; without, all frames are familiar.
    """
    odometry = se2.r2g(torch.from_numpy(features["relative"]).double()).numpy()
    variances = np.exp(2.0 * features["log_std"].astype(np.float64))
    unlikeness = features.get("unlikeness", np.zeros(len(variances)))
    for k, relative in enumerate(features["relative"]):
        yield RelativeStep(
            stamp_ns=k + 1,
            from_stamp_ns=k,
            relative_xyyaw=relative.astype(np.float64),
            covariance=np.diag(variances[k]),
            origin_stamp_ns=0,
            odom_xyyaw=odometry[k],
            motion_feature=features["motion"][k].astype(np.float32),
            place_code=features["codes"][k].astype(np.float32),
            from_place_code=None if k else features["origin_code"][0].astype(np.float32),
            unlikeness=float(unlikeness[k]),
        )


def with_origin(poses: np.ndarray) -> np.ndarray:
    """Poses ``(steps + 1, 3)`` with the origin in front of those after each step."""
    return np.concatenate((np.zeros((1, 3)), poses))
