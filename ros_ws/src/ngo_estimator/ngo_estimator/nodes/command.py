"""How a command ends: without a word, or with one line about what was wrong."""

import sys
from collections.abc import Callable


def run_command(name: str, work: Callable[[], object]) -> None:
    """Do the work of the command of this name; a ``ValueError`` or ``OSError`` is one line, and exit code 2."""
    try:
        work()
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
