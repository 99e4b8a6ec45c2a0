"""Measure how consistent deviations are with faults of the sensor, and in worlds that the networks do not know.

    python -m training.faults

A fault begins after a quarter of each drive and stays. Doom's scenarios are driven by the weights of maze3d. The
command writes ``training/results/faults.json`` and ``docs/results_faults.md``. Run it again to continue after a stop.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ngo_estimator.checkpoint import load_local, load_place
from ngo_estimator.frontend.camera import local_odometry
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.slam import online_trajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.common.command_line import check_at_least, run_command
from training.data.episodes import simulate
from training.data.faults import SensedDrive, faulted
from training.data.worlds import TEST_SEEDS, VALIDATION_SEEDS, world_named
from training.report import faults_page
from training.report.folders import Folders
from training.scoring import consistency
from training.scoring.consistency import ConsistencyRun, consistency_run
from training.scoring.table import Drive, Measured, Row, column, folder_digest, intervals, means_over_samples, measure

CLEAN = "clean"
FAULTS_OF = {
    "maze2d": ("frozen", "repeating", "noise", "lost"),
    "maze3d": ("frozen", "repeating", "noise", "lost", "black"),
}
SCENARIOS = {
    "test": ("my_way_home", "health_gathering", "health_gathering_supreme", "deadly_corridor"),
    "validation": ("deathmatch", "defend_the_center", "defend_the_line"),
}
"""Maps that ViZDoom ships, each the first of a WAD of its name. Everything was chosen on those of validation."""

_CODE = (consistency, local_odometry, online_trajectory)
_DOOM_SEEDS = {"test": 20_000, "validation": 11_000}
_SEEDS = {"test": TEST_SEEDS, "validation": VALIDATION_SEEDS}


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the measurement."""

    split: Literal["validation", "test"] = "test"
    """Mazes and scenarios to measure in. Everything is chosen on validation; test is for the final table alone."""
    mazes: int = 6  # Drives of each row, each in a maze of its own.
    frames: int = 600  # Frames of a drive.
    worlds: tuple[Literal["maze2d", "maze3d", "doom"], ...] = ("maze2d", "maze3d", "doom")  # Worlds to measure.

    def __post_init__(self) -> None:
        check_at_least(self, mazes=2, frames=100)


@dataclass(frozen=True)
class _Cores:
    """The estimators of a world, and its local odometry without what tells unlike input."""

    local: LocalOdometry
    plain: LocalOdometry
    online: OnlineTrajectory

    @classmethod
    def load(cls, folder: Path, world: str) -> _Cores:
        plain = LocalOdometry(load_local(folder, world)[0], load_place(folder, world)[0], world)
        return cls(LocalOdometry.load(folder, world), plain, OnlineTrajectory.load(folder, world=world))


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    torch.set_num_threads(1)
    result = {
        **arguments.made("faults"),
        "split": arguments.split,
        "drives": arguments.mazes,
        "frames": arguments.frames,
        "tables": {world: _table(arguments, world) for world in arguments.worlds},
    }
    return arguments.publish("faults", result, faults_page.page(result))


def _table(arguments: Arguments, world: str) -> dict[str, Any]:
    """Of a world by the fault: means over drives."""
    networks = "maze3d" if world == "doom" else world
    weights = arguments.weights / networks
    cores, identity = _Cores.load(weights, networks), folder_digest(weights)
    folder = arguments.runs / "faults" / arguments.split
    table: dict[str, Any] = {}
    for name in SCENARIOS[arguments.split] if world == "doom" else (CLEAN, *FAULTS_OF[world]):
        row = Row(partial(_measured, cores=cores, clean=name == CLEAN), identity, _CODE)
        plan = [(_drive(arguments, world, name, number), {"ours": row}) for number in range(arguments.mazes)]
        table[name] = _summary(column(measure(plan, folder, f"{world} {name}"), "ours"))
    return table


def _measured(drive: SensedDrive, cores: _Cores, clean: bool) -> Measured:
    values = dataclasses.asdict(consistency_run(cores.local, cores.online, drive))
    if clean:
        plain: ConsistencyRun = consistency_run(cores.plain, cores.online, drive)
        values["deviation_growth"] = values["deviation_m"] / plain.deviation_m
        values["odometry_deviation_growth"] = values["odometry_deviation_m"] / plain.odometry_deviation_m
    return Measured.of(values)


def _drive(arguments: Arguments, world: str, name: str, number: int) -> Drive:
    named = f"{world}_{name}_{number}_{arguments.frames}"
    if world == "doom":
        return Drive(named, f"{arguments.split} {named}", partial(_doom_drive, arguments, name, number))
    return Drive(named, f"{arguments.split} {named}", partial(_maze_drive, arguments, world, name, number))


def _maze_drive(arguments: Arguments, name_of_world: str, fault: str, number: int) -> SensedDrive:
    world, seeds = world_named(name_of_world), _SEEDS[arguments.split]
    seed = seeds[len(seeds) // 4 + number]  # no table of results takes these
    drive = SensedDrive.of_episode(world, next(iter(simulate(world, [seed], arguments.frames))))
    return drive if fault == CLEAN else faulted(drive, fault, arguments.frames // 4, seed)


def _doom_drive(arguments: Arguments, scenario: str, number: int) -> SensedDrive:
    from ngo_sim.episodes import record_episode
    from ngo_sim.maze3d import Maze3D, Maze3DConfig

    env = Maze3D(Maze3DConfig(wad=f"{scenario}.wad", map="map01"))
    try:
        episode = record_episode(env, "explorer", arguments.frames, _DOOM_SEEDS[arguments.split] + number)
    finally:
        env.close()
    return SensedDrive.of_episode(world_named("maze3d"), episode)


def _summary(found: list[Measured]) -> dict[str, Any]:
    """Means with intervals, and the largest ratio of corrected to odometry."""
    means = means_over_samples(found)
    ratio = means["corrected_m"] / np.maximum(means["odometry_m"], 1e-9)
    return {
        **intervals(means),
        "corrected_to_odometry": {"mean": float(ratio.mean()), "largest": float(ratio.max())},
    }


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
