"""Drive through an unseen maze with the three nodes as real processes; record, and compare with the truth.

    python demo/run.py --world maze3d --seed 2000 --frames 1000
    python demo/run.py --world maze2d --mazes 20          # seeds 2000 to 2019, and a summary
    python demo/run.py --rate 35 --latency                # also how long a frame takes to the corrected path
    python demo/run.py --world explore                    # a building is mapped from nothing, by the robot's own drive
    python demo/run.py --view                             # a live view in the browser: `make demo VIEW=1` installs it

The last line printed is the result as one JSON object.
"""

from __future__ import annotations

import argparse
import signal
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from demo.graph import GraphError
from demo.report import latency_table, print_json, result_table, summary_table
from demo.session import Session, SessionConfig
from demo.trajectories import summarise
from demo.view import DemoView

OUT = Path(__file__).resolve().parent / "out"


def parse_arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=("maze3d", "maze2d", "explore"), default="maze3d", help="what")
    parser.add_argument("--seed", type=int, default=2000, help="maze, textures, start, noise and driver (default 2000)")
    parser.add_argument("--frames", type=int, default=1000, help="frames to drive (default 1000)")
    parser.add_argument("--mazes", type=int, default=1, help="how many mazes, of consecutive seeds (default 1)")
    parser.add_argument(
        "--rate",
        type=float,
        default=0.0,
        help="frames a second; 0, the default: as fast as the estimators take them, none lost",
    )
    parser.add_argument("--latency", action="store_true", help="report the time from image to corrected path")
    parser.add_argument("--view", action="store_true", help="show the run live in the browser; needs rerun")
    parser.add_argument("--weights", type=Path, help="folder of weights (default: those that ship)")
    parser.add_argument("--out", type=Path, help="folder for recording, picture, logs (default demo/out/WORLD_SEED)")
    arguments = parser.parse_args(argv)
    for name, low in (("seed", 0), ("frames", 3), ("mazes", 1), ("rate", 0)):
        if not getattr(arguments, name) >= low:
            parser.error(f"argument --{name}: {getattr(arguments, name)} is not allowed; at least {low}")
    if arguments.world == "explore" and (arguments.mazes > 1 or arguments.latency):
        parser.error("argument --world: explore takes neither --mazes nor --latency")
    if arguments.view and arguments.mazes > 1:
        parser.error(f"argument --view: it shows one maze; --mazes is {arguments.mazes}")
    return arguments


def run_one(
    arguments: argparse.Namespace, seed: int, out: Path, console: Console, view: DemoView | None = None
) -> dict[str, Any]:
    """Drive through one maze with a progress bar; return its result, which also lies in out."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    drive = (arguments.world, seed, arguments.frames, arguments.rate)
    config = SessionConfig(*drive, arguments.weights, views=int(arguments.view))
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(f"{arguments.world} seed {seed}: starting", total=arguments.frames)

        def show(state: str, frames: int) -> None:
            progress.update(task, description=f"{arguments.world} seed {seed}: {state}", completed=frames)

        return Session(config, out, view.domain_id if view else None).run(show, with_latency=arguments.latency)


def show_exploration(arguments: argparse.Namespace, out: Path, console: Console, view: DemoView | None) -> None:
    """Let the robot map a building, and print what came of it."""
    from demo.explore import ExploreConfig, ExploreDemo  # what the other worlds do without

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:.0f} %"),
        TimeElapsedColumn(),
    )
    config = ExploreConfig(arguments.seed, rate=arguments.rate or 10.0)
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("explore", total=1.0)
        result = ExploreDemo(config, out, view.domain_id if view else None).run(
            lambda state, seen: progress.update(task, description=f"seed {config.seed}: {state}", completed=seen)
        )
    console.print(f"picture and logs: {out}", soft_wrap=True)
    print_json(result, out / "result.json")


def show_one(arguments: argparse.Namespace, out: Path, console: Console) -> None:
    """Run once, with a live view on request, and print the result."""
    with DemoView(out / "logs") if arguments.view else nullcontext() as view:
        if view is not None:
            console.print(f"live view: {view.url}", soft_wrap=True)
        if arguments.world == "explore":
            show_exploration(arguments, out, console, view)
        else:
            show_drive(arguments, out, console, view)
        if view is not None:
            view.stay()


def show_drive(arguments: argparse.Namespace, out: Path, console: Console, view: DemoView | None) -> None:
    """Drive through one maze, and print what came of it."""
    result = run_one(arguments, arguments.seed, out, console, view)
    console.print(result_table(result))
    if "latency_ms" in result:
        console.print(latency_table(result["latency_ms"]))
    console.print(f"picture, recording and logs: {out}", soft_wrap=True)
    print_json(result, out / "result.json")


def main(argv: list[str] | None = None) -> int:
    """Run the demo; return the exit code."""
    arguments = parse_arguments(argv)
    console = Console(stderr=False)
    out = arguments.out or OUT / f"{arguments.world}_{arguments.seed}"
    try:
        if arguments.mazes == 1:
            show_one(arguments, out, console)
        else:
            seeds = range(arguments.seed, arguments.seed + arguments.mazes)
            out = arguments.out or OUT / f"{arguments.world}_{seeds[0]}_to_{seeds[-1]}"
            results = [run_one(arguments, seed, out / str(seed), console) for seed in seeds]
            summary = summarise(results)
            console.print(summary_table(summary))
            print_json(summary, out / "summary.json")
    except GraphError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("demo: stopped", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    # Not Ctrl-C alone, also a closed terminal or a plain kill must end the nodes, which have sessions of their own.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
