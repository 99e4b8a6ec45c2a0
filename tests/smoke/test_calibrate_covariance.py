"""After the calibration of the covariance, errors are on average what it says."""

import json
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.checkpoint import OPTIMIZER, load_local, load_optimizer, load_place, write_untrained
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training import calibrate_covariance
from training.calibrate_covariance import Arguments, normalized_errors
from training.data.episodes import simulate
from training.data.features import features_of
from training.data.worlds import VALIDATION_SEEDS, world_named

FRAMES = 240


def test_the_factor_makes_squared_errors_those_of_the_covariance(tmp_path: Path) -> None:
    folder = tmp_path / "maze2d"
    write_untrained(folder, "maze2d")
    before = json.loads((folder / f"{OPTIMIZER}.json").read_text())
    scale = calibrate_covariance.main(Arguments("maze2d", 1, FRAMES, tmp_path))
    after = json.loads((folder / f"{OPTIMIZER}.json").read_text())
    assert after["config"].pop("covariance_scale") == scale
    assert before["config"].pop("covariance_scale") == 1.0
    assert after == before
    world = world_named("maze2d")
    networks = load_local(folder, world.name)[0], load_place(folder, world.name)[0]
    core = OnlineTrajectory(load_optimizer(folder, world.name)[0], networks[1].pair_head)
    (episode,) = simulate(world, [VALIDATION_SEEDS[-1]], FRAMES)
    errors = normalized_errors(core, features_of(world, episode, folder, networks))
    assert len(errors) == (FRAMES - 1) // 8
    assert np.mean(errors) == pytest.approx(1.0, rel=0.05)
    # Done again it gives the same: it starts from the covariance as it was.
    assert calibrate_covariance.main(Arguments("maze2d", 1, FRAMES, tmp_path)) == pytest.approx(scale)
