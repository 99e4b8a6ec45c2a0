"""Sorts the packages of one lock file into requirements/locked.txt, locked_ros.txt and locked_gpu.txt."""

import re
import sys
from pathlib import Path

REQUIREMENTS = Path(__file__).parents[1] / "requirements"
KINDS = {"locked_gpu": r"(nvidia|cuda|triton)[\w-]*==", "locked_ros": r"ros-", "locked": r""}


def main(whole: Path, torch_hashes: list[str]) -> None:
    """Write the three files; their comments stay. torch_hashes: of builds of PyTorch that are not on PyPI."""
    parts: dict[str, list[str]] = {kind: [] for kind in KINDS}
    for entry in filter(str.strip, re.split(r"(?m)^(?=[A-Za-z0-9])", whole.read_text())):
        kind = next(kind for kind, begin in KINDS.items() if re.match(begin, entry))
        more = torch_hashes if entry.startswith("torch==") else []
        parts[kind].append(" \\\n    ".join([entry.rstrip(), *(f"--hash=sha256:{one}" for one in more)]) + "\n")
    for kind, entries in parts.items():
        path = REQUIREMENTS / f"{kind}.txt"
        comments = [line for line in path.read_text().splitlines(keepends=True) if line.startswith("#")]
        path.write_text("".join([*comments, *entries]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
