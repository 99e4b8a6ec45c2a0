"""Loading the weights that a node's parameters name."""

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from ament_index_python.packages import get_package_share_directory

from ngo_common.nodes.process import StartError
from ngo_estimator.nodes.settings import EstimatorSettings

Core = TypeVar("Core")


def load_core(load: Callable[[Path, str], Core], settings: EstimatorSettings) -> Core:
    """Load a core's networks as ``settings`` say; raises ``StartError`` where they cannot be used."""
    import torch

    torch.set_num_threads(settings.threads)
    folder = Path(settings.weights or Path(get_package_share_directory("ngo_estimator"), "weights", settings.world))
    if not folder.is_dir():
        raise StartError(f"weights: there is no folder '{folder}' (parameters 'weights' and 'world')")
    try:
        return load(folder, settings.world)
    except ValueError as error:
        raise StartError(str(error)) from error
