"""How far each driver gets in mazes of the validation split: way, ground covered, and both beside the random driver's.

    python -m training.compare_drivers --world maze3d --trajectories 64

Way is the length of the true path. Ground is what was covered of the maze, however often: the different squares of 1 m
that the robot's middle was in, and the different blocks of corridor. The last line is the table as JSON, which goes to
training/results/ as well.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from ngo_sim.driver_choice import DRIVER_NAMES
from ngo_sim.episodes import Episode, record_episode
from training import runs
from training.curves import write_at_once
from training.statistics import compare, mean_interval
from training.worlds import VALIDATION_SEEDS, world_named

MEASURES = ("way_m", "squares", "blocks")
BASELINE = "random"


@dataclass(frozen=True)
class Arguments:
    """What to compare."""

    world: Literal["maze2d", "maze3d"] = "maze3d"
    """World whose mazes are driven through, of the simulator's own size."""
    trajectories: int = 20
    """Mazes, each driven through once by each driver."""
    frames: int = 1000
    """Length of a trajectory."""
    drivers: tuple[str, ...] = ("random_goals", "corners", "distance", "learned", "explorer")
    """Drivers beside the random one."""
    out: Path = runs.ROOT / "training" / "results"
    """Folder that gets WORLD_drivers.json."""

    def __post_init__(self) -> None:
        if not 2 <= self.trajectories <= len(VALIDATION_SEEDS):
            raise ValueError(f"trajectories is {self.trajectories}; it must be from 2 to {len(VALIDATION_SEEDS)}")
        if self.frames < 2:
            raise ValueError(f"frames is {self.frames}; it must be at least 2")
        if unknown := sorted(set(self.drivers) - set(DRIVER_NAMES)):
            raise ValueError(f"drivers has {unknown}; they must be among {', '.join(DRIVER_NAMES)}")


def measure(episode: Episode) -> tuple[float, int, int]:
    """The length of the true path, m, and the numbers of different squares of 1 m and blocks on it."""
    assert episode.maze is not None  # worlds are mazes
    positions = episode.poses_xyyaw[:, :2]
    way_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
    squares = {tuple(square) for square in np.floor(positions).astype(int).tolist()}
    return way_m, len(squares), len({episode.maze.block_at(x, y) for x, y in positions.tolist()})


def main(arguments: Arguments) -> dict[str, dict[str, dict[str, object]]]:
    """Drive, print the table, write and return it: of each driver and measure the mean and how often the baseline's."""
    env = world_named(arguments.world).make()
    drivers = tuple(dict.fromkeys((*arguments.drivers, BASELINE)))
    seeds = list(VALIDATION_SEEDS[: arguments.trajectories])
    found: dict[str, np.ndarray] = {}
    try:
        if hasattr(env, "preload"):
            env.preload(seeds)
        for driver in drivers:
            rows = [measure(record_episode(env, driver, arguments.frames, seed)) for seed in seeds]
            found[driver] = np.array(rows, dtype=np.float64).T
    finally:
        env.close()
    table: dict[str, dict[str, dict[str, object]]] = {}
    print(f"{arguments.frames} frames in each of {arguments.trajectories} mazes of {arguments.world}; 95 % intervals")
    print(f"{'driver':14}" + "".join(f"{name:>24}{'times random':>22}" for name in MEASURES))
    for driver, values in found.items():
        table[driver], cells = {}, []
        for name, own, other in zip(MEASURES, values, found[BASELINE], strict=True):
            mean, ratio = mean_interval(own), compare(own, other).relative_percent
            times = [1.0 + percent / 100.0 for percent in (ratio.mean, ratio.low, ratio.high)]
            table[driver][name] = {**mean.as_json(), "times_random": times[0], "times_random_ci95": times[1:]}
            cells.append(f"{mean.mean:10.1f} ({mean.low:.1f}, {mean.high:.1f})".rjust(24))
            cells.append(f"{times[0]:.2f} ({times[1]:.2f}, {times[2]:.2f})".rjust(22))
        print(f"{driver:14}" + "".join(cells))
    result = {**runs.record("compare_drivers", arguments), "drivers": table}
    write_at_once(arguments.out / f"{arguments.world}_drivers.json", json.dumps(result, indent=2) + "\n")
    print(json.dumps(result))
    return table


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
