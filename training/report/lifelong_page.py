"""The page of maps that last, docs/results_lifelong.md."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ngo_estimator.mapping.scan_map import ScanMapConfig
from training.report.page import Column, figures, interval, number, table
from training.report.page import page as whole
from training.report.pictures import panels, save
from training.scoring.table import Measured, Table

_COLUMNS = (
    Column("ate_m", "Error, m", number),
    Column("joint_ate_m", "Error of all as one, m", number),
    Column("met", "Met at the end, %", number, 100.0),
    Column("in_time", "Met in time, %", number, 100.0),
    Column("scans_to_meeting", "Scans to meeting", number),
    Column("false_meetings", "False meetings, %", number, 100.0),
    Column("ms_a_step", "Computing time of a step, ms", number),
)

_JOIN_COLUMNS = (
    *(column for column in _COLUMNS if column.key in ("ate_m", "joint_ate_m", "met", "false_meetings")),
    Column("s_to_join", "Time to join, s", number),
)

_YEAR_COLUMNS = (
    Column("ate_m", "Error, m", number),
    Column("drive_ate_m", "of the drive by itself, m", number),
    Column("alone_ate_m", "where it is mapped alone, m", number),
    Column("iou", "IoU of free cells", number),
    Column("iou_of_sums", "where all scans count alike", number),
    Column("occupied_iou", "IoU of occupied cells", number),
    Column("occupied_iou_of_sums", "where all scans count alike", number),
    Column("joined", "Found in the drive, %", number, 100.0),
    Column("localised_share", "Localised in 50 scans, %", number, 100.0),
    Column("found_share", "in 300, %", number, 100.0),
    Column("scans_to_claim", "Scans to a right pose", number),
    Column("false_claims", "False claims a drive", number),
    Column("ms_a_scan", "Time a scan, ms", number),
    Column("map_ms_a_scan", "of the map, ms", number),
    Column("memory_mb", "Memory, MB", number),
    Column("nodes", "Nodes", number),
    Column("load_s", "Time to load, s", number),
)

_YEAR = """## A building that changes

Made by `{command}`.

One robot patrols each of {settings[years]} buildings ({settings[split]} split) in {settings[drives]} drives of
{settings[year_scans]} scans of 360 rays, ten a second. Before each drive one piece in twenty of the furniture of rooms
and halls is moved within its room; doors move and people walk all the time. Each drive begins at an unknown place with
another odometry: the state that was saved is loaded, the robot is looked for in it, and the map grows from there, as
with `map_changes:=learn`. From {settings[most_scans]} key scans on, old ones leave the graph.

- Error: root mean square distance of the drive's positions, from where the robot was found on. The whole map is laid
  on the truth by one rigid motion, so that it [grows with the map](notebook.md#a-year-in-one-building). By itself:
  this part of the drive is laid on the truth. Alone: this part, laid likewise, where the drive makes a map of its own.
  A drive in which the robot was never found has none: means and intervals are over the others.
- IoU: of the cells of `/map` with those that exact rays from the true poses of its scans see in the building as it is
  at the end of the drive, with each door as it was at the scan. Cells have 5 cm: of the thin lines of occupied ones
  noise alone makes many differ. Where all scans count alike, older ones are not bounded.
- Localised: from {settings[starts]} starts in a drive, if the map shows the way there: a pose within 0.5 m and 5
  degrees is claimed within 50 scans, or 300. A robot that begins a drive goes half as far in 50 scans as one that
  drives ([why more are not found](notebook.md#a-robot-in-a-saved-map)). False claims: wrong ones there, and where the
  drive itself was found.
- Time a scan: computing time of odometry and correction; that of the map, drawn every 5 s, comes on top. Memory: all
  arrays of the saved state and of the map's scans."""

_KEEP_ALL = "The same where no key scan ever leaves the graph, made by `{command}`:"

_YEAR_RATIOS = {
    "memory_mb": "memory over that of drives 11 to 20",
    "ms_a_scan": "time a scan over that of drives 11 to 20",
    "ate_m": "error over that of the first ten",
    "drive_ate_m": "error of drives by themselves over that of the first ten",
    "of_alone": "over that of the same drives alone",
}

_FLEETS = """## Several robots on one map

Robots drive through each building at the same time, with scans of 360 rays, ten a second. In `aliased` buildings rooms
look alike. Buildings are few, so intervals of 95 %, by resampling buildings, are wide.

- `alone`: each robot has an `ngo_node` of its own. `together`: one for all, as with `robots` of `ngo_node`.
- Error: the root mean square distance of positions, each robot's trajectory aligned by itself, in the mean over robots;
  as one: of all robots that are in the common map, aligned together.
- Met in time: within 100 scans after two robots had 10 m of their way in common, a metre apart at most; scans from then
  on, where they met.
- False meetings: buildings in which a robot ever was more than 2 m from where the common map had it."""

_JOINS = """## Saved maps joined

Robots drive as above, each maps alone, and `join_sessions` lays their saved states into one map afterwards (`joined`).
Met: the share of the other maps that were laid into the first one. False meetings: the map has a robot more than 2 m
from where it was (root mean square)."""

_ROBOTS = """### {settings[robots]} robots

Made by `{command}`: {settings[buildings]} buildings as drawn and {settings[aliased]} aliased ones of the
{settings[split]} split, {settings[scans]} scans of each robot."""

_RATIO = "Error together over error alone, in the mean over buildings: {drawn}, and {aliased} in aliased ones."


_MOST_PANELS, _RESOLUTION_M = 4, ScanMapConfig().resolution_m


def draw_fleets(folder: Path, key: str, fleets: Mapping[str, Table]) -> None:
    """Draw the first maps of robots that have met, of the table ``key``."""
    all_met = [
        (name, rows["together"])
        for found in fleets.values()
        for name, rows in found.items()
        if rows["together"].errors["met"].min() == 1.0 and "walls" in rows["together"].drawn
    ][:_MOST_PANELS]
    if all_met:
        _draw_fleets(folder / _FLEET.format(key), all_met)


def draw_year(folder: Path, year: Table) -> None:
    """Draw a year in the first building, and the numbers of all, where old key scans leave."""
    learned = {name: rows["learn"] for name, rows in year.items() if "learn" in rows}
    for measured in list(learned.values())[:1]:
        _draw_year(folder / _YEAR_MAPS, measured)
        _draw_numbers(folder / _YEAR_NUMBERS, learned)


_FLEET, _YEAR_MAPS, _YEAR_NUMBERS = (f"results_lifelong_{name}.png" for name in ("{}", "year", "year_numbers"))
_FLEET_CAPTION = "Maps of {} robots that have met: key scans (grey), and the way of each robot."
_CAPTIONS = {
    _YEAR_MAPS: "The map after the first, the middle and the last drive (above), and the building as it was then.",
    _YEAR_NUMBERS: "Error, map, memory and time of each drive of the year; a line for each building.",
}


def _draw_fleets(path: Path, all_met: list[tuple[str, Measured]]) -> None:
    figure, axes = panels(len(all_met), 2, 7.0, 6.0)
    for axis, (name, measured) in zip(axes, all_met, strict=True):
        axis.plot(*measured.drawn["walls"].T, ",", color="0.45", rasterized=True)
        for way in sorted(key for key in measured.drawn if key.startswith("way_")):
            axis.plot(*measured.drawn[way][:, :2].T, linewidth=0.9, label=way.removeprefix("way_"))
        axis.set_aspect("equal")
        axis.set_title(f"{name}, joint_ate_m {measured.errors['joint_ate_m'].mean():.3f}")
        axis.set_xlabel("x, m")
        axis.set_ylabel("y, m")
        axis.legend(loc="upper right", fontsize=8)
    save(figure, path, dpi=90)


def _draw_year(path: Path, measured: Measured) -> None:
    names = ("first", "middle", "last")
    figure, axes = panels(6, 3, 6.0, 6.0)
    corners = np.concatenate([measured.drawn[f"{name}_corners"] for name in names])
    for kind, number_of_kind in (("found", 0), ("true", 1)):
        for name in names:
            values, axis = measured.drawn[f"{name}_{kind}"], next(axes)
            low = measured.drawn[f"{name}_corners"][number_of_kind]
            high = low + _RESOLUTION_M * np.array(values.shape[::-1])
            grey = np.select([values < 0, values < 50], [0.75, 1.0], 0.0)
            extent = (low[0], high[0], low[1], high[1])
            axis.imshow(grey, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="none")
            axis.set_title(f"{'map' if kind == 'found' else 'building'}, {name} drive")
            corners = np.concatenate((corners, high[None]))
    for axis in figure.axes:
        axis.set_xlim(corners[:, 0].min(), corners[:, 0].max())
        axis.set_ylim(corners[:, 1].min(), corners[:, 1].max())
    save(figure, path, dpi=80)


def _draw_numbers(path: Path, year: Mapping[str, Measured]) -> None:
    shown = [column for column in _YEAR_COLUMNS if column.key in ("ate_m", "iou", "memory_mb", "ms_a_scan")]
    figure, axes = panels(len(shown), 2, 6.0, 3.0)
    for axis, column in zip(axes, shown, strict=True):
        for name, measured in year.items():
            axis.plot(measured.errors[column.key], linewidth=0.9, label=name)
        axis.set_ylim(bottom=0.0)
        axis.set_title(column.title)
        axis.set_xlabel("drive")
    save(figure, path, dpi=90)


def page(result: dict[str, Any], images: Path) -> str:
    """The page of a JSON's content, with the figures that are in the folder ``images``."""
    parts, tables, captions = ["# Results: maps that last"], result["tables"], {}
    for name, words, row, columns in (
        ("fleet", _FLEETS, "together", _COLUMNS), ("join", _JOINS, "joined", _JOIN_COLUMNS)
    ):  # fmt: skip
        keys = _tables(tables, name)
        parts += [words] if keys else []
        for key in keys:
            ratios = {of: interval(result[key]["paired"][f"{kind}{row}"]["ate_ratio"]) for of, kind in _KINDS.items()}
            rows = {f"`{title}`": numbers for title, numbers in tables[key].items()}
            parts += [_ROBOTS.format(**result[key]), table(rows, columns, "Row"), _RATIO.format(**ratios)]
            captions[_FLEET.format(key)] = _FLEET_CAPTION.format(result[key]["settings"]["robots"])
    for key in _tables(tables, "year"):
        year = result[key]
        rows = {row.replace("_", " "): numbers for row, numbers in tables[key].items()}
        said = [(name, interval(year["ratios"][ratio])) for ratio, name in _YEAR_RATIOS.items()]
        parts += [(_YEAR if key == "year" else _KEEP_ALL).format(**year), table(rows, _YEAR_COLUMNS, "Drives")]
        parts += ["The last ten drives: " + ", ".join(f"{name} {value}" for name, value in said if value) + "."]
        parts += [_LEAST.format(number(year["least"]["iou"]))] if "least" in year else []
    captions |= _CAPTIONS
    return whole([*parts, *figures({name: text for name, text in captions.items() if (images / name).exists()})])


def _tables(tables: Mapping[str, Any], name: str) -> list[str]:
    """The keys of the tables of a kind: ``name`` itself, and those with more robots or of another row."""
    return sorted(key for key in tables if key.split("_")[0] == name)


_LEAST = "The least IoU of free cells after any drive is {}."
_KINDS = {"drawn": "", "aliased": "aliased_"}
