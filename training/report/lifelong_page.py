"""The page of maps that last, docs/results_lifelong.md."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from training.report.page import Column, figures, interval, number, table
from training.report.page import page as whole
from training.report.pictures import panels, save
from training.scoring.table import Table

_COLUMNS = (
    Column("ate_m", "Error, m", number),
    Column("joint_ate_m", "Error of all as one, m", number),
    Column("met", "Met at the end, %", number, 100.0),
    Column("in_time", "Met in time, %", number, 100.0),
    Column("scans_to_meeting", "Scans to meeting", number),
    Column("false_meetings", "False meetings, %", number, 100.0),
    Column("ms_a_step", "Computing time of a step, ms", number),
)

_INTRODUCTION = """# Results: several robots on one map

Made by `{command}`.

{settings[robots]} robots drive through each building at the same time, with {settings[scans]} scans of 360 rays each,
ten a second. There are {settings[buildings]} buildings as drawn, and {settings[aliased]} whose rooms look alike
(`aliased`), of the {settings[split]} split. These are few, so intervals of 95 %, by resampling buildings, are wide.

- `alone`: each robot has an `ngo_node` of its own. `together`: one for all, as with `robots` of `ngo_node`.
- Error: the root mean square distance of positions, each robot's trajectory aligned by itself, in the mean over robots;
  as one: of all robots that are in the common map, aligned together.
- Met in time: within 100 scans after two robots had 10 m of their way in common, a metre apart at most; scans from then
  on, where they met.
- False meetings: buildings in which a robot ever was more than 2 m from where the common map had it."""

_RATIO = "Error together over error alone, in the mean over buildings: {together}, and {aliased} in aliased ones."


_MOST_PANELS = 4


def draw(folder: Path, tables: Mapping[str, Table]) -> dict[str, str]:
    """Draw the first maps of all robots of a building; returns the file's name with its caption, if there are any."""
    all_met = [
        (name, rows["together"])
        for found in tables.values()
        for name, rows in found.items()
        if rows["together"].errors["met"].min() == 1.0 and "walls" in rows["together"].drawn
    ][:_MOST_PANELS]
    if not all_met:
        return {}
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
    save(figure, folder / "results_lifelong_fleet.png", dpi=90)
    return {"results_lifelong_fleet.png": "Maps of robots that have met: key scans (grey), and the way of each robot."}


def page(result: dict[str, Any], images: Mapping[str, str]) -> str:
    """The page of a JSON's content."""
    paired = result["paired"]
    ratio = _RATIO.format(
        together=interval(paired["together"]["ate_ratio"]), aliased=interval(paired["aliased_together"]["ate_ratio"])
    )
    rows = {f"`{row}`": numbers for row, numbers in result["tables"]["fleet"].items()}
    return whole([_INTRODUCTION.format(**result), table(rows, _COLUMNS, "Row"), ratio, *figures(images)])
