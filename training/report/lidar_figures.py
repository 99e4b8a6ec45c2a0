"""Pictures of a lidar's results: trajectories, and all scans at corrected poses."""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from training.data.batches import seen_from_first
from training.report.pictures import panels, save
from training.scoring.table import Measured

Drives = Mapping[str, Mapping[str, Measured]]

_MANY = 4  # smaller pictures of more drives
_DRAWN = {"buildings": 4, "aliased": 2}
_COLOURS = "Key scans at corrected poses (grey), corrected path (blue), wheels where they stay in the picture (red)"


def draw(folder: Path, logs: Drives, tables: Mapping[str, Drives], earlier: Collection[str] = ()) -> dict[str, str]:
    """Draw logs and the first buildings of each table into ``folder``; returns the files' names with their captions.

    A log with relations has a picture of its own; all others share one. Tables that are ``earlier`` ones keep theirs.
    """
    with_relations = {name: rows for name, rows in _drawable(logs).items() if "translation_m" in rows["ours"].errors}
    pictures = {f"log_{name}": ({name: rows}, name) for name, rows in with_relations.items()}
    others = {name: rows for name, rows in _drawable(logs).items() if name not in with_relations}
    pictures["logs"] = others, "the logs with a mapper's poses"
    for table, count in _DRAWN.items():
        first = list(_drawable(tables.get(table, {})).items())[:count]
        pictures[table] = dict(first), f"the first drives of the table `{table}`, truth in black"
    if "logs" in earlier:
        kept = (path.stem.removeprefix("results_scan_") for path in sorted(folder.glob("results_scan_log_*.png")))
        pictures = {name: ({}, name.removeprefix("log_")) for name in kept} | pictures
    images: dict[str, str] = {}
    for name, (drives, what) in pictures.items():
        path = folder / f"results_scan_{name}.png"
        if drives:
            _draw(path, drives)
        if drives or ((name in earlier or name.startswith("log_")) and path.is_file()):
            images[f"results_scan_{name}.png"] = f"{_COLOURS}: {what}."
    return images


def _drawable(drives: Drives) -> Drives:
    return {name: rows for name, rows in drives.items() if "ours" in rows and not rows["ours"].failed}


def _draw(path: Path, drives: Drives) -> None:
    across, width, height = (3, 4.6, 4.0) if len(drives) > _MANY else (2, 7.0, 6.0)
    figure, axes = panels(len(drives), across, width, height)
    for axis, (name, rows) in zip(axes, drives.items(), strict=True):
        _draw_drive(axis, name, rows)
    save(figure, path, dpi=90)


def _draw_drive(axis: Any, name: str, rows: Mapping[str, Measured]) -> None:
    ours = rows["ours"]
    walls, path, truth = (ours.drawn[name] for name in ("walls", "path", "truth"))
    if len(walls):
        axis.plot(*walls.T, ",", color="0.45", rasterized=True)
    if "wheels" in rows and not rows["wheels"].failed:
        axis.plot(
            *seen_from_first(rows["wheels"].drawn["path"])[:, :2].T, color="tab:red", linewidth=0.7, label="wheels"
        )
    if len(truth):
        axis.plot(*seen_from_first(truth)[:, :2].T, color="black", linewidth=1.6, label="truth")
    axis.plot(*path[:, :2].T, color="tab:blue", linewidth=0.8, label="corrected")
    shown = np.concatenate((walls, path[:, :2]))
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
