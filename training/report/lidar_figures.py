"""Pictures of a lidar's results: trajectories, and all scans at corrected poses."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from training.data.batches import seen_from_first
from training.scoring.lidar_scores import Scored

Drives = Mapping[str, Mapping[str, Scored]]

_COLUMNS = 2
_DRAWN = {"buildings": 4, "aliased": 2}


def draw_buildings(folder: Path, tables: Mapping[str, Drives]) -> dict[str, str]:
    """Draw the first buildings of each table into ``folder``; returns the files' names with their captions."""
    images: dict[str, str] = {}
    for table, count in _DRAWN.items():
        drives = {
            name: rows for name, rows in tables.get(table, {}).items() if "ours" in rows and not rows["ours"].failed
        }
        if drives:
            name = f"results_scan_{table}.png"
            _draw(folder / name, dict(list(drives.items())[:count]))
            images[name] = (
                f"The first of the table `{table}`: walls are all key scans at corrected poses (grey), the corrected "
                "path is blue, the truth black, the wheels red where they stay in the picture."
            )
    return images


def draw_logs(folder: Path, logs: Drives) -> None:
    """Draw every log into ``folder`` as ``NAME.png``, with wheels and without."""
    for name, rows in logs.items():
        for row in ("ours", "ours_without_wheels"):
            if row in rows and not rows[row].failed:
                _draw(folder / f"{name}_{row}.png", {f"{name}, {row}": {**rows, "ours": rows[row]}})


def _draw(path: Path, drives: Drives) -> None:
    columns = min(_COLUMNS, len(drives))
    lines = -(-len(drives) // columns)
    figure, axes = plt.subplots(lines, columns, figsize=(7.0 * columns, 6.0 * lines), squeeze=False)
    for axis in axes.flat[len(drives) :]:
        axis.set_visible(False)
    for axis, (name, rows) in zip(axes.flat, drives.items(), strict=False):
        _draw_drive(axis, name, rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _draw_drive(axis: Any, name: str, rows: Mapping[str, Scored]) -> None:
    ours = rows["ours"]
    if len(ours.walls):
        axis.plot(*ours.walls.T, ",", color="0.45", rasterized=True)
    if "wheels" in rows and len(rows["wheels"].path):
        axis.plot(*seen_from_first(rows["wheels"].path)[:, :2].T, color="tab:red", linewidth=0.7, label="wheels")
    if len(ours.truth):
        axis.plot(*seen_from_first(ours.truth)[:, :2].T, color="black", linewidth=1.6, label="truth")
    axis.plot(*ours.path[:, :2].T, color="tab:blue", linewidth=0.8, label="corrected")
    shown = np.concatenate((ours.walls, ours.path[:, :2]))
    low, high = np.percentile(shown, 0.5, axis=0), np.percentile(shown, 99.5, axis=0)
    margin = 0.05 * float((high - low).max()) + 0.5
    axis.set_xlim(low[0] - margin, high[0] + margin)
    axis.set_ylim(low[1] - margin, high[1] + margin)
    axis.set_aspect("equal")
    error = next(
        (f", {key} {ours.errors[key].mean():.3f}" for key in ("translation_m", "ate_m") if key in ours.errors), ""
    )
    axis.set_title(f"{name}{error}")
    axis.set_xlabel("x, m")
    axis.set_ylabel("y, m")
    axis.legend(loc="upper right", fontsize=8)
