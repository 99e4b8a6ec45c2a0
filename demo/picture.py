"""The picture of a run: the maze from above with the true, the estimated and the corrected trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from demo.trajectories import Poses, Trajectories
from ngo_sim.mazes import Maze, draw_maze

TRUTH, ODOMETRY, CORRECTED = "#1f6fd6", "#2ca02c", "#ff7f0e"


def save_picture(path: Path, maze: Maze, trajectories: Trajectories, result: dict[str, Any]) -> None:
    """Write a PNG: odometry beside the corrected path, each over the truth and the maze."""
    figure, panels = plt.subplots(1, 2, figsize=(13, 6.8), sharex=True, sharey=True, layout="constrained")
    shown = (
        (panels[0], "odometry", trajectories.odometry, ODOMETRY),
        (panels[1], "corrected", trajectories.corrected, CORRECTED),
    )
    for axes, name, estimate, color in shown:
        draw_maze(axes, maze)
        _line(axes, trajectories.truth, TRUTH, "truth", 1.6)
        placed = trajectories.in_maze(estimate)
        _line(axes, placed, color, name, 1.3)
        axes.plot(*trajectories.truth[0, :2], "o", color="black", markersize=7, label="start", zorder=5)
        axes.plot(
            *placed[-1, :2], "X", color=color, markeredgecolor="black", markersize=10, label=f"end ({name})", zorder=6
        )
        axes.plot(
            *trajectories.truth[-1, :2],
            "X",
            color=TRUTH,
            markeredgecolor="black",
            markersize=10,
            label="end (truth)",
            zorder=5,
        )
        errors = result[name]
        axes.set_title(
            f"{name}: position RMSE {errors['position_rmse_m']:.2f} m, end {errors['final_percent']:.2f} % "
            f"of the path off, heading RMSE {errors['heading_rmse_deg']:.1f}°",
            fontsize=10,
        )
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.08), ncols=5, frameon=False, fontsize=9)
    _show_everything(panels[0], maze, [trajectories.in_maze(poses) for _, _, poses, _ in shown])
    figure.suptitle(
        f"{result['world']}, seed {result['seed']}: {result['frames']} frames, {result['path_m']:.0f} m", fontsize=13
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _line(axes: Axes, poses: Poses, color: str, label: str, width: float) -> None:
    axes.plot(poses[:, 0], poses[:, 1], color=color, linewidth=width, label=label, alpha=0.9, zorder=3)


def _show_everything(axes: Axes, maze: Maze, estimates: list[Poses]) -> None:
    """Widen the view where an estimate left the maze."""
    margin = 0.3 * maze.block_m
    points = np.concatenate([poses[:, :2] for poses in estimates])
    low = np.minimum(points.min(axis=0) - margin, 0.0)
    high = np.maximum(points.max(axis=0) + margin, maze.size_m)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
