"""Sorts one lock file into the files requirements/locked*.txt, by what needs a package."""

import re
import sys
from pathlib import Path

REQUIREMENTS = Path(__file__).parents[1] / "requirements"
KINDS = {"locked_gpu": r"(nvidia[\w-]*|cuda[\w-]*|triton|torch)==", "locked_ros": r"ros-", "locked": r""}


def _entries(lock: Path) -> list[str]:
    return re.split(r"(?m)^(?=[A-Za-z0-9])", lock.read_text())[1:]


def main(whole: Path, lidar: Path, kilted: Path, torch_hashes: list[str]) -> None:
    """Write the six files; their comments stay. torch_hashes: of PyTorch's CPU builds, which are not on PyPI.

    ``lidar``: a lock of what the estimators of a lidar need, of which the names count. ``kilted``: one of
    the wheels of ROS 2 Kilted, which count alone.
    """
    parts: dict[str, list[str]] = {kind: [] for kind in (*KINDS, "locked_lidar", "locked_cpu")}
    of_lidar = set(re.findall(r"(?m)^([\w.-]+)==", lidar.read_text()))
    for entry in _entries(whole):
        kind = next(kind for kind, begin in KINDS.items() if re.match(begin, entry))
        if kind == "locked" and entry.partition("==")[0] in of_lidar:
            kind = "locked_lidar"
        parts[kind].append(entry.rstrip() + "\n")
        if entry.startswith("torch=="):
            # A version of its own: where an index has no CPU build, pip says so at once.
            build = [entry.split()[0] + "+cpu", *(f"--hash=sha256:{one}" for one in torch_hashes)]
            parts["locked_cpu"].append(" \\\n    ".join(build) + "\n")
    parts["locked_ros_kilted"] = [f"{entry.rstrip()}\n" for entry in _entries(kilted) if entry.startswith("ros-")]
    locked, of_kilted = ({entry.partition("==")[0] for entry in _entries(lock)} for lock in (whole, kilted))
    if missing := sorted(name for name in of_kilted - locked if not name.startswith("ros-")):
        sys.exit(f"split_lock: ROS 2 Kilted needs {', '.join(missing)}, which the other locks do not have")
    for kind, entries in parts.items():
        path = REQUIREMENTS / f"{kind}.txt"
        comments = [line for line in path.read_text().splitlines(keepends=True) if line.startswith("#")]
        path.write_text("".join([*comments, *entries]))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]), sys.argv[4:])
