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
    throughput,
    train_deepvo,
    train_end_to_end,
    train_local,
    train_optimizer,
    train_place,
    train_smoother,
    tune_pose_graph,
)
from training.baselines.deepvo import DEEPVO
from training.common.records import write_at_once
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
    speed: throughput.Arguments = field(default_factory=lambda: throughput.Arguments(world="maze2d"))
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
        Step("a measurement of how fast data is made", sources.speed_file.exists, lambda: _speed(sources, scripts)),
    ):
        if not step.is_there():
            print(f"{sources.world.name}: {step.what} is missing and is made now", flush=True)
            step.make()
            torch.set_num_threads(threads)


def _networks(sources: Sources, scripts: Scripts) -> Iterator[Step]:
    common: dict[str, Any] = {"world": sources.world.name, "runs": sources.runs}
    local = replace(scripts.local, out=sources.weights, **common)
    place = replace(scripts.place, out=sources.weights, **common)
    yield Step("the local network", _exists(sources, LOCAL), lambda: train_local.main(local))
    yield Step("the place encoder", _exists(sources, PLACE), lambda: train_place.main(place))


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
            yield Step(f"the feature store {store}", _whole(sources, store), _call(featurise.main, arguments))


def _smoother(sources: Sources, scripts: Scripts) -> Iterator[Step]:
    if sources.world.smoothing:
        common: dict[str, Any] = {"world": sources.world.name, "runs": sources.runs}
        arguments = replace(scripts.smoother, weights=sources.weights, out=sources.weights, **common)
        yield Step("the odometry smoother", _exists(sources, SMOOTHER), lambda: train_smoother.main(arguments))


def _settings(sources: Sources, scripts: Scripts) -> Iterator[Step]:
    common: dict[str, Any] = {"world": sources.world.name, "runs": sources.runs}
    needed = {
        "loops": True,
        "registered": sources.world.registers_odometry,
        "smoothed": sources.world.smoothing,
    }
    for form in (form for form in tune_pose_graph.FORMS if needed[form]):
        changes = {**common, "form": form}
        arguments = replace(scripts.pose_graph, weights=sources.weights, out=sources.results, **changes)
        what = "tuning of the pose graph" + ("" if form == "loops" else f", {form}")
        yield Step(what, partial(is_tuned, sources, form), _call(tune_pose_graph.main, arguments))


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
            changes: dict[str, Any] = {"world": sources.world.name, "form": row.form}
            arguments = replace(
                scripts.optimizer,
                iterations=row.iterations,
                seed=seed,
                weights=sources.weights,
                out=folder,
                runs=sources.runs,
                **changes,
            )
            yield Step(f"{name} of seed {seed}", (folder / f"{OPTIMIZER}.safetensors").exists, _optimizer(arguments))


def _optimizer(arguments: train_optimizer.Arguments) -> Callable[[], None]:
    def make() -> None:
        train_optimizer.main(arguments)
        # The scripts write WORLD/NAME, for folders that hold several worlds; a row has a folder for each world.
        written = arguments.out / str(arguments.world)
        for path in sorted(written.iterdir()):  # the description first: what is complete has both
            path.replace(arguments.out / path.name)
        written.rmdir()

    return make


def _end_to_end(sources: Sources, wanted: Wanted, scripts: Scripts) -> Iterator[Step]:
    for row in (name for name in rows_of(sources.world) if ROWS[name].own_networks):
        own = sources.of_row(row, 0)
        stages = own.weights / "stages"
        changes: dict[str, Any] = {"world": sources.world.name, "seed": 0, "runs": sources.runs}
        arguments = replace(scripts.end_to_end, weights=stages, out=own.weights, **changes)

        def make(sources: Sources = sources, arguments: train_end_to_end.Arguments = arguments) -> None:
            folder = arguments.weights / str(arguments.world)
            folder.mkdir(parents=True, exist_ok=True)
            trained = sources.row_folder("ngo_5", 0)
            for kind, source in ((LOCAL, sources.networks), (PLACE, sources.networks), (OPTIMIZER, trained)):
                for suffix in (".json", ".safetensors"):
                    shutil.copy(source / f"{kind}{suffix}", folder)
            train_end_to_end.main(arguments)

        yield Step(row, _exists(own, OPTIMIZER), make)
        yield from _features(own, wanted, scripts, (wanted.split,))


def _own_odometry(sources: Sources, wanted: Wanted, scripts: Scripts) -> Iterator[Step]:
    for row in (name for name in rows_of(sources.world) if ROWS[name].odometry is not None):
        own, kind = sources.of_row(row, 0), str(ROWS[row].odometry)
        changes: dict[str, Any] = {"world": sources.world.name, "out": own.weights, "runs": sources.runs}
        if kind == DEEPVO:
            yield Step(row, _exists(own, kind), _call(train_deepvo.main, replace(scripts.deepvo, **changes)))
        else:
            arguments = replace(scripts.local, without_action=True, **changes)
            yield Step(row, _exists(own, kind), _call(train_local.main, arguments))
        for table in sources.world.tables:
            store = own.store_folder(wanted.split, table)
            make = partial(make_odometry, row, sources, wanted.split, table, wanted.trajectories)
            yield Step(f"the odometry of {row} in {store.name}", _is_whole(partial(open_odometry, store)), make)


def _speed(sources: Sources, scripts: Scripts) -> None:
    world: Any = sources.world.name
    speed = throughput.main(replace(scripts.speed, world=world))
    write_at_once(sources.speed_file, json.dumps(speed) + "\n")


def _call(main: Callable[[Any], object], arguments: Any) -> Callable[[], object]:
    return lambda: main(arguments)


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
