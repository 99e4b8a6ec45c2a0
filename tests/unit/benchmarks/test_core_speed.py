"""What is measured of the core is what it does, and the peers get what the optimizer got."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.core_speed import Watched, core_speed
from benchmarks.drives import drive_of
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.common.records import WEIGHTS

WINDOW, LIVE = 400, 20


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def test_watching_changes_nothing_and_sees_every_optimisation(cache: Path) -> None:
    watched, alone = Watched("maze2d", WINDOW), OnlineTrajectory.load(WEIGHTS / "maze2d", WINDOW, "maze2d", 128, 1)
    for step in drive_of("maze2d", 2000, WINDOW + LIVE, cache).steps():
        update, expected = watched.core.update(step), alone.update(step)
        assert np.array_equal(update.pose_xyyaw, expected.pose_xyyaw)
        if update.frames == WINDOW + watched.block - 1:
            problem, trajectory = watched.problem(), alone.trajectory()
    assert len(watched.optimisations.wall_ms) == (WINDOW + LIVE) // watched.block
    assert min(watched.optimisations.cpu_ms) > 0.0
    assert trajectory is not None
    assert len(problem.relative) == WINDOW // watched.block
    assert (problem.nodes[:, 1] * watched.block).tolist() == trajectory.loops[:, 1].tolist()


def test_everything_is_measured(cache: Path) -> None:
    result = core_speed("maze2d", 2000, WINDOW, LIVE, 3, cache)
    assert len(result["core_ms"]) == LIVE
    for name in ("optimize", "update", "gtsam_lm", "gtsam_lm_believed", "isam2", "isam2_default"):
        assert result[name]["ms"] > 0.0, name
    assert result["update"]["cpu_ms"] > result["optimize"]["cpu_ms"]
    errors = result["rmse_m"]
    assert max(errors["gtsam_lm"], errors["isam2"], errors["ours"]) < 2.0 * errors["odometry"]
