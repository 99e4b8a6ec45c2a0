"""A picture of a pose graph before and after its correction, with its believed and its refused loops."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

_PATH, _BELIEVED, _REFUSED = "#404040", "#1f6fd6", "#d62728"
_MOST_LINES = 20_000
_OPAQUE = 400  # so many lines may be drawn full; more are the fainter, or nothing else would be seen


def save_graph_plot(path: Path, title: str, before: np.ndarray, after: np.ndarray, loops: np.ndarray,
                    believed: np.ndarray) -> None:  # fmt: skip
    """Write a PNG.

    Args:
        before, after: poses ``(n, 3)`` of the same vertices, in the order of the chain.
        loops: vertices ``(m, 2)`` that loops join; believed: which of them are ``(m,)``.
    """
    figure = Figure(figsize=(13.0, 6.8), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for axes, poses, name in ((left, before, "before"), (right, after, "after")):
        for which, color, said in ((~believed, _REFUSED, "refused"), (believed, _BELIEVED, "believed")):
            _draw_loops(axes, poses[loops[which], :2], color, f"{which.sum()} loops {said}")
        axes.plot(poses[:, 0], poses[:, 1], color=_PATH, linewidth=0.8, label=f"{len(poses)} poses")
        axes.plot(*poses[0, :2], "o", color="black", markersize=4)
        _frame(axes, poses[:, :2])
        axes.set(title=name, xlabel="x (m)", ylabel="y (m)")
        axes.grid(color="#dddddd", linewidth=0.5)
    figure.legend(*right.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(title)
    figure.savefig(path, dpi=110)


def _draw_loops(axes: Axes, ends: np.ndarray, color: str, label: str) -> None:
    """Lines between the ends ``(n, 2, 2)``."""
    shown = ends[:: max(1, -(-len(ends) // _MOST_LINES))]
    alpha = min(1.0, max(0.06, _OPAQUE / max(len(shown), 1)))
    axes.add_collection(LineCollection(list(shown), colors=color, linewidths=0.6, alpha=alpha))
    axes.plot([], [], color=color, label=label)


def _frame(axes: Axes, points: np.ndarray) -> None:
    low, high = points.min(0), points.max(0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
    axes.set_aspect("equal", adjustable="box")
