"""The online estimate: each pose as it was when its frame was the newest."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory


@dataclass(frozen=True)
class OnlineRun:
    """``trajectory`` after all steps; ``published`` ``(steps, 3)`` and ``covariances`` ``(steps, 3, 3)`` at each."""

    trajectory: Trajectory
    published: np.ndarray
    covariances: np.ndarray


def online_run(core: OnlineTrajectory, steps: Iterable[RelativeStep]) -> OnlineRun:
    """The core, which begins anew, over the steps of a drive."""
    core.reset()
    updates = [core.update(step) for step in steps]
    core.finish()
    trajectory = core.trajectory()
    assert trajectory is not None
    published = (np.array([getattr(update, name) for update in updates]) for name in ("pose_xyyaw", "covariance"))
    return OnlineRun(trajectory, *published)


def run_online(core: OnlineTrajectory, features: dict[str, np.ndarray]) -> Trajectory:
    """The trajectory after all steps in ``features``, which are those of ``features_of``; ``core`` begins anew."""
    return online_run(core, steps_of(features)).trajectory


def online_poses(core: OnlineTrajectory, features: dict[str, np.ndarray]) -> np.ndarray:
    """Each pose ``(steps + 1, 3)`` as it was first published, the origin in front; arguments as of ``run_online``."""
    return run_online(core, features).online_xyyaw.copy()


def steps_of(features: dict[str, np.ndarray]) -> Iterator[RelativeStep]:
    """The steps in ``features`` as the local odometry would have given them, a nanosecond apart.

    ``unlikeness`` ``(steps,)`` and ``origin_code`` are optional: without, all frames are familiar, and the first one is
    no place.
    """
    odometry = se2.r2g(torch.from_numpy(features["relative"]).double()).numpy()
    variances = np.exp(2.0 * features["log_std"].astype(np.float64))
    unlikeness = features.get("unlikeness", np.zeros(len(variances)))
    origin = features["origin_code"][0].astype(np.float32) if "origin_code" in features else None
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
            from_place_code=None if k else origin,
            unlikeness=float(unlikeness[k]),
        )


def with_origin(poses: np.ndarray) -> np.ndarray:
    """Poses ``(steps + 1, 3)`` with the origin in front of those after each step."""
    return np.concatenate((np.zeros((1, 3)), poses))


def carried_covariances(poses: np.ndarray, relative: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Covariances ``(n, 3, 3)`` of the poses ``(n, 3)`` after independent steps ``(n, 3)`` with these of their own."""
    covariance, found = np.zeros((3, 3)), []
    for pose, step, own in zip(poses, relative, covariances, strict=True):
        covariance = propagate(covariance, pose, step, own)
        found.append(covariance)
    return np.array(found)
