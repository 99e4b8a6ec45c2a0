"""Pictures of other sizes, and which networks a comparison takes as finished."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_sim.episodes import Episode
from training import compare_encoders
from training.compare_encoders import Arguments, page, training_arguments
from training.runs import RunError
from training.streams import images_of
from training.train_local import Arguments as TrainingArguments
from training.worlds import world_named

WORLD = world_named("maze3d")


def test_smaller_pictures_are_means_of_the_worlds_own() -> None:
    half = WORLD.with_pictures(30)
    assert half.image.shape == (30, 40, 3) and half.image.reduction == 2 and half.simulator == {}
    picture = np.arange(60 * 80 * 3, dtype=np.uint32).reshape(1, 60, 80, 3) % 251
    episode = Episode(picture.astype(np.uint8), np.zeros(0, np.uint8), np.zeros((1, 3)), 0.1, None)
    expected = np.floor(picture.reshape(1, 30, 2, 40, 2, 3).mean(axis=(2, 4)) + 0.5)
    np.testing.assert_array_equal(images_of(half, episode).numpy(), expected)
    assert images_of(WORLD, episode).shape == (1, 60, 80, 3)


def test_larger_pictures_are_simulated() -> None:
    double = WORLD.with_pictures(120)
    assert double.image.shape == (120, 160, 3) and double.image.reduction == 1
    env = double.make(4, 0)
    assert env.observation_space.shape == (120, 160, 3)
    env.close()
    assert WORLD.with_pictures(60) == WORLD
    with pytest.raises(ValueError, match="width x height is 120 x 90"):
        WORLD.with_pictures(90).make()
    with pytest.raises(ValueError, match="height of pictures is 45; expected a whole part of 60"):
        WORLD.with_pictures(45)
    with pytest.raises(ValueError, match="expected a whole part of 60 that leaves one of the width of 80"):
        WORLD.with_pictures(20)
    with pytest.raises(ValueError, match="asked of maze2d"):
        world_named("maze2d").with_pictures(30)


def test_corridors_of_another_width_are_simulated() -> None:
    env: Any = WORLD.with_corridors(4.0).make(5)
    assert (env.config.block_m, env.config.rows) == (4.0, 5)
    env.close()


def test_a_height_is_of_a_world() -> None:
    with pytest.raises(ValueError, match="calibration_mazes is 0"):
        TrainingArguments(world="maze3d", calibration_mazes=0)


def arguments(folder: Path, **changes: Any) -> Arguments:
    return Arguments(runs=folder / "runs", out=folder / "out", docs=folder / "docs", minutes=2.0, epochs=2, **changes)


def test_pairs_are_what_the_throughput_makes_of_the_minutes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compare_encoders, "pairs_a_second", lambda *_: 500.0)
    train = training_arguments(arguments(tmp_path), 30, 0.5, tmp_path)
    assert (train.datapoints, train.epochs, train.picture_height, train.width) == (30_000, 2, 30, 0.5)
    # Kept for a training that goes on, whatever the machine does meanwhile.
    monkeypatch.setattr(compare_encoders, "pairs_a_second", lambda *_: 100.0)
    assert training_arguments(arguments(tmp_path), 30, 0.5, tmp_path) == train
    with pytest.raises(RunError, match="given seed 1; expected seed 0"):
        training_arguments(arguments(tmp_path, seed=1), 30, 0.5, tmp_path)


def test_what_is_finished_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = arguments(tmp_path, heights=(60,), widths=(0.25,))
    error = {"mean": 1.0, "ci95": [0.5, 1.5]}
    network = {
        "height": 60, "image_width": 80, "width": 0.25, "parameters": 1234567, "pairs": 60000, "training_minutes": 2.0,
        "pairs_a_second": 500.0, "inference_ms": 1.5, "rmse_m": error, "rmse_deg": error, "final_percent": error,
    }  # fmt: skip
    folder = given.runs / "maze3d" / "encoders" / "60-0.25"
    folder.mkdir(parents=True)
    settings = compare_encoders._settings(given)
    (folder / "result.json").write_text(json.dumps({**network, "settings": settings}))
    result = compare_encoders.main(given)
    assert result["networks"] == [network]
    assert json.loads((tmp_path / "out" / "maze3d_encoders.json").read_text()) == result
    text = (tmp_path / "docs" / "encoders_maze3d.md").read_text()
    assert text == page(result)
    row = "| 80 x 60 | 0.25 | 1,234,567 | 60,000 | 2.00 | 500 | 1.00 [0.500, 1.50] |"
    assert row in text and str(tmp_path) not in text
    with pytest.raises(RunError, match="holds a network of other settings: given epochs 3; expected epochs 2"):
        compare_encoders.finished(Arguments(runs=given.runs, minutes=2.0, epochs=3), 60, 0.25)
