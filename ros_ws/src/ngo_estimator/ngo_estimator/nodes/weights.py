"""The parameters that both estimator nodes share, and the weights that they name."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ament_index_python.packages import get_package_share_directory

from ngo_estimator.nodes.parameters import Settings, frame, setting, topic
from ngo_estimator.nodes.process import StartError

WORLDS = ("maze2d", "maze3d")

Core = TypeVar("Core")


@dataclass(frozen=True)
class EstimatorSettings(Settings):
    """What every estimator node needs."""

    world: str = setting("maze3d", "World whose weights are used.", choices=WORLDS)
    weights: str = setting("", "Folder of weights for that world; empty: the ones that ship with the package.")
    threads: int = setting(1, "Threads that the networks compute with.", minimum=1, maximum=64)
    odom_frame: str = frame("odom", "Frame in which the odometry is smooth and drifts.")
    publish_tf: bool = setting(True, "Whether to publish the transform on tf_topic.")
    relative_pose_topic: str = topic("relative_pose", "Steps of the odometry, from local_node to ngo_node.")
    relative_pose_depth: int = setting(
        2000, "Queue of relative_pose_topic, at least ngo_node's window_frames.", minimum=1, maximum=100_000
    )
    tf_topic: str = topic("/tf", "Transforms.")
    diagnostics_topic: str = topic("/diagnostics", "Rates, drops and durations of the node.")
    diagnostics_period_s: float = setting(1.0, "Time between diagnostics.", minimum=0.05, maximum=3600.0)


def load_core(load: Callable[[Path, str], Core], settings: EstimatorSettings) -> Core:
    """Load a core's networks as ``settings`` say; raises ``StartError`` with one line where they cannot be used."""
    import torch

    torch.set_num_threads(settings.threads)
    folder = Path(settings.weights or Path(get_package_share_directory("ngo_estimator"), "weights", settings.world))
    if not folder.is_dir():
        raise StartError(f"weights: there is no folder '{folder}' (parameters 'weights' and 'world')")
    try:
        return load(folder, settings.world)
    except ValueError as error:
        raise StartError(f"weights: {error}") from error
