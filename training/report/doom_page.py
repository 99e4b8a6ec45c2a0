"""The page of the table of Doom maps, docs/results_doom.md, and the figure of its paths."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from ngo_estimator.checkpoint import LOCAL, OPTIMIZER, PLACE, SMOOTHER
from training.report.page import interval, markdown, number
from training.report.page import page as whole
from training.report.pictures import panels, save
from training.scoring.doom_rows import METRICS, ROWS

_TITLES = {
    "local": "odometry of the local network",
    "gtsam": "robust pose graph (GTSAM), same odometry and loops, tuned on validation maps",
    "ours": "corrected (`ngo_node`)",
}
_COLUMNS = {
    "translation_percent": "Final error, % of the path",
    "ate_m": "ATE, m",
    "within_3_std": "Poses within three published deviations",
}
_RETURNS = 0.1
_COLOURS = {"truth": "0.6", "local": "tab:orange", "gtsam": "tab:green", "ours": "tab:blue"}


def page(result: dict[str, Any], weights: Path) -> str:
    """The page of a JSON's content; ``weights`` is the folder of the networks."""
    maps = result["maps"]
    medians = [
        [f"`{row}`: {_TITLES[row]}", *(_median(maps, row, metric) for metric in METRICS)] for row in ROWS
    ]  # fmt: skip
    parts = [
        _INTRODUCTION.format(**result),
        "## Median over maps\n\nIn brackets: smallest and largest mean of a map.\n\n"
        + markdown(["Row", *_COLUMNS.values()], medians)
        + f"\n\n{_ratios(maps, result['returns'])}",
        "![Paths on every map](images/results_doom_maps.png)",
    ]
    for metric, title in _COLUMNS.items():
        rows = [
            [name, number(result["path_m"][name]["mean"]), *(interval(entry[row][metric]) for row in ROWS)]
            for name, entry in maps.items()
        ]
        parts.append(f"## {title}\n\n" + markdown(["Map", "Path, m", *(f"`{row}`" for row in ROWS)], rows))
    parts.append("## Training\n\n" + markdown(["Network", "Command", "Minutes", "Datapoints/s"], _trainings(weights)))
    parts.append(_LEVELS)
    return whole(parts)


def _ratios(maps: dict[str, Any], returns: dict[str, float]) -> str:
    ratios = np.array([entry["ours"]["ate_m"]["mean"] / entry["local"]["ate_m"]["mean"] for entry in maps.values()])
    revisited = np.array([returns[name] >= _RETURNS for name in maps])
    there = (
        f" Over the {revisited.sum()} maps where a tenth of the poses or more are returns (1 m, 35 degrees), the "
        f"median is {number(float(np.median(ratios[revisited])))}."
        if revisited.any()
        else ""
    )
    return (
        f"The corrected ATE of a map is {number(float(np.median(ratios)))} of its odometry's in the median "
        f"({number(ratios.min())} to {number(ratios.max())}). {int((ratios > 1.05).sum())} of {len(ratios)} maps are "
        f"more than 5 % worse than their odometry.{there}"
    )


def _median(maps: dict[str, Any], row: str, metric: str) -> str:
    means = [entry[row][metric]["mean"] for entry in maps.values()]
    return f"{number(float(np.median(means)))} [{number(min(means))}, {number(max(means))}]"


def _trainings(weights: Path) -> list[list[str]]:
    rows = []
    for kind in (LOCAL, PLACE, SMOOTHER, OPTIMIZER):
        path = weights / f"{kind}.json"
        described = json.loads(path.read_text()) if path.exists() else {}
        for name, part in ((kind, described), (f"{kind}, memory", described.get("memory", {}))):
            training = part.get("training")
            if isinstance(training, dict) and "seconds" in training:
                speed = number(training["datapoints_per_s"])
                rows.append([name, f"`{training['command']}`", number(training["seconds"] / 60.0), speed])
    return rows


def draw(path: Path, tracks: dict[str, dict[str, np.ndarray]]) -> None:
    """Draw the paths ``(steps, 2)`` of all rows on the first drive of each map."""
    figure, axes = panels(len(tracks), 5, 3.2, 3.0)
    for axis, (name, lines) in zip(axes, tracks.items(), strict=True):
        for row in lines:
            axis.plot(*lines[row].T, color=_COLOURS[row], linewidth=2.0 if row == "truth" else 0.8)
        axis.set_title(name, fontsize=8)
        axis.set_aspect("equal")
        axis.axis("off")
    handles = [Line2D([], [], color=_COLOURS[row], label=row) for row in _COLOURS]
    figure.legend(handles=handles, loc="lower right", ncols=2)
    save(figure, path, dpi=70)


_INTRODUCTION = """# Doom maps that nobody trained on

Written by `{command}` at revision {revision}.

Three drives of 1000 frames on each map, by the driver `explorer`, from the map's own start. No training and no choice
has seen these maps: freedoom2's MAP21 to MAP32 and the scenarios of ViZDoom (`training/data/doom_drives.py`).
`rocket_basic` and `simpler_basic` are the same map.

- **Final error**: distance of the last two positions, in percent of the path, aligned at the first pose alone.
- **ATE**: root mean square distance of positions after the best rigid alignment.
- **Within three deviations**: share of the poses whose x, y and heading, as published when they were new, each lie
  within three of their published deviations of the truth. For `gtsam` these are the deviations of its odometry.

Brackets behind means hold 95 % intervals by resampling the three drives, which is a coarse measure."""

_LEVELS = """## Levels to learn from

`ros2 run ngo_sim maze3d --ros-args -p level:=rooms -p seed:=7` drives through one. Columns: the plan with a drive of
the explorer, and what it sees.

![Generated levels](images/doom_levels.png)"""
