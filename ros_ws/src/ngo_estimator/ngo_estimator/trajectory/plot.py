"""A picture of estimated trajectories, each over the truth where that is known."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

TRUTH = "#1f6fd6"
_COLORS = ("#2ca02c", "#ff7f0e", "#9467bd", "#d62728")
_MOST_POINTS = 20_000
_NARROWEST = 0.6  # Height of a panel in its width, or the other way round, at least: else its labels overlap.
_LEAST_M = 0.5


def save_plot(
    path: Path,
    title: str,
    estimates: Mapping[str, np.ndarray],
    truth: np.ndarray | None = None,
    walls: np.ndarray | None = None,
) -> None:
    """Write a PNG with a panel for each estimate, seen from above, and one for the walls where they are given.

    Args:
        estimates: poses ``(frames, 3)`` by name, all in one frame.
        truth: poses ``(frames, 3)`` in the same frame.
        walls: points ``(n, 2)`` of all scans at the last estimate's poses.
    """
    count = len(estimates) + (walls is not None)
    figure = Figure(figsize=(6.2 * count, 6.2), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, count, squeeze=False)[0]
    if walls is not None:
        # One dot a point: a wall that is drawn twice shows at once.
        panels[-1].plot(walls[:, 0], walls[:, 1], ",", color="black", alpha=0.35)
        panels[-1].plot(*list(estimates.values())[-1][:, :2].T, color=_COLORS[1], linewidth=0.6, alpha=0.7)
        panels[-1].set_aspect("equal", adjustable="box")
        panels[-1].set(title="all scans at corrected poses", xlabel="x (m)")
    for axes, (name, poses), color in zip(panels, estimates.items(), _COLORS, strict=False):
        if truth is not None:
            _draw(axes, truth, TRUTH, "truth")
        _draw(axes, poses, color, name)
        axes.plot(*poses[0, :2], "o", color="black", label="start", zorder=5)
        axes.set_aspect("equal", adjustable="box")
        axes.set(title=name, xlabel="x (m)")
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.legend(frameon=False, fontsize=8)
    panels[0].set_ylabel("y (m)")
    shown = [*estimates.values(), *([truth] if truth is not None else [])]
    for axes in panels[: len(estimates)]:
        _leave_room(axes, np.concatenate([poses[:, :2] for poses in shown]))
    if walls is not None:
        _leave_room(panels[-1], np.concatenate((walls, list(estimates.values())[-1][:, :2])))
    figure.suptitle(title)
    figure.savefig(path, dpi=110, bbox_inches="tight")


def _leave_room(axes: Axes, points: np.ndarray) -> None:
    """Show the points with so much around them that a straight path leaves a panel its height and width."""
    if not len(points):
        return
    low, high = points.min(axis=0), points.max(axis=0)
    middle, extent = 0.5 * (low + high), high - low
    half = 0.55 * np.maximum(extent, max(_NARROWEST * float(extent.max()), _LEAST_M))
    axes.set(xlim=(middle[0] - half[0], middle[0] + half[0]), ylim=(middle[1] - half[1], middle[1] + half[1]))


def _draw(axes: Axes, poses: np.ndarray, color: str, label: str) -> None:
    shown = poses[:: max(1, len(poses) // _MOST_POINTS)]
    axes.plot(shown[:, 0], shown[:, 1], color=color, linewidth=1.3, label=label)
    axes.plot(*poses[-1, :2], "X", color=color, markeredgecolor="black", zorder=5)
