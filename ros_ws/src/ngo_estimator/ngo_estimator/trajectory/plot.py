"""A picture of estimated trajectories, each over the truth where that is known."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ngo_estimator.trajectory.panel import BLACK, SIZE, Panel

TRUTH = "#1f6fd6"
_COLORS = ("#2ca02c", "#ff7f0e", "#9467bd", "#d62728")
_MOST_POINTS = 20_000
_TITLE = 30  # height of the title (pixels)


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
    paths = {name: _thinned(poses) for name, poses in estimates.items()}
    true = None if truth is None else _thinned(truth)
    shown = [*paths.values(), *([] if true is None else [true])]
    panels = []
    for (name, way), color in zip(paths.items(), _COLORS, strict=False):
        panel = Panel(name, shown)
        if true is not None:
            panel.line(true, TRUTH, label="truth")
            panel.dot(true[-1], TRUTH)
        panel.line(way, color, label=name)
        panel.dot(way[-1], color)
        panel.dot(way[0], BLACK, "start")
        panels.append(panel)
    if walls is not None:
        newest = list(paths.values())[-1]
        panel = Panel("all scans at corrected poses", [walls, newest])
        panel.cloud(walls)
        panel.line(newest, _COLORS[1], 1.0)
        panels.append(panel)
    picture = Image.new("RGB", (SIZE * len(panels), SIZE + _TITLE), "white")
    for k, panel in enumerate(panels):
        picture.paste(panel.picture(), (SIZE * k, _TITLE))
    middle = (picture.width / 2, _TITLE / 2 + 4)
    ImageDraw.Draw(picture).text(middle, title, BLACK, ImageFont.load_default(18), "mm")
    picture.save(path)


def _thinned(poses: np.ndarray) -> np.ndarray:
    """Positions ``(n, 2)`` of at most about ``_MOST_POINTS`` poses, the last one among them."""
    every = max(1, len(poses) // _MOST_POINTS)
    return np.concatenate((poses[:-1:every, :2], poses[-1:, :2]))
