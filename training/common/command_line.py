"""How the commands of the training start and end."""

import logging
import sys
import warnings
from collections.abc import Callable, Collection, Sequence
from typing import TypeVar

import tyro

from ngo_estimator.data.weights_file import CheckpointError
from ngo_recordings.errors import RecordingError
from training.common.records import RunError

Arguments = TypeVar("Arguments")


def run_command(
    main: Callable[[Arguments], object],
    arguments: type[Arguments],
    description: str | None,
    flags: Sequence[str] | None = None,
) -> None:
    """Run ``main`` with the flags, by default the command line's.

    Ends with one line on stderr where recordings, weights or a run cannot be used.
    """
    quiet_framework()
    given = tyro.cli(arguments, description=description, args=flags)
    try:
        main(given)
    except (RecordingError, CheckpointError, RunError) as error:
        sys.exit(f"unusable: {error}")


def check_at_least(arguments: object, **least: int) -> None:
    """Raise ``ValueError`` for a field of arguments that is smaller than it may be."""
    for name, smallest in least.items():
        if not (given := getattr(arguments, name)) >= smallest:
            raise ValueError(f"{name} is {given}; expected {smallest} or more")


def check_among(arguments: object, **known: Collection[str]) -> None:
    """Raise ``ValueError`` for a field of arguments that names something that there is not."""
    for name, names in known.items():
        if unknown := [one for one in getattr(arguments, name) if one not in names]:
            raise ValueError(f"{name} has {', '.join(unknown)}; expected among {', '.join(names)}")


def quiet_framework() -> None:
    """Keep what Lightning says of itself off the terminal: hints at its products, and at settings that are ours."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    for category in (UserWarning, DeprecationWarning, FutureWarning):
        warnings.filterwarnings("ignore", category=category, module=r"lightning\.")
