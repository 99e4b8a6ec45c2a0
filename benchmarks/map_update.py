"""How long a map takes to follow a loop: updates after a correction that moves every scan, as the trajectory grows.

    python -m benchmarks.map_update

One drive in one maze of the 2D world, on one core with one thread. The map is drawn at poses that are stretched by 2 %,
shifted and turned. Then it follows the true poses, as if a loop had been closed. The last line is one JSON object; exit
code 1 where one update takes longer than 0.5 s by the clock, or all of them together more than 1 s of processor time.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tqdm import tqdm

from benchmarks.drives import CACHE, drive_of, stamp_ns
from benchmarks.pinned import in_process, two_cores
from ngo_estimator.mapping.scan_map import ScanMap, warm_up
from ngo_estimator.mapping.scan_source import scan_source
from training.common.records import WEIGHTS

LONGEST_UPDATE_S, LONGEST_FOLLOW_S = 0.5, 1.0
BUDGET_S = 0.35
"""Time for scans that moved, as in ngo_map."""


@dataclass(frozen=True)
class Arguments:
    """What to drive."""

    world: str = "maze2d"
    """World to drive in."""
    seed: int = 2000
    """Maze to drive through."""
    frames: tuple[int, ...] = (2000, 20_000)
    """Lengths of the trajectories."""
    cache: Path = CACHE
    """Folder for the drive, which is made once."""

    def __post_init__(self) -> None:
        if not self.frames or min(self.frames) < 2:
            raise ValueError(f"frames are {self.frames}; expected lengths of at least 2")


def measure(arguments: Arguments, frames: int) -> dict[str, Any]:
    """Draw the map of so many frames, move all of it, and time the updates that follow."""
    world = arguments.world
    source = scan_source(WEIGHTS / world, world)
    if source is None:
        raise ValueError(f"the weights of {world} see no ranges; expected a world whose do")
    warm_up()
    drive = drive_of(world, arguments.seed, max(arguments.frames), arguments.cache)
    scan_map = ScanMap()
    stamps_ns = np.array([stamp_ns(frame) for frame in range(frames + 1)])
    true = np.concatenate((np.zeros((1, 3)), drive.truth[:frames]))
    bent = true * np.array([1.02, 1.02, 1.0]) + np.array([0.1, 0.1, 0.01])
    growing_s = 0.0
    for number, step in enumerate(tqdm(drive.steps(), desc="map", total=frames, unit="step"), 1):
        scan_map.take(step, source.scans(step))
        if number % 100 == 0 or number == frames:
            begin = time.perf_counter()
            scan_map.update(stamps_ns[: number + 1], bent[: number + 1])
            growing_s = max(growing_s, time.perf_counter() - begin)
        if number == frames:
            break
    updates_s, left, moved, cpu_s = [], 1, 0, time.process_time()
    while left:
        begin = time.perf_counter()
        update = scan_map.update(stamps_ns, true, BUDGET_S)
        scan_map.cells().trinary(0.25, 0.65)
        updates_s.append(time.perf_counter() - begin)
        left, moved = update.left, moved + update.moved
    return {
        "frames": frames,
        "scans": len(scan_map),
        "moved": moved,
        "updates": len(updates_s),
        "longest_update_s": round(max(updates_s), 4),
        "follow_s": round(sum(updates_s), 4),
        "follow_cpu_s": round(time.process_time() - cpu_s, 4),
        "hundred_frames_s": round(growing_s, 4),
    }


def main(arguments: Arguments) -> int:
    """Measure each length, print a line of JSON; return the exit code."""
    found = [in_process(two_cores()[0], measure, arguments, frames) for frames in sorted(arguments.frames)]
    print(json.dumps({"world": arguments.world, "budget_s": BUDGET_S, "lengths": found}))
    late = any(each["longest_update_s"] > LONGEST_UPDATE_S or each["follow_cpu_s"] > LONGEST_FOLLOW_S for each in found)
    return int(late)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
