"""Files of weights: a safetensors file and a JSON description beside it, read without torch."""

import copy
import hashlib
import json
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import safetensors
from safetensors.numpy import load

from ngo_common.files import read_file
from ngo_estimator.data.configuration import config_from_dict

FORMAT = 1
RETIRED_SETTINGS = {"neural_graph_optimizer": {"compass": False, "search.witnesses": 0}}
"""Settings of earlier versions, by the kind of network, with the only value that still means the same."""

Config = TypeVar("Config")


class CheckpointError(ValueError):
    """A checkpoint is missing, damaged, or not the one that was asked for."""


def load_description(path: Path, kind: str, world: str | None = None) -> dict[str, Any]:
    """The JSON beside ``path``, checked to describe a network of ``kind``, trained for ``world`` if one is given."""
    beside = path.with_suffix(".json")
    try:
        description = json.loads(read_file(beside))
    except OSError as error:
        raise CheckpointError(
            f"{beside}: cannot be read ({error.strerror}); expected the description of a {kind}"
        ) from error
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{beside}: is not JSON ({error})") from error
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise CheckpointError(f"{beside}: is not a checkpoint description of format {FORMAT}")
    if description.get("network") != kind:
        raise CheckpointError(f"{beside}: describes a {description.get('network')!r}; expected a {kind!r}")
    if world is not None and description.get("world") != world:
        raise CheckpointError(f"{beside}: was trained for the world {description.get('world')!r}; expected {world!r}")
    return description


def read_weights(
    path: Path, kind: str, config: type[Config], world: str | None = None
) -> tuple[Config, dict[str, np.ndarray], dict[str, Any]]:
    """The settings of a network, its weights by their names, all finite, and its description.

    Raises:
        CheckpointError: naming the file, what is wrong with it and what was expected.
    """
    description = load_description(path, kind, world)
    try:
        settings = config_from_dict(config, _without_retired(kind, description.get("config")))
    except (ValueError, TypeError) as error:
        raise CheckpointError(f"{path.with_suffix('.json')}: {' '.join(str(error).split())}") from error
    try:
        content = read_file(path)
        arrays = load(content)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror})") from error
    except (safetensors.SafetensorError, KeyError) as error:  # the latter: a type of numbers that numpy has not
        raise CheckpointError(f"{path}: is damaged or no safetensors file ({error})") from error
    if hashlib.sha256(content).hexdigest() != description.get("sha256"):
        raise CheckpointError(
            f"{path}: is not the file that {path.with_suffix('.json').name} describes (sha256 differs)"
        )
    if broken := [name for name, array in arrays.items() if not np.isfinite(array).all()]:
        raise CheckpointError(f"{path}: has weights that are not finite in {', '.join(broken)}")
    return settings, arrays, description


def _without_retired(kind: str, values: Any) -> Any:
    """The values of a configuration without settings that this version no longer has."""
    kept = copy.deepcopy(values)
    for name, meant in RETIRED_SETTINGS.get(kind, {}).items():
        *sections, setting = name.split(".")
        section = kept
        for key in sections:
            section = section.get(key) if isinstance(section, dict) else None
        value = section.pop(setting, meant) if isinstance(section, dict) else meant
        if type(value) is not type(meant) or value != meant:  # false is no 0
            raise ValueError(f"{name} is {value!r}, which this version no longer has; expected {meant!r}, or none")
    return kept
