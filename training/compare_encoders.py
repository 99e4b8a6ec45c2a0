"""Width and picture size of the 3D world's local network, each trained for the same time.

    python -m training.compare_encoders --minutes 6

Each training gets as many frame pairs as its throughput, measured first, makes of the minutes, on one thread beside
one process that simulates: times mean something on two idle cores. Run again, it goes on where it was stopped and skips
what is finished. The last line is the result as JSON; it goes to training/results/ as well, and its table to docs/.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from ngo_estimator.checkpoint import load_local
from training import runs, train_local
from training.curves import write_at_once
from training.encoder_measures import inference_ms, pairs_a_second
from training.results_page import interval, markdown, number
from training.validation_steps import measured
from training.worlds import world_named

NAME = "encoders"
_WORLD = "maze3d"


@dataclass(frozen=True)
class Arguments:
    """What to compare."""

    widths: tuple[float, ...] = (0.125, 0.25, 0.5)
    """Channels of the convolutions, as fractions of FlowNetS's."""
    heights: tuple[int, ...] = (30, 60, 120)
    """Rows of the pictures, as picture_height of train_local."""
    minutes: float = 6.0
    """Training time of each network."""
    epochs: int = 2
    """Passes of new data that the time is divided into, of 3200 pairs at least."""
    batch_size: int = 256
    """Frame pairs in a step of the optimiser."""
    probe_s: float = 20.0
    """Time in which the throughput of a training is measured."""
    mazes: int = 24
    """Validation mazes that the networks are compared in."""
    frames: int = 1000
    """Length of an episode in them."""
    validation_mazes: int = 2
    """Mazes that each epoch is measured in."""
    calibration_mazes: int = 8
    """Mazes that each network's output is calibrated in."""
    workers: int = 1
    """Processes that simulate beside the training."""
    seed: int = 0
    """Seed of the initial weights."""
    out: Path = runs.ROOT / "training" / "results"
    """Folder that gets maze3d_encoders.json."""
    docs: Path = runs.ROOT / "docs"
    """Folder that gets encoders_maze3d.md."""
    runs: Path = runs.ROOT / "runs"
    """Folder that gets maze3d/encoders/, with each network, its run and its result."""

    def __post_init__(self) -> None:
        if not self.widths or not self.heights:
            raise ValueError("widths or heights is empty; expected one of each at least")
        if not (self.minutes > 0.0 and self.probe_s > 0.0):
            raise ValueError(f"minutes, probe_s are {self.minutes:g}, {self.probe_s:g}; expected positive times")


def main(arguments: Arguments) -> dict[str, Any]:
    """Train and measure what is missing, write JSON and page, print the table and return what the JSON holds."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        networks = [finished(arguments, h, w) for h in arguments.heights for w in arguments.widths]
    finally:
        torch.set_num_threads(threads)
    result: dict[str, Any] = {
        **json.loads(json.dumps(runs.record("compare_encoders", arguments))),
        "networks": networks,
    }
    write_at_once(arguments.out / f"{_WORLD}_{NAME}.json", json.dumps(result, indent=2) + "\n")
    write_at_once(arguments.docs / f"{NAME}_{_WORLD}.md", page(result))
    print(table(networks))
    print(json.dumps(result))
    return result


def finished(arguments: Arguments, height: int, width: float) -> dict[str, Any]:
    """The result of one network, made now or by an earlier call with the same settings.

    Raises:
        RunError: the network's folder holds one of other settings.
    """
    folder = arguments.runs / _WORLD / NAME / f"{height}-{width:g}"
    settings = _settings(arguments)
    kept = folder / "result.json"
    if kept.exists():
        result: dict[str, Any] = json.loads(kept.read_text())
        _check(folder, result.pop("settings"), settings)
        return result
    train = training_arguments(arguments, height, width, folder)
    if not (train.out / _WORLD / "local_pose_network.safetensors").exists():
        train_local.main(train)
    network, description = load_local(train.out / _WORLD, _WORLD)
    world = world_named(_WORLD).with_pictures(height)
    training = description["training"]
    result = {
        "height": height,
        "image_width": world.image.width,
        "width": width,
        "parameters": sum(tensor.numel() for tensor in network.parameters()),
        "pairs": round(training["seconds"] * training["datapoints_per_s"]),
        "training_minutes": training["seconds"] / 60.0,
        "pairs_a_second": training["datapoints_per_s"],
        "inference_ms": inference_ms(network, world),
        **measured(network, world, arguments.mazes, arguments.frames),
    }
    write_at_once(kept, json.dumps({**result, "settings": settings}, indent=2) + "\n")
    return result


def training_arguments(arguments: Arguments, height: int, width: float, folder: Path) -> train_local.Arguments:
    """Those of one training; the number of pairs is measured once, and kept for a training that goes on."""
    world = world_named(_WORLD)
    train = train_local.Arguments(
        world="maze3d",
        width=width,
        epochs=arguments.epochs,
        batch_size=arguments.batch_size,
        validation_mazes=arguments.validation_mazes,
        calibration_mazes=arguments.calibration_mazes,
        picture_height=None if height == world.image.height else height,
        workers=arguments.workers,
        seed=arguments.seed,
        accelerator="cpu",
        out=folder / "weights",
        runs=folder / "runs",
    )
    plan, settings = folder / "plan.json", _settings(arguments)
    if plan.exists():
        planned = json.loads(plan.read_text())
        _check(folder, planned["settings"], settings)
    else:
        rate = pairs_a_second(train, arguments.probe_s)
        pairs = max(1, round(rate * 60.0 * arguments.minutes / arguments.epochs))
        planned = {"pairs_a_second": rate, "datapoints": pairs, "settings": settings}
        write_at_once(plan, json.dumps(planned, indent=2) + "\n")
    return dataclasses.replace(train, datapoints=planned["datapoints"])


def _settings(arguments: Arguments) -> dict[str, Any]:
    """What a network's result depends on beside its width and height."""
    values = dataclasses.asdict(arguments)
    return {k: v for k, v in values.items() if k not in ("widths", "heights", "probe_s", "runs", "out", "docs")}


def _check(folder: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    if differing := sorted(name for name in then.keys() | now.keys() if then.get(name) != now.get(name)):
        given = ", ".join(f"{name} {now.get(name)}" for name in differing)
        expected = ", ".join(f"{name} {then.get(name)}" for name in differing)
        raise runs.RunError(f"{folder} holds a network of other settings: given {given}; expected {expected}, or the "
                            "folder removed to begin anew")  # fmt: skip


def page(result: dict[str, Any]) -> str:
    """The page's text."""
    settings = result["arguments"]
    parts = [
        f"<!-- Made by `{result['command']}`; changes belong into training/compare_encoders.py. -->",
        "# Encoders of the 3D world's local network",
        f"`{result['command']}` at revision `{result['revision']}`: each network was trained for about "
        f"{settings['minutes']:g} minutes, on one thread beside a process that simulates, with as many frame pairs as "
        f"its throughput makes of them, then measured on {settings['mazes']} validation mazes of "
        f"{settings['frames']} frames. In brackets are 95 % bootstrap intervals over mazes. Speed of training counts "
        "simulation and the validation of each epoch; inference is the network alone on one pair and its mirror image, "
        "one thread. Numbers in full are in "
        "[`training/results/maze3d_encoders.json`](../training/results/maze3d_encoders.json).",
        table(result["networks"]),
    ]
    return "\n\n".join(parts) + "\n"


def table(networks: list[dict[str, Any]]) -> str:
    """What was measured of each network, in Markdown."""
    header = ["Picture", "Width", "Parameters", "Pairs", "Trained, min", "Pairs/s", "RMSE of a step, m",
              "RMSE of a step, deg", "Odometry's final error, %", "Inference, ms"]  # fmt: skip
    rows = [
        [
            f"{one['image_width']} x {one['height']}",
            f"{one['width']:g}",
            f"{one['parameters']:,}",
            f"{one['pairs']:,}",
            number(one["training_minutes"]),
            f"{one['pairs_a_second']:.0f}",
            *(interval(one[key]) for key in ("rmse_m", "rmse_deg", "final_percent")),
            number(one["inference_ms"]),
        ]
        for one in networks
    ]
    return markdown(header, rows)


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
