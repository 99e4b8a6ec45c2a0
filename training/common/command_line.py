"""How the commands of the training start and end."""

import sys
from collections.abc import Callable
from typing import Any

import tyro

from ngo_estimator.checkpoint import CheckpointError
from ngo_recordings.errors import RecordingError
from training.common.runs import RunError


def run_command(main: Callable[[Any], object], arguments: type[Any], description: str | None) -> None:
    """Run a script with the command line's arguments; what recordings, weights or runs lack ends it with one line."""
    try:
        main(tyro.cli(arguments, description=description))
    except (RecordingError, CheckpointError, RunError) as error:
        sys.exit(f"unusable: {error}")
