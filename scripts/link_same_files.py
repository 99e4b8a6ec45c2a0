"""Gives large files of the same content below a folder one place on the disk: wheels hold libraries many times."""

import hashlib
import os
import sys
from collections import defaultdict
from pathlib import Path

LEAST_BYTES = 500_000


def link_same_files(folder: Path) -> int:
    """Make hard links of them; how many bytes that saves."""
    sizes: dict[int, list[Path]] = defaultdict(list)
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink() and path.stat().st_size >= LEAST_BYTES:
            sizes[path.stat().st_size].append(path)
    saved, firsts = 0, dict[str, Path]()
    for size, paths in sizes.items():
        for path in paths if len(paths) > 1 else ():
            first = firsts.setdefault(hashlib.sha256(path.read_bytes()).hexdigest(), path)
            if first.samefile(path):
                continue
            link = path.with_name(path.name + ".link")
            os.link(first, link)
            link.replace(path)
            saved += size
    return saved


if __name__ == "__main__":
    link_same_files(Path(sys.argv[1]))
