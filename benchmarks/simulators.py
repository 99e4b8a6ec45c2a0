"""Steps a second of the simulated worlds on one core, with observation and driver, against their bars.

    python benchmarks/simulators.py                    # both worlds
    python benchmarks/simulators.py --worlds maze2d

Everything runs on one core, the game engine of maze3d too. "wall" is the best of the repeats by the clock and
needs an idle core; "cpu" divides by the processor time that this process and its children used, which other
processes disturb less, and is what counts. Exit code 1 where a world is below its bar.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ngo_sim.driver_choice import DRIVER_NAMES, driver_generator, make_driver

BARS_STEPS_PER_S = {"maze2d": 10_000, "maze3d": 2_500}


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    worlds: tuple[str, ...] = ("maze2d", "maze3d")
    steps: int = 4000  # in one repeat
    repeats: int = 5  # each in another maze
    driver: str = "corners"

    def __post_init__(self) -> None:
        if unknown := set(self.worlds) - set(BARS_STEPS_PER_S):
            raise ValueError(f"worlds has {sorted(unknown)}; allowed: {', '.join(BARS_STEPS_PER_S)}")
        for name, value in (("steps", self.steps), ("repeats", self.repeats)):
            if value < 1:
                raise ValueError(f"{name} is {value}; it must be at least 1")
        if self.driver not in DRIVER_NAMES:
            raise ValueError(f"driver is {self.driver!r}; it must be one of {', '.join(DRIVER_NAMES)}")


@dataclass(frozen=True)
class Measurement:
    """Of one world, over all repeats."""

    world: str
    steps: int
    cpu_steps_per_s: float
    wall_steps_per_s: float
    reset_ms: float
    driver_us: float
    metres_per_step: float
    bar_steps_per_s: int

    @property
    def ratio(self) -> float:
        """Measured over required."""
        return self.cpu_steps_per_s / self.bar_steps_per_s


def make_world(name: str, seeds: range) -> Any:
    """The world in its default configuration, ready to be reset to the seeds."""
    if name == "maze2d":
        from ngo_sim.maze2d import Maze2D

        return Maze2D()
    from ngo_sim.maze3d import Maze3D

    world = Maze3D()
    world.preload(seeds)
    return world


def cpu_s() -> float:
    """Processor time of this process and of the children that are alive, s."""
    ticks = 0
    for children in Path("/proc/self/task").glob("*/children"):
        for child in children.read_text().split():
            # The name in parentheses may hold spaces; user and system time are fields 12 and 13 after it.
            fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
            ticks += int(fields[11]) + int(fields[12])
    return time.process_time() + ticks / os.sysconf("SC_CLK_TCK")


def timed(action: Callable[[], Any]) -> tuple[float, Any]:
    """Duration in s by the clock, and the result."""
    begin = time.perf_counter()
    result = action()
    return time.perf_counter() - begin, result


def measure(world_name: str, args: Arguments) -> Measurement:
    """Drive through `repeats` mazes, and before them through one where code is compiled and loaded."""
    seeds = range(args.repeats + 1)
    world = make_world(world_name, seeds)
    walls_s, resets_s, cpu_total_s, driver_s, metres = [], [], 0.0, 0.0, 0.0
    try:
        for seed in tqdm(seeds, world_name, unit="maze"):
            reset_s, (observation, info) = timed(partial(world.reset, seed=seed))
            driver = make_driver(args.driver, world.maze, driver_generator(seed))
            frames, travelled = [], 0.0
            cpu_begin, begin = cpu_s(), time.perf_counter()
            for _ in range(args.steps):
                pose = info["pose_xyyaw"]
                frames.append((pose, observation))
                observation, reward, _, _, info = world.step(int(driver.action(pose, observation)))
                travelled += reward
            wall_s, used_s = time.perf_counter() - begin, cpu_s() - cpu_begin
            if seed == seeds[0]:
                continue
            walls_s.append(wall_s)
            resets_s.append(reset_s)
            cpu_total_s += used_s
            metres += travelled
            alone = make_driver(args.driver, world.maze, driver_generator(seed))
            begin = time.process_time()
            for pose, observation in frames:
                alone.action(pose, observation)
            driver_s += time.process_time() - begin
    finally:
        world.close()
    steps = args.steps * args.repeats
    return Measurement(
        world=world_name,
        steps=steps,
        cpu_steps_per_s=steps / cpu_total_s,
        wall_steps_per_s=args.steps / min(walls_s),
        reset_ms=1e3 * min(resets_s),
        driver_us=1e6 * driver_s / steps,
        metres_per_step=metres / steps,
        bar_steps_per_s=BARS_STEPS_PER_S[world_name],
    )


def table(measurements: list[Measurement]) -> str:
    """One line a world."""
    lines = [
        f"{'world':8}{'steps':>8}{'cpu steps/s':>13}{'wall steps/s':>14}{'bar':>8}{'cpu / bar':>11}"
        f"{'driver us':>11}{'reset ms':>10}{'m a step':>10}"
    ]
    lines += [
        f"{m.world:8}{m.steps:8d}{m.cpu_steps_per_s:13,.0f}{m.wall_steps_per_s:14,.0f}"
        f"{m.bar_steps_per_s:8,d}{m.ratio:11.2f}{m.driver_us:11.1f}{m.reset_ms:10.1f}"
        f"{m.metres_per_step:10.3f}"
        for m in measurements
    ]
    return "\n".join(lines)


def main(args: Arguments) -> int:
    """Measure, print the table and, last, everything as one line of JSON; return the exit code."""
    # Children inherit it: the engine of maze3d shares this core.
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    measurements = [measure(world, args) for world in args.worlds]
    print(table(measurements))
    print(json.dumps({m.world: {**vars(m), "ratio": m.ratio} for m in measurements}))
    return 0 if all(m.ratio >= 1 for m in measurements) else 1


def parse(argv: list[str] | None = None) -> Arguments:
    """The arguments of a command line."""
    defaults = Arguments()
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--worlds", nargs="+", default=defaults.worlds, choices=tuple(BARS_STEPS_PER_S))
    parser.add_argument("--steps", type=int, default=defaults.steps, help="in one repeat")
    parser.add_argument("--repeats", type=int, default=defaults.repeats, help="each in another maze")
    parser.add_argument("--driver", default=defaults.driver, choices=DRIVER_NAMES)
    given = parser.parse_args(argv)
    try:
        return Arguments(tuple(given.worlds), given.steps, given.repeats, given.driver)
    except ValueError as error:
        parser.error(str(error))


if __name__ == "__main__":
    sys.exit(main(parse()))
