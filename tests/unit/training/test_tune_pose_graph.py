"""The search for the pose graph's settings, on problems whose answer is known."""

import dataclasses
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import SMOOTHER, load_local, save_checkpoint
from ngo_estimator.geometry import se2
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from tests.unit.ngo_estimator.samples import small_pair_head
from training.baselines.graph_settings import fit_calibration, load_settings
from training.baselines.pose_graph import PoseGraphSettings
from training.common.records import WEIGHTS
from training.data.worlds import world_named
from training.prerequisites import is_tuned
from training.scoring.table_rows import Sources
from training.tune_pose_graph import GRID, Arguments, Objective, main, tune

START = PoseGraphSettings(odometry_position_scale=1.0, loop_position_scale=1.0, kernel="dcs")


def valley(settings: PoseGraphSettings) -> float:
    """Smallest at an odometry scale of 3 and a loop scale of 2, which is found along a slanted valley only."""
    x, y = settings.odometry_position_scale - 3.0, settings.loop_position_scale - 2.0
    return 1.0 + x * x + x * y + y * y + (settings.kernel != "cauchy")


SCALES = tuple(
    tuple({name: float(value)} for value in range(1, 6)) for name in ("odometry_position_scale", "loop_position_scale")
)
KERNELS = ({"kernel": "huber"}, {"kernel": "cauchy"})


def test_the_search_ends_at_the_best_of_the_grid() -> None:
    best, least = tune(valley, START, (*SCALES, KERNELS), passes=10)
    assert best == replace(START, odometry_position_scale=3.0, loop_position_scale=2.0, kernel="cauchy")
    assert least == 1.0


def drive(trajectories: int = 2, steps: int = 160) -> dict[str, np.ndarray]:
    """Truth of robots in circles, and an odometry that is a tenth too short and turns too far."""
    rng = np.random.default_rng(0)
    true_steps = np.tile([0.1, 0.0, 0.1], (trajectories, steps, 1)) * rng.uniform(0.5, 1.5, (trajectories, steps, 1))
    truth = se2.r2g(torch.from_numpy(true_steps)).numpy()
    relative = (true_steps * [0.9, 1.0, 1.0] + [0.0, 0.0, 0.01]).astype(np.float32)
    codes = rng.normal(0.0, 1.0, (trajectories, steps, 12)).astype(np.float16)
    log_std = np.full_like(relative, -4.0)
    return {"relative": relative, "log_std": log_std, "codes": codes, "origin_code": codes[:, :1], "truth": truth}


def test_the_objective_is_the_mean_error_of_the_pose_graph() -> None:
    arrays = drive()
    unbelieved = replace(START, min_logit=1e9)
    objective = Objective(arrays, small_pair_head())
    odometry = se2.r2g(torch.from_numpy(arrays["relative"]).double()).numpy()
    assert objective(unbelieved) == pytest.approx(objective.error(odometry), rel=1e-4)
    squares = np.square(odometry - arrays["truth"])[..., :2].sum(-1)
    expected = np.sqrt(squares.sum(-1) / (squares.shape[1] + 1)).mean()  # the first frame is exact
    assert objective.error(odometry) == pytest.approx(expected)
    calibrated = replace(unbelieved, **fit_calibration(arrays["relative"], arrays["truth"]))
    assert objective(calibrated) < 0.01 < objective(unbelieved)


def test_the_script_tunes_every_form_on_all_tables(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("training.tune_pose_graph.GRID", GRID[3:4])
    steps = 64
    for seed, table in enumerate(world_named("maze2d").tables):
        arrays = drive(steps=steps)
        arrays["codes"] = np.zeros((2, steps, 128 + 241), np.float16)  # scans in which nothing came back
        arrays["codes"][..., :128] = np.random.default_rng(seed).normal(0.0, 1.0, (2, steps, 128))
        arrays["origin_code"] = arrays["codes"][:, :1]
        store = tmp_path / "maze2d" / "features" / f"validation_{table}"
        store.mkdir(parents=True)
        for name, array in {**arrays, "motion": np.zeros((2, steps, 1))}.items():
            np.save(store / f"{name}.npy", array)
        (store / "done.0of1.json").write_text("[0]")
    arguments = Arguments("maze2d", passes=1, runs=tmp_path, out=tmp_path)
    best = main(arguments)
    written = json.loads((tmp_path / "maze2d.gtsam.json").read_text())
    assert load_settings(tmp_path / "maze2d.gtsam.json") == best
    assert written["validation"]["trajectories"] == 4
    assert written["validation"]["position_rmse_m"] < 0.1 * written["validation"]["odometry_position_rmse_m"]
    assert best.odometry_bias[2] == pytest.approx(-0.01, abs=1e-3)
    assert written["tuning"]["command"] == "python -m training.tune_pose_graph --world maze2d --passes 1"
    registered = main(replace(arguments, form="registered"))
    assert load_settings(tmp_path / "maze2d.gtsam_registered.json") == registered
    assert registered.search.registrations == best.search.registrations > 0
    assert registered.odometry_bias == (0.0, 0.0, 0.0)
    weights = tmp_path / "weights" / "maze2d"
    shutil.copytree(WEIGHTS / "maze2d", weights)
    smoother = OdometrySmoother(SmootherConfig(1, (0.1, 0.02, 0.05)))
    with torch.no_grad():
        smoother.head.bias[2] = -2.0  # two tenths of 0.05 rad a step, which is what the odometry turns too much
    of = {"local_pose_network_sha256": load_local(weights)[1]["sha256"]}
    save_checkpoint(weights / f"{SMOOTHER}.safetensors", smoother, SMOOTHER, "maze2d", of)
    smoothed = main(replace(arguments, form="smoothed", weights=tmp_path / "weights"))
    assert load_settings(tmp_path / "maze2d.gtsam_smoothed.json") == smoothed
    validation = json.loads((tmp_path / "maze2d.gtsam_smoothed.json").read_text())["validation"]
    assert validation["position_rmse_m"] < 0.7 * validation["odometry_position_rmse_m"]
    sources = Sources(world_named("maze2d"), tmp_path / "weights", tmp_path, tmp_path)
    assert is_tuned(sources, "loops") and is_tuned(sources, "smoothed")
    save_checkpoint(weights / f"{SMOOTHER}.safetensors", OdometrySmoother(smoother.config), SMOOTHER, "maze2d", of)
    assert is_tuned(sources, "loops") and not is_tuned(sources, "smoothed")


@pytest.mark.parametrize(
    "content",
    [
        None,
        "no json",
        {},
        {"settings": {**dataclasses.asdict(START), "colour": 1}},
        {"settings": {**dataclasses.asdict(START), "kernel_width": -1.0}},
        {"settings": {**dataclasses.asdict(START), "search": {"most": 0}}},
        {"settings": {"kernel": "dcs"}},
    ],
)
def test_a_file_of_something_else_is_refused_by_name(tmp_path: Path, content: Any) -> None:
    path = tmp_path / "maze2d.gtsam.json"
    if content is not None:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ValueError, match=r"maze2d\.gtsam\.json.* expected what `python -m training\.tune_pose_graph`"):
        load_settings(path)
