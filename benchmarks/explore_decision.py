"""How long the explorer takes to update its map and to decide, on a map of 2,000 x 2,000 cells, last a line of JSON.

    python -m benchmarks.explore_decision

The map is 100 m x 100 m of rooms with doors, with furniture, that becomes known around a robot that drives through it.
Times are processor times of one core. What the second half of the decisions adds to the most memory used says whether
it is flat.
"""

from __future__ import annotations

import argparse
import json
import resource
import time

import numpy as np

from ngo_explorer.exploration import Exploration
from ngo_explorer.settings import ExplorerConfig
from ngo_explorer.warm_up import warm_up

_RESOLUTION_M = 0.05
_ROOM, _DOOR = 100, 22  # cells
_SEEN = 160  # cells around the robot that become known at each decision


def rooms(cells: int, rng: np.random.Generator) -> np.ndarray:
    """Values of a map of rooms of 5 m with doors of 1.1 m in all walls, and boxes in the rooms."""
    values = np.zeros((cells, cells), np.int8)
    for wall in range(0, cells, _ROOM):
        values[wall : wall + 3] = values[:, wall : wall + 3] = 100
    for row in range(0, cells, _ROOM):
        for column in range(0, cells, _ROOM):
            across, along = rng.integers(10, _ROOM - _DOOR - 10, 2)
            values[row : row + 3, column + across : column + across + _DOOR] = 0
            values[row + along : row + along + _DOOR, column : column + 3] = 0
            for _ in range(4):
                top, left = rng.integers(15, _ROOM - 25, 2)
                values[row + top : row + top + rng.integers(4, 14), column + left : column + left + 8] = 100
    values[:3] = values[-3:] = values[:, :3] = values[:, -3:] = 100
    return values


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=2000, help="cells along a side (default 2000)")
    parser.add_argument("--decisions", type=int, default=150, help="decisions to time (default 150)")
    arguments = parser.parse_args()
    warm_up()
    rng = np.random.default_rng(0)
    truth, known = rooms(arguments.cells, rng), np.full((arguments.cells,) * 2, -1, np.int8)
    # As much is known at first as is known in the middle of an exploration.
    known[: arguments.cells // 2] = truth[: arguments.cells // 2]
    exploration = Exploration(ExplorerConfig())
    robot = np.array((arguments.cells * 0.025 + 1.5, arguments.cells * 0.025 - 1.5, 0.0))
    exploration.known.update(known, _RESOLUTION_M, np.zeros(2))
    updates, decisions, memory_mb = [], [], []
    for number in range(arguments.decisions):
        begun_s = time.process_time()
        goal = exploration.decide(robot, 2.0 * number)
        decided_s = time.process_time()
        if goal is None:
            break
        robot[:2] = goal.pose_xyyaw[:2]
        row, column = (robot[1::-1] / _RESOLUTION_M).astype(int)
        part = slice(max(0, row - _SEEN), row + _SEEN), slice(max(0, column - _SEEN), column + _SEEN)
        known[part] = truth[part]
        updated_s = time.process_time()
        exploration.known.update(known, _RESOLUTION_M, np.zeros(2), part)
        updates.append(1e3 * (time.process_time() - updated_s))
        decisions.append(1e3 * (decided_s - begun_s) + updates[-1])
        exploration.arrived()
        memory_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
    result = {
        "cells": arguments.cells,
        "decisions": len(decisions),
        "update_p99_ms": round(float(np.percentile(updates, 99)), 1),
        "decision_median_ms": round(float(np.median(decisions)), 1),
        "decision_p99_ms": round(float(np.percentile(decisions, 99)), 1),
        "peak_memory_mb": memory_mb[-1],
        "second_half_adds_mb": memory_mb[-1] - memory_mb[len(memory_mb) // 2],
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
