"""What training in varied looks is worth in mazes whose textures were never seen, by one command from nothing.

    python -m training.ablate_looks

trains a local pose network and a place encoder of the 3D world twice on as much data, in mazes of one look and in mazes
of varied looks (``training/looks.py``), measures all four on validation mazes in the plain look, in held-out textures,
and in these with other lights, widths and decorations, and writes ``training/results/maze3d_looks.json`` and
``docs/results_maze3d_looks.md``. Run again, it goes on where it was stopped, and makes nothing twice.
"""

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from tqdm import tqdm

from ngo_estimator.checkpoint import LOCAL, PLACE, load_description, load_local, load_place
from training import runs, train_local, train_place
from training.curves import write_at_once
from training.looks import HELD_OUT, MEASURED_LOOKS, TRAINING_LOOKS, LooksName
from training.looks_page import page
from training.looks_scores import Scores, local_scores, place_scores, table_json
from training.recorded import run_script
from training.worlds import WorldName, world_named

WORLD: WorldName = "maze3d"
_TABLE = "unseen"  # whose validation seeds the mazes have
_MAZES_A_GROUP = 8
_KEPT = ("command", "revision", "seconds", "datapoints_per_s")


@dataclass(frozen=True)
class Arguments:
    """Settings of the ablation; both trainings of a network have the same."""

    local_epochs: int = 4
    """Passes of new data for a local network."""
    local_datapoints: int = 80_000
    """Frame pairs in such a pass."""
    place_epochs: int = 5
    """Passes of new data for a place encoder."""
    place_batches: int = 256
    """Batches in such a pass."""
    mazes: int = 48
    """Validation mazes that local networks are measured in."""
    frames: int = 1001
    """Frames of an episode there."""
    place_groups: int = 12
    """Groups of 8 validation mazes that place encoders are measured in."""
    workers: int = 1
    """Processes that simulate beside a training."""
    seed: int = 0
    """Seed of the initial weights."""
    accelerator: str = "auto"
    """Kind of device of the trainings by Lightning's name, as cpu or gpu; auto: a GPU where there is one."""
    precision: Literal["bf16-mixed", "32-true"] = "bf16-mixed"
    """Arithmetic of the trainings."""
    out: Path = runs.ROOT / "training" / "results"
    """Folder that gets maze3d_looks.json."""
    docs: Path = runs.ROOT / "docs"
    """Folder that gets results_maze3d_looks.md."""
    runs: Path = runs.ROOT / "runs"
    """Folder that gets ablate_looks/ with weights, checkpoints, logs and what was measured."""

    def __post_init__(self) -> None:
        seeds = len(world_named(WORLD).table_seeds(_TABLE, "validation"))
        for name, low, high in (
            ("mazes", 2, seeds),
            ("place_groups", 2, seeds // _MAZES_A_GROUP),
            ("frames", 3, 100_000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} is {value}; expected {low} to {high}")

    @property
    def folder(self) -> Path:
        """Where everything is kept that is made on the way."""
        return self.runs / "ablate_looks"


def main(
    arguments: Arguments, local: train_local.Arguments | None = None, place: train_place.Arguments | None = None
) -> dict[str, Any]:
    """Make what is missing, write the JSON and the page, and return the JSON's content.

    local, place: other settings of the two scripts, of which those in ``arguments``, looks and folders are replaced.
    """
    common: dict[str, Any] = {
        name: getattr(arguments, name) for name in ("workers", "seed", "accelerator", "precision")
    }
    local = replace(
        local or train_local.Arguments(world=WORLD),
        epochs=arguments.local_epochs,
        datapoints=arguments.local_datapoints,
        **common,
    )
    place = replace(
        place or train_place.Arguments(world=WORLD),
        epochs=arguments.place_epochs,
        batches=arguments.place_batches,
        **common,
    )
    trainings: dict[str, Any] = {}
    for looks in TRAINING_LOOKS:
        changes: dict[str, Any] = {"looks": looks, "out": _weights(arguments, looks), "runs": arguments.folder}
        trainings[f"local-{looks}"] = _trained("train_local", train_local.main, LOCAL, replace(local, **changes))
        trainings[f"place-{looks}"] = _trained("train_place", train_place.main, PLACE, replace(place, **changes))
    result = {
        **runs.record("ablate_looks", arguments),
        "held_out_textures": HELD_OUT,
        "training_looks": {name: dataclasses.asdict(looks) for name, looks in TRAINING_LOOKS.items()},
        "measured_looks": {name: dataclasses.asdict(looks) for name, looks in MEASURED_LOOKS.items()},
        "tables": {
            looks: table_json(_measured(arguments, place, looks))
            for looks in tqdm(MEASURED_LOOKS, desc="looks", unit="look")
        },
        "trainings": {name: {key: found[key] for key in _KEPT} for name, found in trainings.items()},
    }
    result = json.loads(json.dumps(result))
    for path, text in (
        (arguments.out / f"{WORLD}_looks.json", json.dumps(result, indent=2) + "\n"),
        (arguments.docs / f"results_{WORLD}_looks.md", page(result)),
    ):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_at_once(path, text)
        print(f"wrote {path}")
    return dict(result)


def _weights(arguments: Arguments, looks: LooksName) -> Path:
    return arguments.folder / "weights" / looks


def _trained(
    script: str,
    main_of_script: Callable[[Any], object],
    kind: str,
    wanted: train_local.Arguments | train_place.Arguments,
) -> dict[str, Any]:
    """How a network was trained, now if that was not done before with these settings."""
    path = wanted.out / WORLD / f"{kind}.safetensors"

    def done() -> dict[str, Any]:
        training: dict[str, Any] = load_description(path, kind, WORLD)["training"]
        return training

    settings = json.loads(json.dumps(runs.record(script, wanted)["arguments"]))
    if not path.exists() or done()["arguments"] != settings:
        print(f"{script} --looks {wanted.looks} is to be done", flush=True)
        threads = torch.get_num_threads()
        main_of_script(wanted)
        torch.set_num_threads(threads)
    return done()


def _measured(arguments: Arguments, place: train_place.Arguments, looks: str) -> dict[str, Scores]:
    """All metrics of the networks of each training, in mazes that look like this; kept once they are measured."""
    folders = {name: _weights(arguments, name) / WORLD for name in TRAINING_LOOKS}
    local_networks = {name: load_local(folder, WORLD) for name, folder in folders.items()}
    place_networks = {name: load_place(folder, WORLD) for name, folder in folders.items()}
    made_with = {
        "networks": [description["sha256"] for _, description in (*local_networks.values(), *place_networks.values())],
        "looks": dataclasses.asdict(MEASURED_LOOKS[looks]),
        "settings": [arguments.mazes, arguments.frames, arguments.place_groups, place.pairs_a_maze],
    }
    made_with = json.loads(json.dumps(made_with))
    path = arguments.folder / "measured" / f"{looks}.json"
    if path.exists():
        kept = json.loads(path.read_text())
        if kept["made_with"] == made_with:
            return dict(kept["scores"])
    world = replace(world_named(WORLD), looks=MEASURED_LOOKS[looks])
    seeds = world.table_seeds(_TABLE, "validation")
    locals_ = {str(name): network for name, (network, _) in local_networks.items()}
    places = {str(name): network for name, (network, _) in place_networks.items()}
    of_local = local_scores(locals_, world, seeds[: arguments.mazes], arguments.frames)
    of_place = place_scores(places, world, seeds, arguments.place_groups, place)
    scores = {name: {**of_local[name], **of_place[name]} for name in locals_}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_at_once(path, json.dumps({"made_with": made_with, "scores": scores}) + "\n")
    return scores


if __name__ == "__main__":
    run_script(main, Arguments, __doc__)
