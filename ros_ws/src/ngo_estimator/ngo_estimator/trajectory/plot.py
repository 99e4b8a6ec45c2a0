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


def save_plot(path: Path, title: str, estimates: Mapping[str, np.ndarray], truth: np.ndarray | None = None) -> None:
    """Write a PNG with a panel for each estimate, seen from above.

    Args:
        estimates: poses ``(frames, 3)`` by name, all in one frame.
        truth: poses ``(frames, 3)`` in the same frame.
    """
    figure = Figure(figsize=(6.2 * len(estimates), 6.2))
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(estimates), sharex=True, sharey=True, squeeze=False)[0]
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
    figure.subplots_adjust(wspace=0.05)
    figure.suptitle(title)
    figure.savefig(path, dpi=110, bbox_inches="tight")


def _draw(axes: Axes, poses: np.ndarray, color: str, label: str) -> None:
    shown = poses[:: max(1, len(poses) // _MOST_POINTS)]
    axes.plot(shown[:, 0], shown[:, 1], color=color, linewidth=1.3, label=label)
    axes.plot(*poses[-1, :2], "X", color=color, markeredgecolor="black", zorder=5)
