"""What a trajectory that is corrected online reports: after each step, and as a whole."""

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class TrajectoryUpdate:
    """What a step changed; its size does not depend on how long the trajectory is.

    ``pose_xyyaw`` (3,) of the newest frame, corrected, in ``map``, whose origin is the first frame, with its
    ``covariance`` (3, 3), that of the first frame being zero; ``map_from_odom_xyyaw`` (3,). ``frames``
    counts all of the trajectory. ``optimized`` says whether this step ended an optimisation, ``restarted`` whether it
    began a new trajectory, ``gap`` whether steps before it were lost and composed from the odometry.
    ``largest_move_m`` is how far this step moved a pose at most, ``closed_loops`` how many loop candidates the
    optimizer believes (a weight over one half), ``window_fill`` the share of the window that is in use. ``fault`` says
    what failed inside, empty where nothing did: the trajectory goes on by odometry then. ``lost_since_ns`` is the stamp
    from which on nobody knows where the robot is in the map, None where that is known. The arrays are read-only and
    stay as they are.
    """

    stamp_ns: int
    pose_xyyaw: np.ndarray
    covariance: np.ndarray
    map_from_odom_xyyaw: np.ndarray
    frames: int
    optimized: bool
    restarted: bool
    gap: bool
    largest_move_m: float
    closed_loops: int
    window_fill: float
    fault: str
    lost_since_ns: int | None = field(default=None, kw_only=True)


def fault_of(error: Exception, work: str) -> str:
    """One line about ``work`` that failed, as ``TrajectoryUpdate.fault`` has it."""
    return f"{work} failed, {type(error).__name__}: {' '.join(str(error).split())}"


@dataclass(frozen=True)
class Trajectory:
    """The whole trajectory: ``n`` frames, the first at the origin of ``map``.

    ``stamps_ns`` (n,) int64; ``poses_xyyaw`` (n, 3) corrected, in ``map``; ``odometry_xyyaw`` (n, 3) as the local
    odometry has it; ``online_xyyaw`` (n, 3) each corrected pose as it was when its frame was the newest; ``moved_m``
    (n,) how far the last step moved each pose; ``odometry_std`` (n - 1, 3) of what leads from each frame to the next.
    ``loops`` (e, 2) frame indices, earlier first, with ``loop_weights`` (e,) of zero to one, ``loop_relative_xyyaw``
    (e, 3), the later frame as it was seen from the earlier one, and ``loop_std`` (e, 3) in which the weight is
    accounted for. The arrays are read-only and stay as they are.
    """

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray
    odometry_xyyaw: np.ndarray
    online_xyyaw: np.ndarray
    moved_m: np.ndarray
    odometry_std: np.ndarray
    loops: np.ndarray
    loop_weights: np.ndarray
    loop_relative_xyyaw: np.ndarray
    loop_std: np.ndarray
