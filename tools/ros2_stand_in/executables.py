"""`ros2 run`: replaces this process by an installed executable of a package."""

import argparse
import os
import shlex
from collections.abc import Sequence
from pathlib import Path

from ros2_stand_in.errors import CommandError


def package_prefix(package: str) -> Path:
    """The install prefix of a package, from the ament index; CommandError where there is none."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix and Path(prefix, "share/ament_index/resource_index/packages", package).is_file():
            return Path(prefix)
    raise CommandError(f"Package '{package}' not found")


def executable_path(package: str, executable: str) -> Path:
    """The one executable of that name below the package's lib folder."""
    folder = package_prefix(package) / "lib" / package
    paths = sorted(p for p in folder.rglob(executable) if p.is_file() and os.access(p, os.X_OK))
    if not paths:
        raise CommandError("No executable found")
    if len(paths) > 1:
        found = "".join(f"\n- {path}" for path in paths)
        raise CommandError(f"Multiple executables found:{found}")
    return paths[0]


def run(arguments: Sequence[str]) -> int:
    """Replace this process: the executable gets the signals, and its exit code is the command's."""
    parser = argparse.ArgumentParser("ros2 run", description="Run an executable of a package.")
    parser.add_argument("--prefix", default="", help="command in front of the executable, e.g. 'nice -n 5'")
    parser.add_argument("package_name", help="name of the package")
    parser.add_argument("executable_name", help="name of the executable")
    parser.add_argument("argv", nargs=argparse.REMAINDER, help="arguments of the executable")
    options = parser.parse_args(arguments)
    path = executable_path(options.package_name, options.executable_name)
    command = [*shlex.split(options.prefix), str(path), *options.argv]
    os.execvp(command[0], command)
