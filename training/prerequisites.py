"""Make what the tables of results need and what is missing: networks, features, settings and weights of rows.

Existing files are left alone, and every command continues after a stop, so this can run again at any time.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch

from ngo_estimator.checkpoint import LOCAL, OPTIMIZER, PLACE, SMOOTHER
from ngo_estimator.data.weights_file import load_description
from training import (
    featurise,
    train_deepvo,
    train_end_to_end,
    train_local,
    train_optimizer,
    train_place,
    train_smoother,
    tune_pose_graph,
)
from training.baselines.deepvo import DEEPVO
from training.data.data_source import TRAIN_STORE
from training.data.feature_store import open_store
from training.scoring.network_odometry import make_odometry, open_odometry
from training.scoring.table_rows import ROWS, Sources, rows_of


@dataclass(frozen=True)
class Scripts:
    """How each script is run; world, form, iterations, seed and folders are set for what is made."""

    local: train_local.Arguments = field(default_factory=lambda: train_local.Arguments(world="maze2d"))
    place: train_place.Arguments = field(default_factory=lambda: train_place.Arguments(world="maze2d"))
    features: featurise.Arguments = field(default_factory=lambda: featurise.Arguments(world="maze2d"))
    optimizer: train_optimizer.Arguments = field(default_factory=lambda: train_optimizer.Arguments(world="maze2d"))
    smoother: train_smoother.Arguments = field(default_factory=lambda: train_smoother.Arguments(world="maze3d"))
    pose_graph: tune_pose_graph.Arguments = field(default_factory=lambda: tune_pose_graph.Arguments(world="maze2d"))
    deepvo: train_deepvo.Arguments = field(default_factory=lambda: train_deepvo.Arguments(world="maze3d"))
    end_to_end: train_end_to_end.Arguments = field(default_factory=lambda: train_end_to_end.Arguments(world="maze2d"))


@dataclass(frozen=True)
class Wanted:
    """Which trajectories the tables are about, and how many trainings of each optimizer."""

    split: str
    trajectories: int
    seeds: int


class Step(NamedTuple):
    """Something that is needed: what it is, whether it is there, and how to make it."""

    what: str
    is_there: Callable[[], bool]
    make: Callable[[], object]


def prepare(sources: Sources, wanted: Wanted, scripts: Scripts) -> None:
    """Make what is missing, in order; raises what the script raises that fails."""
    threads = torch.get_num_threads()
    for step in (
        *_networks(sources, scripts),
        *_features(sources, wanted, scripts, (TRAIN_STORE, _VALIDATION, wanted.split)),
        *_smoother(sources, scripts),
        *_settings(sources, scripts),
        *_optimizers(sources, wanted, scripts),
        *_end_to_end(sources, wanted, scripts),
        *_own_odometry(sources, wanted, scripts),
    ):
        if not step.is_there():
            print(f"{sources.world.name}: {step.what} is missing and is made now", flush=True)
            step.make()
            torch.set_num_threads(threads)


def _for(sources: Sources, arguments: Any, **changes: Any) -> Any:
    """The arguments of a script for what is made."""
    return replace(arguments, world=sources.world.name, runs=sources.runs, **changes)


def _networks(sources: Sources, scripts: Scripts) -> Iterator[Step]:
    for what, kind, script, arguments in (
        ("the local network", LOCAL, train_local, scripts.local),
        ("the place encoder", PLACE, train_place, scripts.place),
    ):
        make = partial(script.main, _for(sources, arguments, out=sources.weights))
        yield Step(what, _exists(sources, kind), make)


_VALIDATION = "validation"
_COUNTS = {TRAIN_STORE: "trajectories", _VALIDATION: "validation_trajectories", "test": "test_trajectories"}


def _features(sources: Sources, wanted: Wanted, scripts: Scripts, splits: tuple[str, ...]) -> Iterator[Step]:
    for split in dict.fromkeys(splits):
        count = getattr(scripts.features, _COUNTS[split])
        if split == wanted.split:
            count = max(count, wanted.trajectories)
        if split == TRAIN_STORE and _whole(sources, TRAIN_STORE)():  # what else is made goes with what is there
            count = len(open_store(_store_folder(sources, TRAIN_STORE))["relative"])
        changes: dict[str, Any] = {name: count if name == _COUNTS[split] else 0 for name in _COUNTS.values()}
        changes["world"] = sources.world.name
        arguments = replace(scripts.features, weights=sources.weights, out=sources.runs, **changes)
        tables = [f"{split}_{table}" for table in sources.world.tables]
        for store in sources.world.optimizer_stores if split == TRAIN_STORE else tables:
            yield Step(f"the feature store {store}", _whole(sources, store), partial(featurise.main, arguments))


def _smoother(sources: Sources, scripts: Scripts) -> Iterator[Step]:
    if sources.world.smoothing:
        arguments = _for(sources, scripts.smoother, weights=sources.weights, out=sources.weights)
        yield Step("the odometry smoother", _exists(sources, SMOOTHER), partial(train_smoother.main, arguments))


def _settings(sources: Sources, scripts: Scripts) -> Iterator[Step]:
    needed = {"loops": True, "registered": sources.world.registers_odometry, "smoothed": sources.world.smoothing}
    for form in (form for form in tune_pose_graph.FORMS if needed[form]):
        arguments = _for(sources, scripts.pose_graph, form=form, weights=sources.weights, out=sources.results)
        what = "tuning of the pose graph" + ("" if form == "loops" else f", {form}")
        yield Step(what, partial(is_tuned, sources, form), partial(tune_pose_graph.main, arguments))


def is_tuned(sources: Sources, form: str) -> bool:
    """Whether there are settings, and for the networks that are there, where they say for which."""
    path = sources.settings_file(form)
    if not path.exists():
        return False
    settings = json.loads(path.read_text())
    return all(
        settings[f"{kind}_sha256"] == load_description(sources.networks / f"{kind}.safetensors", kind)["sha256"]
        for kind in (PLACE, SMOOTHER)
        if f"{kind}_sha256" in settings
    )


def _optimizers(sources: Sources, wanted: Wanted, scripts: Scripts) -> Iterator[Step]:
    for name in rows_of(sources.world):
        row = ROWS[name]
        for seed in range(wanted.seeds if row.form is not None else 0):
            folder = sources.row_folder(name, seed)
            of_row = {"form": row.form, "iterations": row.iterations, "seed": seed}
            arguments = _for(sources, scripts.optimizer, **of_row, weights=sources.weights, out=folder)
            make = partial(_make_optimizer, arguments)
            yield Step(f"{name} of seed {seed}", (folder / f"{OPTIMIZER}.safetensors").exists, make)


def _make_optimizer(arguments: train_optimizer.Arguments) -> None:
    train_optimizer.main(arguments)
    # The scripts write WORLD/NAME, for folders that hold several worlds; a row has a folder for each world.
    written = arguments.out / str(arguments.world)
    for path in sorted(written.iterdir()):  # the description first: what is complete has both
        path.replace(arguments.out / path.name)
    written.rmdir()


def _end_to_end(sources: Sources, wanted: Wanted, scripts: Scripts) -> Iterator[Step]:
    for row in (name for name in rows_of(sources.world) if ROWS[name].own_networks):
        own = sources.of_row(row, 0)
        arguments = _for(sources, scripts.end_to_end, seed=0, weights=own.weights / "stages", out=own.weights)
        yield Step(row, _exists(own, OPTIMIZER), partial(_make_end_to_end, sources, arguments))
        yield from _features(own, wanted, scripts, (wanted.split,))


def _make_end_to_end(sources: Sources, arguments: train_end_to_end.Arguments) -> None:
    folder, trained = arguments.weights / str(arguments.world), sources.row_folder("ngo_5", 0)
    folder.mkdir(parents=True, exist_ok=True)
    for kind, source in ((LOCAL, sources.networks), (PLACE, sources.networks), (OPTIMIZER, trained)):
        for suffix in (".json", ".safetensors"):
            shutil.copy(source / f"{kind}{suffix}", folder)
    train_end_to_end.main(arguments)


def _own_odometry(sources: Sources, wanted: Wanted, scripts: Scripts) -> Iterator[Step]:
    for row in (name for name in rows_of(sources.world) if ROWS[name].odometry is not None):
        own, kind = sources.of_row(row, 0), str(ROWS[row].odometry)
        if kind == DEEPVO:
            train = partial(train_deepvo.main, _for(sources, scripts.deepvo, out=own.weights))
        else:
            train = partial(train_local.main, _for(sources, scripts.local, without_action=True, out=own.weights))
        yield Step(row, _exists(own, kind), train)
        for table in sources.world.tables:
            store = own.store_folder(wanted.split, table)
            make = partial(make_odometry, row, sources, wanted.split, table, wanted.trajectories)
            yield Step(f"the odometry of {row} in {store.name}", _is_whole(partial(open_odometry, store)), make)


def _exists(sources: Sources, kind: str) -> Callable[[], bool]:
    return (sources.networks / f"{kind}.safetensors").exists


def _whole(sources: Sources, store: str) -> Callable[[], bool]:
    return _is_whole(partial(open_store, _store_folder(sources, store)))


def _store_folder(sources: Sources, store: str) -> Path:
    return sources.runs / sources.world.name / "features" / store


def _is_whole(opened: Callable[[], object]) -> Callable[[], bool]:
    def is_whole() -> bool:
        try:
            opened()
        except ValueError:
            return False
        return True

    return is_whole
