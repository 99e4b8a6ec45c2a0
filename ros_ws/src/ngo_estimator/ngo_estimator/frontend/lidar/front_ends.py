"""The two front ends of a 2D lidar; a setting chooses one."""

from pathlib import Path

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.frontend.lidar.lidar_odometry import LidarOdometry, LidarOdometryConfig
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.networks.step_scaling import StepScaling

LidarFrontEnd = LidarOdometry | MixtureLidar


def lidar_front_end(
    config: LidarOdometryConfig, mounting: Mounting | None = None, scaling: StepScaling | None = None
) -> LidarFrontEnd:
    """The front end that ``config`` names; ``scaling`` is for that of registration alone."""
    if config.front_end == "mixture":
        return MixtureLidar(config.mixture, mounting)
    return LidarOdometry(config, mounting, scaling)


def load_front_end(weights: Path, world: str | None = None) -> LidarFrontEnd:
    """The front end that the settings in the folder ``weights`` name.

    Raises:
        LidarFileError, CheckpointError: of one clear line.
    """
    config = read_lidar_file(weights, "odometry", LidarOdometryConfig, world)
    return MixtureLidar(config.mixture) if config.front_end == "mixture" else LidarOdometry.load(weights, world)
