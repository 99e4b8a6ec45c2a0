"""The training scripts at toy size: short episodes, few mazes, thin networks."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from matplotlib.figure import Figure

from training import (
    evaluate,
    featurise,
    prerequisites,
    results,
    train_deepvo,
    train_end_to_end,
    train_local,
    train_optimizer,
    train_place,
    train_smoother,
    tune_pose_graph,
)
from training.common.precision import Precision
from training.data import episodes, streams, worlds
from training.scoring.table_rows import Sources

PRECISION: Precision = "32-true"  # With "auto" each training would first measure which one is faster.


def shrink(monkeypatch: pytest.MonkeyPatch, frames: int, place_frames: int) -> None:
    """Episodes of ``frames`` frames (``place_frames`` where places must be seen again), two mazes at a time."""
    simulate = episodes.simulate
    for script in (train_local, train_deepvo):
        monkeypatch.setattr(script, "simulate", lambda world, seeds, _: simulate(world, seeds[:2], frames))
    monkeypatch.setattr(episodes, "GROUP", 2)
    monkeypatch.setattr(streams.PairStream, "FRAMES", frames)
    monkeypatch.setattr(streams.PlaceStream, "FRAMES", place_frames)
    for name, world in worlds.WORLDS.items():
        monkeypatch.setitem(worlds.WORLDS, name, dataclasses.replace(world, episode_frames=frames - 1, rows=(4, 4)))


def draw_coarsely(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let figures be files of few pixels."""
    save = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, path, **given: save(figure, path, **{**given, "dpi": 40}))


def refuse(monkeypatch: pytest.MonkeyPatch, modules: Sequence[ModuleType], *others: str) -> None:
    """Let the scripts in ``modules``, and functions by their names, fail where they are called."""

    def fail(*_: Any, **__: Any) -> None:
        raise AssertionError("this is there already")

    for module in modules:
        monkeypatch.setattr(module, "main", fail)
    for name in others:
        monkeypatch.setattr(name, fail)


def _of_networks(world: Any, folder: Path, epochs: int) -> dict[str, Any]:
    """What trainings of networks on mazes have in common."""
    folders = {"out": folder / "weights", "runs": folder / "runs"}
    return {"world": world, "width": 0.03, "epochs": epochs, "workers": 0, "precision": PRECISION, **folders}


def local(world: str, folder: Path, epochs: int = 1, **changes: Any) -> train_local.Arguments:
    common = {**_of_networks(world, folder, epochs), **changes}
    return train_local.Arguments(datapoints=1, batch_size=32, validation_mazes=1, **common)


def deepvo(world: Any, folder: Path, epochs: int = 1) -> train_deepvo.Arguments:
    common = _of_networks(world, folder, epochs)
    few = {"validation_mazes": 1, "calibration_mazes": 2}
    return train_deepvo.Arguments(datapoints=1, steps=16, batch_size=4, **few, **common)


def place(world: str, folder: Path, epochs: int = 1) -> train_place.Arguments:
    common = _of_networks(world, folder, epochs)
    return train_place.Arguments(batches=1, pairs_a_maze=4, validation_batches=1, **common)


def features(world: str, folder: Path) -> featurise.Arguments:
    return featurise.Arguments(
        world=world, trajectories=4, validation_trajectories=2, weights=folder / "weights", out=folder / "runs"
    )


def _of_features(folder: Path) -> dict[str, Any]:
    """What trainings on features have in common."""
    return {
        "steps": 3,
        "batch_size": 2,
        "weights": folder / "weights",
        "out": folder / "weights",
        "runs": folder / "runs",
        "precision": PRECISION,
    }


def smoother(world: Any, folder: Path, epochs: int = 1) -> train_smoother.Arguments:
    return train_smoother.Arguments(world=world, epochs=epochs, **_of_features(folder))


def optimizer(world: str, folder: Path, epochs: int = 1, form: str = "loops") -> train_optimizer.Arguments:
    return train_optimizer.Arguments(
        world=world,
        form=form,  # type: ignore[arg-type]
        iterations=2,
        width=16,
        max_loops=8,
        epochs=epochs,
        **_of_features(folder),
    )


def end_to_end(world: str, folder: Path, epochs: int = 1) -> train_end_to_end.Arguments:
    return train_end_to_end.Arguments(
        world=world,
        steps=128,
        epochs=epochs,
        batches=4,
        batch_size=1,
        validation_trajectories=2,
        workers=0,
        weights=folder / "weights",
        out=folder / "end_to_end",
        runs=folder / "runs",
        precision=PRECISION,
    )


def evaluation(world: str, folder: Path) -> evaluate.Arguments:
    return evaluate.Arguments(world=world, trajectories=2, frames=60, weights=folder / "weights")


def scripts(world: Any, folder: Path) -> prerequisites.Scripts:
    """Every script that results need."""
    return prerequisites.Scripts(
        local=local(world, folder),
        place=place(world, folder),
        features=features(world, folder),
        smoother=smoother(world, folder),
        optimizer=optimizer(world, folder),
        pose_graph=tune_pose_graph.Arguments(world=world, trajectories=2, passes=1),
        deepvo=deepvo("maze3d", folder),
        end_to_end=end_to_end(world, folder),
    )


def results_of(world: Any, folder: Path, **changes: Any) -> results.Arguments:
    return results.Arguments(
        world=world,
        split="validation",
        weights=folder / "weights",
        runs=folder / "runs",
        out=folder / "results",
        docs=folder / "docs",
        **changes,
    )


def sources(world: str, folder: Path) -> Sources:
    """Where ``results_of`` finds and keeps things."""
    return Sources(worlds.world_named(world), folder / "weights", folder / "runs", folder / "results")
