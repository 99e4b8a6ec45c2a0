"""Every training script from end to end at toy size, and stopped trainings that go on as if they had not been."""

import csv
import dataclasses
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import (
    LOCAL,
    OPTIMIZER,
    PLACE,
    SMOOTHER,
    load_local,
    load_optimizer,
    load_place,
    load_smoother,
)
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.smoke import toy
from training import (
    evaluate,
    featurise,
    train_deepvo,
    train_end_to_end,
    train_local,
    train_optimizer,
    train_place,
    train_smoother,
)
from training.baselines.deepvo import DEEPVO
from training.common import records
from training.data import worlds

ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1"}


class Killed(RuntimeError):
    """Stands for the signal that ends a training."""


@pytest.mark.parametrize(
    ("world", "frames", "place_frames"),
    [("maze2d", 161, 400), pytest.param("maze3d", 161, 700, marks=pytest.mark.slow)],
)
def test_the_scripts_make_a_set_of_weights_that_the_estimator_takes(
    world: str,
    frames: int,
    place_frames: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    toy.shrink(monkeypatch, 161, place_frames)
    windows: list[tuple[int, ...]] = []
    losses = train_local.step_losses

    def noted(*values: Any) -> Any:
        windows.append(values[4] if len(values) > 4 else (1,))
        return losses(*values)

    monkeypatch.setattr(train_local, "step_losses", noted)
    local_metrics = train_local.main(toy.local(world, tmp_path))
    place_metrics = train_place.main(toy.place(world, tmp_path))
    featurise.main(toy.features(world, tmp_path))
    smoothed = worlds.world_named(world).smoothing
    if smoothed:
        with pytest.raises(CheckpointError, match="odometry_smoother"):
            train_optimizer.main(toy.optimizer(world, tmp_path))
        assert train_smoother.main(toy.smoother(world, tmp_path)).keys() == {
            f"{name}_{unit}" for name in ("odometry", "smoothed") for unit in ("m", "deg")
        }
    optimizer_metrics = train_optimizer.main(toy.optimizer(world, tmp_path))
    capsys.readouterr()
    table = evaluate.main(toy.evaluation(world, tmp_path))
    printed = capsys.readouterr().out

    for metrics in (local_metrics, place_metrics, optimizer_metrics):
        assert metrics and np.isfinite(list(metrics.values())).all()
    assert json.loads(printed.splitlines()[-1]) == table
    assert table["trajectories"] == 2 and table["frames"] == 60
    weights = tmp_path / "weights" / world
    assert sorted(path.name for path in weights.iterdir()) == sorted(
        kind + suffix
        for kind in (LOCAL, PLACE, OPTIMIZER, *((SMOOTHER,) if smoothed else ()))
        for suffix in (".json", ".safetensors")
    )
    assert LocalOdometry.load(weights, world).world == world
    OnlineTrajectory.load(weights, world=world)
    for load, script in ((load_local, "train_local"), (load_place, "train_place"), (load_optimizer, "train_optimizer")):
        _, description = load(weights, world)
        command = description["training"]["command"]
        assert command.startswith(f"python -m training.{script} ") and f" --world {world} " in command
        assert description["training"]["arguments"]["seed"] == 0
        assert min(description["training"][name] for name in ("seconds", "datapoints_per_s", "peak_memory_mb")) > 0
        assert description["metrics"]["validation"]
        assert str(tmp_path) not in json.dumps(description)
    optimizer, description = load_optimizer(weights, world)
    assert (optimizer.config.smoother is not None) == smoothed
    if smoothed:  # with a copy, which is left as it is
        smoother, of_smoother = load_smoother(weights, world)
        assert description["odometry_smoother_sha256"] == of_smoother["sha256"]
        assert of_smoother["local_pose_network_sha256"] == load_local(weights, world)[1]["sha256"]
        copied, stored = optimizer.smoother.state_dict(), smoother.state_dict()
        assert all(torch.equal(copied[name], value) for name, value in stored.items())
    # A calibrated network has no constant error on what it was calibrated with: the normalisation was changed for it.
    config = load_local(weights, world)[0].config
    assert config.relative_bias[2] != 0.0
    assert config.action_history == {"maze2d": 1, "maze3d": 12}[world]
    # Steps alone of what is seen and in validation; the world's windows where earlier actions correct it.
    assert set(windows) == {"maze2d": {(1,)}, "maze3d": {(1,), (1, 4, 16)}}[world]


def prepare(folder: Path) -> None:
    """The weights and features that the later stages start from, untrained; no optimizer yet."""
    from ngo_estimator.checkpoint import write_untrained

    write_untrained(folder / "weights" / "maze2d", "maze2d")
    featurise.main(toy.features("maze2d", folder))


TRAININGS: dict[str, tuple[Callable[[Any], Any], Callable[..., Any], type[lightning.LightningModule], str]] = {
    "place": (train_place.main, toy.place, train_place.PlaceTraining, PLACE),
    "optimizer": (train_optimizer.main, toy.optimizer, train_optimizer.OptimizerTraining, OPTIMIZER),
    "deepvo": (train_deepvo.main, toy.deepvo, train_deepvo.DeepVOTraining, DEEPVO),
}


@pytest.mark.parametrize("name", TRAININGS)
def test_a_stopped_training_ends_with_the_weights_of_an_unbroken_one(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.shrink(monkeypatch, 97, 300)
    main, arguments, module, kind = TRAININGS[name]
    unbroken, stopped = tmp_path / "unbroken", tmp_path / "stopped"
    if name == "optimizer":
        prepare(unbroken)
        (unbroken / "weights" / "maze2d" / f"{OPTIMIZER}.safetensors").unlink()
        shutil.copytree(unbroken, stopped)

    def weights(folder: Path) -> bytes | None:
        path = folder / "weights" / "maze2d" / f"{kind}.safetensors"
        return path.read_bytes() if path.exists() else None

    def stop(self: Any, batch: Any, index: int) -> None:
        if self.current_epoch == 1 and index == 1:
            raise Killed

    metrics = main(arguments("maze2d", unbroken, epochs=3))
    assert weights(unbroken)
    with monkeypatch.context() as patch:
        patch.setattr(module, "on_train_batch_start", stop)
        with pytest.raises(Killed):
            main(arguments("maze2d", stopped, epochs=3))
    assert not weights(stopped)
    assert [row["epoch"] for row in curve(stopped)] == ["0"] and story(stopped)["state"] == "running"
    for _ in range(2):  # to the end; and once more, when all is done: nothing changes
        assert main(arguments("maze2d", stopped, epochs=3)) == metrics
        assert weights(stopped) == weights(unbroken)
        assert curve(stopped) == curve(unbroken)
    assert [row["epoch"] for row in curve(stopped)] == ["0", "1", "2"]
    assert story(stopped)["state"] == "complete" and len(story(stopped)["resumed"]) == 2
    assert story(stopped)["metrics"] == metrics


def curve(folder: Path) -> list[dict[str, str]]:
    """The learning curve of the one run in a folder, without its times."""
    (path,) = (folder / "runs" / "maze2d").glob("*/metrics.csv")
    with path.open() as file:
        return [{name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)]


def story(folder: Path) -> dict[str, Any]:
    """What the one run in a folder says of itself."""
    (path,) = (folder / "runs" / "maze2d").glob("*/run.json")
    described: dict[str, Any] = json.loads(path.read_text())
    return described


def test_all_networks_train_together_and_make_a_set_of_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy.shrink(monkeypatch, 97, 300)
    prepare(tmp_path)
    staged = tmp_path / "weights" / "maze2d"
    metrics = train_end_to_end.main(toy.end_to_end("maze2d", tmp_path))
    assert np.isfinite(list(metrics.values())).all()

    trained = tmp_path / "end_to_end" / "maze2d"
    assert LocalOdometry.load(trained, "maze2d").world == "maze2d"
    OnlineTrajectory.load(trained, world="maze2d")
    for load in (load_local, load_place, load_optimizer):
        (before, start), (after, description) = load(staged), load(trained)
        assert description["config"] == start["config"]
        assert description["stages_sha256"][description["network"]] == start["sha256"]
        assert description["metrics"]["validation"] == metrics
        assert description["metrics"]["validation_of_stages"].keys() == metrics.keys()
        assert str(tmp_path) not in json.dumps(description)
        moved = {
            name for name, value in after.state_dict().items() if not torch.equal(value, before.state_dict()[name])
        }
        assert {name.split(".")[0] for name in moved} >= {name.split(".")[0] for name, _ in after.named_parameters()}
    with pytest.raises(ValueError, match="expected another one"):
        train_end_to_end.main(dataclasses.replace(toy.end_to_end("maze2d", tmp_path), out=tmp_path / "weights"))
    with pytest.raises(ValueError, match="steps is 100; expected a multiple of 8"):
        train_end_to_end.main(dataclasses.replace(toy.end_to_end("maze2d", tmp_path), steps=100))


def ranks(folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What the two processes wrote."""
    first, second = (json.loads((folder / f"rank{rank}.json").read_text()) for rank in range(2))
    return first, second


@pytest.fixture(scope="module")
def two_processes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A training of two epochs by two processes of one machine."""
    folder = tmp_path_factory.mktemp("two_processes")
    command = [sys.executable, "-m", "tests.smoke.two_processes", str(folder)]
    done = subprocess.run(command, cwd=records.ROOT, env=ONE_THREAD, capture_output=True, text=True, timeout=150)
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


@pytest.mark.long
def test_two_processes_train_on_mazes_of_their_own_to_the_same_weights(two_processes: Path) -> None:
    first, second = ranks(two_processes)
    assert len(first["mazes"]) == len(second["mazes"]) == len({*first["mazes"], *second["mazes"]}) / 2 > 0
    assert first["weights"] == second["weights"] != first["weights_at_first"]
    # Of all validation data, in both.
    assert first["logged_rmse_m"] == second["logged_rmse_m"] == pytest.approx(first["rmse_m"], rel=1e-5)
    # Written once, by one of them.
    assert [row["epoch"] for row in curve(two_processes)] == ["0", "1"]
    weights = two_processes / "weights" / "maze2d" / f"{LOCAL}.safetensors"
    assert hashlib.sha256(weights.read_bytes()).hexdigest() == first["weights"]
    training = load_local(weights.parent)[1]["training"]
    assert training["processes"] == 2
    assert training["command"].startswith("python -m training.train_local --accelerator cpu --devices 2 --strategy ddp")
