"""The compass's training from end to end at toy size, and one that was stopped."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_estimator.networks.compass import COMPASS, load_compass
from training import train_compass
from training.data import streams


class Killed(RuntimeError):
    """Stands for the signal that ends a training."""


@pytest.fixture(autouse=True)
def shrink(monkeypatch: pytest.MonkeyPatch) -> None:
    simulate = streams.simulate
    monkeypatch.setattr(train_compass, "simulate", lambda world, seeds, _: simulate(world, seeds, 50))
    monkeypatch.setattr(streams, "_GROUP", 2)
    monkeypatch.setattr(train_compass.CompassStream, "FRAMES", 97)


def arguments(folder: Path, epochs: int) -> train_compass.Arguments:
    return train_compass.Arguments(
        world="maze2d",
        width=4,
        epochs=epochs,
        datapoints=1,
        batch_size=32,
        validation_mazes=2,
        workers=0,
        runs=folder,
    )


def test_a_stopped_training_ends_with_the_weights_of_an_unbroken_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(self: Any, batch: Any, index: int) -> None:
        if self.current_epoch == 1 and index == 1:
            raise Killed

    unbroken, stopped = tmp_path / "unbroken", tmp_path / "stopped"
    metrics = train_compass.main(arguments(unbroken, 3))
    with monkeypatch.context() as patch:
        patch.setattr(train_compass.CompassTraining, "on_train_batch_start", stop)
        with pytest.raises(Killed):
            train_compass.main(arguments(stopped, 3))
    weights = Path("maze2d", "compass", f"{COMPASS}.safetensors")
    assert not (stopped / weights).exists()
    assert train_compass.main(arguments(stopped, 3)) == metrics
    assert (stopped / weights).read_bytes() == (unbroken / weights).read_bytes()

    assert np.isfinite(list(metrics.values())).all()
    _, description = load_compass((unbroken / weights).parent, "maze2d")
    assert description["metrics"]["validation"] == metrics
    assert description["training"]["command"].startswith("python -m training.train_compass --world maze2d --width 4")
    assert str(tmp_path) not in json.dumps(description)
