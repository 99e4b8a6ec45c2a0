"""Loading the weights that a node's parameters name."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from ament_index_python.packages import get_package_share_directory
from rclpy.impl.rcutils_logger import RcutilsLogger

from ngo_common.nodes.process import StartError
from ngo_estimator.data.lidar_file import is_lidar, require_torch
from ngo_estimator.nodes.settings import EstimatorSettings, NgoNodeSettings, StepSettings
from ngo_estimator.offline.compiling import compiling

if TYPE_CHECKING:
    from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory

Core = TypeVar("Core")


def weights_folder(settings: StepSettings) -> Path:
    """The folder of weights that ``settings`` name; raises ``StartError`` where there is none."""
    if settings.uses_camera:
        raise StartError("world: camera has no weights, and no map: the ranges of its corners are too few for walls")
    folder = Path(settings.weights or Path(get_package_share_directory("ngo_estimator"), "weights", settings.world))
    if not folder.is_dir():
        raise StartError(f"weights: there is no folder '{folder}' (parameters 'weights' and 'world')")
    return folder


def load_core(load: Callable[[Path, str], Core], settings: EstimatorSettings) -> Core:
    """Load a core as ``settings`` say; raises ``StartError`` where its weights cannot be used."""
    folder = weights_folder(settings)
    try:
        if not is_lidar(folder):
            require_torch()
            import torch

            torch.set_num_threads(settings.threads)
        return load(folder, settings.world)
    except ValueError as error:
        raise StartError(str(error)) from error


def load_trajectory(settings: NgoNodeSettings, logger: RcutilsLogger) -> "CorrectedTrajectory":
    """An empty trajectory with the weights that ``settings`` name; raises ``StartError`` where they cannot be used.

    All that it runs is compiled by then, which ``logger`` tells where it takes long.
    """

    if settings.uses_camera:
        return _camera_trajectory(settings)

    # Imported here because torch takes seconds: a bad parameter is said at once. A lidar's estimators take half a one.
    def load(folder: Path, world: str) -> "CorrectedTrajectory":
        if is_lidar(folder):
            from ngo_estimator.offline.warm_up_scans import warm_up_scans
            from ngo_estimator.slam.scan_trajectory import ScanTrajectory

            with compiling(logger.info):
                warm_up_scans()
            return ScanTrajectory.load(folder, world, settings.iterations_per_step)
        from ngo_estimator.offline.warm_up_trajectory import warm_up_networks
        from ngo_estimator.slam.online_trajectory import OnlineTrajectory

        online = OnlineTrajectory.load(
            folder, settings.window_frames, world, settings.key_frames, settings.iterations_per_step
        )
        with compiling(logger.info):
            warm_up_networks(online)
        return online

    return load_core(load, settings)


def _camera_trajectory(settings: NgoNodeSettings) -> "CorrectedTrajectory":
    from ngo_estimator.slam.picture_trajectory import PictureTrajectory

    return PictureTrajectory(iterations_per_step=settings.iterations_per_step)
