"""From recordings of both simulators alone to an estimator that beats the untrained one on what was held out."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ngo_estimator.checkpoint import load_local
from ngo_estimator.data.weights_file import load_description
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.ros.processes import NodeProcess
from training.common import records
from training.recordings.recording_source import NO_LOOPS

pytestmark = [pytest.mark.processes, pytest.mark.timeout(400)]

SMALL_MAZE = {"seed": 1007, "frames": 2000, "rows": 3, "cols": 3}
LIDAR = {"image": "/scan", "action": "none"}


def record(world: str, path: Path, **parameters: Any) -> None:
    with NodeProcess("ngo_sim", world, {"rate": 0, "record": str(path), **parameters}) as node:
        assert node.wait() == 0, node.log


@pytest.mark.parametrize(
    ("world", "drives", "settings", "shape"),
    [
        # One drive as a lidar sees it, whose end is held out, without actions.
        pytest.param(
            "maze2d",
            [SMALL_MAZE],
            {"rate": 6e-3, "epochs": 3, "topics": LIDAR},
            (1, 241, 1),
            marks=pytest.mark.long,
        ),
        # Several with actions, of which the last is held out.
        (
            "maze3d",
            [{"seed": seed, "frames": 700} for seed in (1001, 1002)],
            {"rate": 4e-3, "epochs": 3},
            (60, 80, 3),
        ),
    ],
    ids=["scan", "maze3d"],
)
def test_a_minute_of_training_from_files_alone_beats_the_untrained_estimator(
    world: str, drives: list[dict[str, int]], settings: dict[str, Any], shape: tuple[int, ...], tmp_path: Path
) -> None:
    files = [tmp_path / f"drive_{drive['seed']}.mcap" for drive in drives]
    for path, drive in zip(files, drives, strict=True):
        record(world, path, **drive)
    given = {"folder": str(tmp_path), "data": [str(path) for path in files], "width": 0.06, **settings}
    done = subprocess.run(
        [sys.executable, "-m", "tests.smoke.without_simulators", json.dumps(given)],
        cwd=records.ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=380,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    table = json.loads(done.stdout.splitlines()[-1])

    assert table["simulators"] == []
    untrained, odometry = table["untrained"], table["odometry"]["position_rmse_m"]
    assert odometry < 0.4 * untrained, table
    assert odometry < table["mean step"]["position_rmse_m"], table
    # Loops are closed only where they help on what was not learned from, so that they do little harm elsewhere.
    assert table["corrected"]["position_rmse_m"] < 1.2 * odometry, table

    folder = tmp_path / "weights" / "robot"
    LocalOdometry.load(folder)
    OnlineTrajectory.load(folder)
    network, description = load_local(folder)
    assert description["data"]["recordings"] == [path.name for path in files]
    assert len(description["data"]["split"]) == 4
    assert str(tmp_path) not in json.dumps(description)
    # What was measured in the recordings is what runs later.
    assert network.config.image.shape == shape
    assert network.config.image.is_scan == ("topics" in settings)
    assert network.config.period_s == pytest.approx(0.1 if world == "maze2d" else 2 / 35, rel=1e-6)
    optimizer = load_description(folder / "neural_graph_optimizer.safetensors", "neural_graph_optimizer")
    assert (NO_LOOPS in optimizer) == (NO_LOOPS in table)
    for name in ("trajectory.png", "error.png", "learning.png", "table.json"):
        assert (tmp_path / "runs" / "robot" / "results" / name).stat().st_size > 0


def test_a_simulator_cannot_be_imported_there() -> None:
    code = "import tests.smoke.without_simulators as w, sys; sys.meta_path.insert(0, w.NoSimulators()); import ngo_sim"
    done = subprocess.run([sys.executable, "-c", code], cwd=records.ROOT, capture_output=True, text=True)
    assert "No module named 'ngo_sim'" in done.stderr
