"""The errors of networks of a robot on the recording that was held out: a table, and plots."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local, load_optimizer, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.trajectory.plot import TRUTH, save_plot
from training.data.batches import relative_poses, seen_from_first
from training.data.features import OPTIMIZER_INPUTS, Networks
from training.recordings.recording_features import features_of_track
from training.recordings.recording_source import NO_LOOPS, RecordedArguments, open_recorded
from training.recordings.recording_tracks import Track
from training.report.error_table import print_errors
from training.report.pictures import panels, save
from training.report.training_records import learning_curve
from training.scoring.metrics import path_length_m, trajectory_error
from training.scoring.online_estimate import online_poses, with_origin

COLORS = {"odometry": "#2ca02c", "online": "#9467bd", "corrected": "#ff7f0e"}
_MEAN_STEP = "mean step"
_CURVES = {
    "local": ("local network", "validation_rmse_deg", "heading RMSE of a step, deg"),
    "place": ("place encoder", "validation_median_m", "median error of a pair, m"),
    "optimizer*": ("optimizer", "corrected_m", "position RMSE, m"),
}

Poses = dict[str, np.ndarray]


def evaluate_recorded(recordings: RecordedArguments, weights: Path, runs: Path, online: bool = True) -> dict[str, Any]:
    """Print the table, write plots into ``runs/NAME/results`` and return the table.

    ``mean step`` is what an estimator does that knows the actions and looks at nothing: every step is the mean of those
    of the training part with its action.

    Raises:
        ValueError: there are no steps to measure on, or the networks were trained on other ones.
    """
    name = recordings.name
    folder = weights / name
    local = load_local(folder, name)
    data = open_recorded(recordings, runs, local)
    networks = Networks(local[0], load_place(folder, name)[0])
    optimizer, description = load_optimizer(folder, name)
    tracks = [track for track in data.tracks("test") if len(track) > 2 * optimizer.block]
    tracks = [track for track in tracks if path_length_m(track.poses_xyyaw) > 0.0]
    if not tracks:
        raise ValueError(f"the held-out part has no stretch of {2 * optimizer.block} steps in which the robot moves")
    mean_steps = MeanSteps(data.tracks("train"))
    estimates: list[tuple[Track, Poses]] = []
    for track in tqdm(tracks, desc=f"{name} held out"):
        features = features_of_track(data.domain, track, networks)
        arrays = [torch.from_numpy(features[key]) for key in OPTIMIZER_INPUTS]
        corrected = optimize_offline(optimizer, networks.place.pair_head, *arrays).poses[0]
        poses = {_MEAN_STEP: mean_steps.poses(track), "odometry": with_origin(se2.r2g(arrays[0]).numpy())}
        if online:
            core = OnlineTrajectory(optimizer, networks.place.pair_head, max(len(track), 2 * optimizer.block))
            poses["online"] = online_poses(core, features)
        estimates.append((track, {**poses, "corrected": with_origin(corrected.numpy())}))
    result = {"name": name, "split": list(data.parts.words), **_table(name, estimates)}
    if NO_LOOPS in description:
        result[NO_LOOPS] = description[NO_LOOPS]
        print(f"no loops are closed: {description[NO_LOOPS]}")
    out = runs / name / "results"
    out.mkdir(parents=True, exist_ok=True)
    for path in draw(out, runs / name, estimates):
        print(path)
    (out / "table.json").write_text(json.dumps(result, indent=1) + "\n")
    print(json.dumps(result))
    return result


class MeanSteps:
    """Dead reckoning by the mean motion of each action."""

    def __init__(self, tracks: list[Track]) -> None:
        steps = torch.cat([relative_poses(track.poses_xyyaw) for track in tracks]).double()
        actions = torch.cat([_actions(track) for track in tracks])
        self.means = {int(action): steps[actions == action].mean(0) for action in actions.unique()}
        self.mean = steps.mean(0)

    def poses(self, track: Track) -> np.ndarray:
        """Poses ``(frames, 3)`` of a track."""
        steps = torch.stack([self.means.get(action, self.mean) for action in _actions(track).tolist()])
        return with_origin(se2.r2g(steps).numpy())


def _actions(track: Track) -> Tensor:
    return torch.zeros(len(track) - 1) if track.actions is None else torch.from_numpy(track.actions)


def _table(name: str, estimates: list[tuple[Track, Poses]]) -> dict[str, Any]:
    frames = sum(len(track) for track, _ in estimates)
    path_m = sum(path_length_m(track.poses_xyyaw) for track, _ in estimates)
    errors = {
        kind: [trajectory_error(poses[kind], track.poses_xyyaw) for track, poses in estimates]
        for kind in estimates[0][1]
    }
    title = f"{name}, held out: {len(estimates)} trajectories, {frames} frames, {path_m:.1f} m"
    return {"trajectories": len(estimates), "frames": frames, "path_m": path_m, **print_errors(title, errors)}


def draw(out: Path, run: Path, estimates: list[tuple[Track, Poses]]) -> list[Path]:
    """Write the plots: the longest trajectory, errors against frames, and the learning curves; returns their paths."""
    track, poses = max(estimates, key=lambda one: len(one[0]))
    paths = [out / "trajectory.png", out / "error.png"]
    truth = seen_from_first(track.poses_xyyaw)
    shown = {kind: poses[kind] for kind in ("odometry", "corrected")}
    save_plot(paths[0], f"held out, {len(track)} frames", shown, truth)
    figure, (axes,) = panels(1, 1, 8.0, 4.6)
    for kind, estimate in poses.items():
        if kind == _MEAN_STEP:  # so far off that nothing else could be seen
            continue
        error = np.linalg.norm(estimate[:, :2] - truth[:, :2], axis=1)
        axes.plot(error, color=COLORS[kind], label=kind, linewidth=1.3)
    axes.set(xlabel="frame", ylabel="distance from the truth, m", title="held out")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    save(figure, paths[1], dpi=110)
    if (curves := learning_curves(run)) is not None:
        paths.append(out / "learning.png")
        save(curves, paths[2], dpi=110)
    return paths


def learning_curves(run: Path) -> Figure | None:
    """Validation curves of the trainings in the folder of a run; None without any."""
    found = []
    for pattern, (title, column, label) in _CURVES.items():
        for folder in sorted(run.glob(pattern)):
            curve = learning_curve(folder)
            if column in curve:
                found.append((title, curve, column, label))
    if not found:
        return None
    figure, across = panels(len(found), len(found), 5.2, 4.2)
    for axes, (title, curve, column, label) in zip(across, found, strict=True):
        axes.plot(curve["epoch"] + 1, curve[column], ".-", color=TRUTH)
        if "odometry_m" in curve:
            axes.axhline(float(curve["odometry_m"][-1]), color=COLORS["odometry"], linestyle=":", label="odometry")
            axes.legend(frameon=False)
        axes.set(title=title, xlabel="epoch", ylabel=label)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    return figure
