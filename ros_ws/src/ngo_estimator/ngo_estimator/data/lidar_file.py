"""The file ``lidar.json`` in a folder of weights: it says that a lidar's estimators are run, and their settings."""

import json
from importlib import import_module
from pathlib import Path
from typing import TypeVar

from ngo_common.files import read_file
from ngo_estimator.data.configuration import config_from_dict

LIDAR_FILE = "lidar.json"
_FORMAT = 1
_KEYS = {"format", "estimator", "world", "odometry", "graph"}

Config = TypeVar("Config")


class LidarFileError(ValueError):
    """The file is missing, damaged, or of another world than was asked for."""


def is_lidar(weights: Path) -> bool:
    """Whether the folder holds the settings of a lidar's estimators, and no networks of its own."""
    return (weights / LIDAR_FILE).is_file()


def require_torch() -> None:
    """Raise ``ValueError`` where PyTorch is not installed, which all weights but a lidar's need."""
    try:
        import_module("torch")
    except ModuleNotFoundError as error:
        raise ValueError(
            "these weights are networks, and PyTorch is not installed: run make venv FOR=all, or pip install torch"
        ) from error


def require_opencv() -> None:
    """Raise ``ValueError`` where OpenCV is not installed, which a camera without weights needs."""
    try:
        import_module("cv2")
    except ImportError as error:
        raise ValueError(
            f"world camera needs OpenCV, which cannot be imported ({' '.join(str(error).split())}): run make venv "
            "FOR=all, or pip install opencv-python-headless"
        ) from error


def read_lidar_file(weights: Path, section: str, kind: type[Config], world: str | None = None) -> Config:
    """The settings in ``section``, ``odometry`` or ``graph``; a setting that is not there has its default.

    Raises:
        LidarFileError: of one line, about what cannot be read or is unknown.
    """
    path = weights / LIDAR_FILE
    try:
        values = json.loads(read_file(path))
    except OSError as error:
        raise LidarFileError(f"{path}: cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise LidarFileError(f"{path}: is not JSON ({error})") from error
    if not isinstance(values, dict) or values.get("format") != _FORMAT or set(values) != _KEYS:
        raise LidarFileError(f"{path}: is not a lidar's description of format {_FORMAT}, with the keys {sorted(_KEYS)}")
    if world is not None and values["world"] != world:
        raise LidarFileError(f"{path}: is for the world {values['world']!r}; expected {world!r}")
    try:
        return config_from_dict(kind, values[section])
    except ValueError as error:
        raise LidarFileError(f"{path}: {error}") from error
