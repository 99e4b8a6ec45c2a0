"""Several robots on one core: what the odometries and the common map of four robots take, beside those of one.

    python -m benchmarks.fleet

Robots drive through a simulated building at the same time, with 360 rays ten times a second each. Everything computes
on one core. The output is one JSON object: processor time a scan (ms) of the odometry, and of the common map with one
robot and with all. ``ratio`` is that of all by that of one, a scan. ``share_of_the_core`` is what the odometries and
the map of all take of it in real time. Exit code 1 where they need more time than there is, or where a robot's step
takes longer than ``LONGEST_S``.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import tyro

from benchmarks.pinned import in_process, two_cores
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.slam.fleet import Fleet
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from training.common.records import WEIGHTS
from training.data.fleet_drives import RATE_HZ, fleet_drives
from training.scoring.fleet_rows import FleetRuns

LONGEST_S = 1.0


@dataclass(frozen=True)
class Arguments:
    """What to drive."""

    seed: int = 12_000  # Building to drive through.
    robots: int = 4  # Robots in it.
    scans: int = 1500  # Scans of each.

    def __post_init__(self) -> None:
        if self.robots < 2 or self.scans < 100:
            raise ValueError(f"robots, scans are {self.robots}, {self.scans}; expected at least 2 and 100")


def timed(names: Sequence[str], steps: Sequence[tuple[int, RelativeStep]]) -> tuple[Fleet, list[float]]:
    """The robots' map, and the processor time (s) of each step with what it made due."""
    fleet, times_s = Fleet(ScanTrajectory.load(WEIGHTS / "scan", "scan"), names), []
    for robot, step in steps:
        began = time.process_time()
        fleet.update(names[robot], step)
        fleet.correct()
        times_s.append(time.process_time() - began)
    return fleet, times_s


def measure(arguments: Arguments) -> dict[str, Any]:
    """Drive, then map with one robot and with all of them."""
    runs = FleetRuns(fleet_drives(arguments.seed, arguments.robots, arguments.scans), WEIGHTS / "scan")
    steps = list(runs.steps())
    timed(runs.names, steps[: len(steps) // 4])  # compiles
    _, alone = timed(runs.names[:1], [step for step in steps if step[0] == 0])
    fleet, together = timed(runs.names, steps)
    scans = arguments.robots * arguments.scans
    odometry_s, alone_s, together_s = runs.odometry_s, sum(alone) / arguments.scans, sum(together) / scans
    return {
        "robots": arguments.robots,
        "rate_hz": RATE_HZ,
        "scans": arguments.scans,
        "met": sum(fleet.map_of(name) is None for name in runs.names),
        "odometry_ms_a_scan": round(1e3 * odometry_s / scans, 3),
        "map_ms_a_scan_one_robot": round(1e3 * alone_s, 3),
        "map_ms_a_scan_all_robots": round(1e3 * together_s, 3),
        "longest_step_s": round(max(together), 3),
        "ratio": round(together_s / alone_s, 2),
        "share_of_the_core_one_robot": round((odometry_s / scans + alone_s) * RATE_HZ, 3),
        "share_of_the_core": round((odometry_s / scans + together_s) * RATE_HZ * arguments.robots, 3),
    }


def main(arguments: Arguments) -> int:
    """Measure, print a line of JSON; return the exit code."""
    found = in_process(two_cores()[0], measure, arguments)
    print(json.dumps(found))
    return int(found["share_of_the_core"] > 1.0 or found["longest_step_s"] > LONGEST_S)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
