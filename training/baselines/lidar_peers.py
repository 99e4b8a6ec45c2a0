"""Other ways to a lidar's trajectory, on the same scans: GTSAM on our steps and loops, and KISS-ICP.

GTSAM solves the graph that our optimizer solves, with the same measurements and covariances. KISS-ICP (Vizzo et al.
2023) has neither wheels nor loops; it is made for 3D, and gets a scan's points with z = 0.
"""

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_recordings.scan_stream import LidarScan

_ANCHOR_STD = 1e-6
_TOLERANCE = 1e-6
_LEAST_POINTS = 3


@dataclass(frozen=True)
class GraphPeerConfig:
    """How GTSAM solves a graph of key scans.

    ``cauchy`` is the width of the Cauchy kernel in deviations, on loops and with ``robust_steps`` on steps;
    ``inlier_probability`` is the one at which graduated non-convexity (Yang et al. 2020) takes a loop for right, under
    truncated least squares.
    """

    cauchy: float = 3.0
    robust_steps: bool = True
    inlier_probability: float = 0.99

    def __post_init__(self) -> None:
        check_positive(self, "cauchy")
        check(self, "inlier_probability", "between 0 and 1", lambda x: 0.0 < x < 1.0)


def solve_lm(steps: RelativePoses, loops: RelativePoses, start: np.ndarray, config: GraphPeerConfig) -> np.ndarray:
    """Poses ``(nodes, 3)`` by Levenberg-Marquardt with Cauchy kernels, from ``start`` ``(nodes, 3)``."""
    return solve_with(
        gtsam.noiseModel.mEstimator.Cauchy.Create(config.cauchy), steps, loops, start, config.robust_steps
    )


def solve_with(
    kernel: Any | None, steps: RelativePoses, loops: RelativePoses, start: np.ndarray, robust_steps: bool = False
) -> np.ndarray:
    """Poses ``(nodes, 3)`` by Levenberg-Marquardt with one of GTSAM's kernels, or with none: least squares."""
    graph = gtsam.NonlinearFactorGraph()
    _anchor(graph, start)
    _add(graph, steps, kernel if robust_steps else None)
    _add(graph, loops, kernel)
    return _poses(gtsam.LevenbergMarquardtOptimizer(graph, _values(start), _lm()).optimize())


def solve_gnc(steps: RelativePoses, loops: RelativePoses, start: np.ndarray, config: GraphPeerConfig) -> np.ndarray:
    """Poses ``(nodes, 3)`` by graduated non-convexity, with every step for an inlier, from ``start`` ``(nodes, 3)``."""
    graph = gtsam.NonlinearFactorGraph()
    _anchor(graph, start)
    _add(graph, steps, None)
    trusted = graph.size()
    _add(graph, loops, None)
    if graph.size() == trusted:
        return start.copy()
    parameters = gtsam.GncLMParams(_lm())
    parameters.setLossType(gtsam.GncLossType.TLS)
    parameters.setKnownInliers(list(range(trusted)))
    optimizer = gtsam.GncLMOptimizer(graph, _values(start), parameters)
    optimizer.setInlierCostThresholdsAtProbability(config.inlier_probability)
    return _poses(optimizer.optimize())


def _lm() -> gtsam.LevenbergMarquardtParams:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(_TOLERANCE)
    parameters.setAbsoluteErrorTol(_TOLERANCE)
    return parameters


def _anchor(graph: gtsam.NonlinearFactorGraph, start: np.ndarray) -> None:
    noise = gtsam.noiseModel.Isotropic.Sigma(3, _ANCHOR_STD)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*start[0]), noise))


def _add(graph: gtsam.NonlinearFactorGraph, measured: RelativePoses, kernel: Any | None) -> None:
    # GTSAM's residual of a between factor lies in the frame of the measured pose, ours along the axes of the first one.
    cosine, sine = np.cos(measured.relative[:, 2]), np.sin(measured.relative[:, 2])
    turn = np.zeros((len(measured.nodes), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cosine, -sine, sine, cosine, 1.0
    roots = measured.root @ turn
    for (first, second), relative, root in zip(measured.nodes.tolist(), measured.relative, roots, strict=True):
        noise: Any = gtsam.noiseModel.Gaussian.Information(root.T @ root)
        if kernel is not None:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        graph.add(gtsam.BetweenFactorPose2(first, second, gtsam.Pose2(*relative), noise))


def _values(poses: np.ndarray) -> gtsam.Values:
    values = gtsam.Values()
    for node, pose in enumerate(poses):
        values.insert(node, gtsam.Pose2(*pose))
    return values


def _poses(values: gtsam.Values) -> np.ndarray:
    return np.asarray(gtsam.utilities.extractPose2(values))


@dataclass(frozen=True)
class KissConfig:
    """Settings of KISS-ICP that differ from its own; voxels and threshold were the best tried on validation buildings.

    ``voxel_m`` is the side of the map's voxels, ``range_m`` the longest range that is used, and ``threshold_m`` the
    first threshold of correspondences. Its deskewing is off.
    """

    voxel_m: float = 0.05
    range_m: float = 30.0
    threshold_m: float = 0.3

    def __post_init__(self) -> None:
        check_positive(self, "voxel_m range_m threshold_m")


def kiss_icp(scans: tuple[LidarScan, ...], mounting: Mounting, config: KissConfig) -> np.ndarray:
    """Poses ``(scans, 3)`` of the robot by KISS-ICP, the first at the origin; on one thread.

    Raises:
        ModuleNotFoundError: KISS-ICP is not installed.
    """
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    settings = KISSConfig()
    settings.data.max_range, settings.data.min_range, settings.data.deskew = config.range_m, 0.0, False
    settings.mapping.voxel_size = config.voxel_m
    settings.adaptive_threshold.initial_threshold = config.threshold_m
    settings.registration.max_num_threads = 1
    odometry = KissICP(settings)
    poses = np.zeros((len(scans), 3))
    for index, scan in enumerate(scans):
        points = scan_points(scan, mounting)
        if len(points) >= _LEAST_POINTS:  # where there are none the robot is taken to stand
            odometry.register_frame(np.pad(points, ((0, 0), (0, 1))), np.zeros(len(points)))
        pose = odometry.last_pose
        poses[index] = pose[0, 3], pose[1, 3], math.atan2(pose[1, 0], pose[0, 0])
    return poses


def scan_points(scan: LidarScan, mounting: Mounting) -> np.ndarray:
    """Ends ``(n, 2)`` of the rays that returned, in the robot's frame, as measured: no motion is removed."""
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    ranges = scan.ranges.astype(np.float64)
    x, y, yaw = mounting.sensor_xyyaw
    limit = scan.range_max if scan.range_max > 0.0 else math.inf
    returned = np.isfinite(ranges) & (ranges > max(scan.range_min, 0.0)) & (ranges < limit)
    direction = yaw + (-angles if mounting.upside_down else angles)[returned]
    return np.stack((x + ranges[returned] * np.cos(direction), y + ranges[returned] * np.sin(direction)), axis=-1)
