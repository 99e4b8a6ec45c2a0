"""The picture of a run: the maze from above with the true, the estimated and the corrected trajectory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import Affine2D

from demo.trajectories import Poses, Trajectories
from ngo_estimator.mapping.occupancy_grid import OccupancyMap
from ngo_sim.mazes import Maze, draw_maze

TRUTH, ODOMETRY, CORRECTED = "#1f6fd6", "#2ca02c", "#ff7f0e"


def save_picture(
    path: Path, maze: Maze, trajectories: Trajectories, result: dict[str, Any], found: OccupancyMap | None = None
) -> None:
    """Write a PNG: odometry, corrected path and map side by side, the paths over the truth and the maze."""
    shown = (("odometry", trajectories.odometry, ODOMETRY), ("corrected", trajectories.corrected, CORRECTED))
    low, high = _view(maze, [trajectories.in_maze(poses) for _, poses, _ in shown])
    width = 6.2
    height = width * float(np.clip((high - low)[1] / (high - low)[0], 0.4, 2.0))
    count = 2 if found is None else 3
    figure, panels = plt.subplots(1, count, figsize=(count * width, height + 1.7), sharex=True, sharey=True)
    for axes, (name, estimate, color) in zip(panels, shown, strict=False):
        draw_maze(axes, maze)
        placed = trajectories.in_maze(estimate)
        _line(axes, trajectories.truth, TRUTH, "truth", 1.6)
        _line(axes, placed, color, name, 1.3)
        _mark(axes, trajectories.truth[0], "o", "black", "start")
        _mark(axes, placed[-1], "X", color, f"end ({name})")
        _mark(axes, trajectories.truth[-1], "X", TRUTH, "end (truth)")
        errors = result[name]
        axes.set_title(
            f"{name}: position RMSE {errors['position_rmse_m']:.2f} m, end off by {errors['final_percent']:.2f} % of "
            f"the path,\nheading RMSE {errors['heading_rmse_deg']:.1f}°",
            fontsize=10,
        )
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.55 / height), ncols=5, frameon=False, fontsize=8)
    if found is not None:
        _draw_map(panels[2], found, trajectories)
    panels[1].set_ylabel("")
    total = height + 1.7
    figure.subplots_adjust(left=0.05, right=0.99, wspace=0.06, bottom=0.85 / total, top=1 - 0.85 / total)
    title = f"{result['world']}, seed {result['seed']}: {result['frames']} frames, {result['path_m']:.0f} m"
    figure.suptitle(title, fontsize=13, y=1 - 0.12 / total, va="top")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _draw_map(axes: Axes, found: OccupancyMap, trajectories: Trajectories) -> None:
    """The map, turned into the maze's frame."""
    rows, columns = found.values.shape
    (left, bottom), side = found.origin_xy, found.resolution_m
    x, y, yaw = trajectories.truth[0]
    in_maze = Affine2D().rotate(yaw).translate(x, y) + axes.transData
    grey = np.select([found.values == 0, found.values == 100], [255, 0], 190)
    extent = (left, left + columns * side, bottom, bottom + rows * side)
    image = axes.imshow(grey, "gray", origin="lower", vmin=0, vmax=255, extent=extent, interpolation="nearest")
    image.set_transform(in_maze)
    axes.set_facecolor(str(190 / 255))
    axes.set(aspect="equal", xlabel="x [m]")
    axes.set_title(f"map at corrected poses, cells of {side:g} m", fontsize=10)


def _mark(axes: Axes, pose: Poses, marker: str, color: str, label: str) -> None:
    axes.plot(*pose[:2], marker, color=color, markeredgecolor="black", markersize=9, label=label, zorder=5)


def _line(axes: Axes, poses: Poses, color: str, label: str, width: float) -> None:
    axes.plot(poses[:, 0], poses[:, 1], color=color, linewidth=width, label=label, alpha=0.9, zorder=3)


def _view(maze: Maze, estimates: list[Poses]) -> tuple[Poses, Poses]:
    """Lower left and upper right (2,) of what to show: the maze, and more where an estimate left it."""
    margin = 0.3 * maze.block_m
    points = np.concatenate([poses[:, :2] for poses in estimates])
    return np.minimum(points.min(axis=0) - margin, 0.0), np.maximum(points.max(axis=0) + margin, maze.size_m)
