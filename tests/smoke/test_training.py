"""Every training script from end to end at toy size, and stopped trainings that go on as if they had not been."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
import numpy as np
import pytest

from ngo_estimator.checkpoint import LOCAL, OPTIMIZER, PLACE, load_local, load_optimizer, load_place
from ngo_estimator.local_odometry import LocalOdometry
from ngo_estimator.online_trajectory import OnlineTrajectory
from tests.smoke import toy
from training import evaluate, featurise, train_local, train_optimizer, train_place


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
    local_metrics = train_local.main(toy.local(world, tmp_path))
    place_metrics = train_place.main(toy.place(world, tmp_path))
    featurise.main(toy.features(world, tmp_path))
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
        kind + suffix for kind in (LOCAL, PLACE, OPTIMIZER) for suffix in (".json", ".safetensors")
    )
    assert LocalOdometry.load(weights, world).world == world
    OnlineTrajectory.load(weights, world=world)
    for load, script in ((load_local, "train_local"), (load_place, "train_place"), (load_optimizer, "train_optimizer")):
        _, description = load(weights, world)
        assert description["training"]["command"].startswith(f"python -m training.{script} --world {world} ")
        assert description["training"]["arguments"]["seed"] == 0
        assert description["metrics"]["validation"]
        assert str(tmp_path) not in json.dumps(description)
    # A calibrated network has no constant error on what it was calibrated with: the normalisation was changed for it.
    config = load_local(weights, world)[0].config
    assert config.relative_mean[2] != 0.0


def test_the_papers_form_trains_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy.shrink(monkeypatch, 161, 400)
    prepare(tmp_path)
    metrics = train_optimizer.main(toy.optimizer("maze2d", tmp_path, form="paper"))
    assert np.isfinite(list(metrics.values())).all()
    assert not load_optimizer(tmp_path / "weights" / "maze2d")[0].config.loops


def prepare(folder: Path) -> None:
    """The weights and features that the optimizer's training starts from, untrained."""
    from ngo_estimator.checkpoint import write_untrained

    write_untrained(folder / "weights" / "maze2d", "maze2d")
    featurise.main(toy.features("maze2d", folder))


TRAININGS: dict[str, tuple[Callable[[Any], Any], Callable[..., Any], type[lightning.LightningModule], str]] = {
    "local": (train_local.main, toy.local, train_local.LocalTraining, LOCAL),
    "place": (train_place.main, toy.place, train_place.PlaceTraining, PLACE),
    "optimizer": (train_optimizer.main, toy.optimizer, train_optimizer.OptimizerTraining, OPTIMIZER),
}


@pytest.mark.parametrize("name", TRAININGS)
def test_a_stopped_training_ends_with_the_weights_of_an_unbroken_one(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy.shrink(monkeypatch, 97, 300)
    main, arguments, module, kind = TRAININGS[name]
    results = []
    for folder in (tmp_path / "unbroken", tmp_path / "stopped"):
        if name == "optimizer":
            prepare(folder)
            if results:  # the same features and the same other networks
                import shutil

                shutil.rmtree(folder)
                shutil.copytree(tmp_path / "unbroken", folder)
                (folder / "weights" / "maze2d" / f"{OPTIMIZER}.safetensors").unlink()
                for run in (folder / "runs" / "maze2d").glob("optimizer-*"):
                    shutil.rmtree(run)
        if results:

            def stop(self: Any, batch: Any, index: int) -> None:
                if self.current_epoch == 1 and index == 1:
                    raise Killed

            with monkeypatch.context() as patch:
                patch.setattr(module, "on_train_batch_start", stop)
                with pytest.raises(Killed):
                    main(arguments("maze2d", folder, epochs=3))
            assert not (folder / "weights" / "maze2d" / f"{kind}.safetensors").exists()
        metrics = main(arguments("maze2d", folder, epochs=3))
        results.append(((folder / "weights" / "maze2d" / f"{kind}.safetensors").read_bytes(), metrics))
    assert results[0][0] == results[1][0]
    assert results[0][1] == results[1][1]
    # Once more, when all is done: nothing changes.
    metrics = main(arguments("maze2d", folder, epochs=3))
    assert metrics == results[0][1]
    assert (folder / "weights" / "maze2d" / f"{kind}.safetensors").read_bytes() == results[0][0]
