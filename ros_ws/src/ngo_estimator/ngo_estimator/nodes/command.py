"""How a command ends: without a word, or with one line about what was wrong."""

import sys
from collections.abc import Callable
from typing import TypeVar

import tyro
from rich.console import Console

Given = TypeVar("Given")


def run_command(
    name: str, arguments: type[Given], description: str | None, run: Callable[[Given, Console], object]
) -> None:
    """Run the command of this name; a ``ValueError`` or ``OSError`` is one line, and exit code 2."""
    try:
        run(tyro.cli(arguments, prog=name, description=description), Console(soft_wrap=True, highlight=False))
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
