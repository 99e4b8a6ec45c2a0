"""The page of the table of relocalisation, docs/results_relocalisation.md."""

from typing import Any

from training.report.page import Column, markdown, short, table
from training.report.page import page as whole

_TITLES = {
    "ours": "ours (`mode:=localization`)",
    "nearest_code": "`nearest_code`: the pose of the most similar place code, from a similarity of 0.99 on",
    "particle_filter": "`particle_filter`: AMCL's model on the map's ranges, starting anywhere in free space",
    "oracle_place": "`oracle_place`: the truly nearest frame of the map is given, and measured",
}
"""The last two are no longer measured; they stay where the stored numbers have them."""
_COLUMNS = (
    Column("starts", "Starts", lambda value: f"{value:.0f}"),
    Column("success", "Success (%)", short, 100.0),
    Column("false_claims", "False claims (%)", short, 100.0),
    Column("frames_to_success", "Frames to success", short),
    Column("heading_rmse_deg", "Heading RMSE after (deg)", short),
)
_WORLDS = {
    "maze2d": "2D mazes",
    "maze3d": "3D mazes",
    "maze2d_aliased": "Aliased 2D mazes",
    "maze3d_aliased": "Aliased 3D mazes",
}


def page(result: dict[str, Any]) -> str:
    """The page of a JSON's content."""
    parts = [_INTRODUCTION.format(**result)]
    for name, rows in result["tables"].items():
        parts.append(f"## {_WORLDS[name]}\n\n{_map_line(result['maps'][name])}\n\n{_table(rows)}")
        if lines := _table({row: numbers for row, numbers in result["unmapped"][name].items() if len(numbers) > 1}):
            parts.append(f"Starts in parts that the map does not show, where silence is right:\n\n{lines}")
    if result["logs"]:
        parts.append(_LOGS.format(**result["logs"]) + "\n\n" + _log_table(result["logs"]["tables"]))
    return whole(parts)


_LOGS = """## Real logs of a lidar

Written by `{command}` at revision {revision}.

The first half of a drive is the map. The robot starts at {starts} places of the second half and drives up to 30 m. A
pose is right where the map of the whole drive has the robot (0.5 m, 5 deg): there is no better truth. A start counts
as mapped where 90 % of its first 10 m lie within 2 m of the map's way. From the others the robot may come to the map
later, or never. `aces`, `mit-csail`, `belgioioso`, `freiburg-101` and `seattle` served development."""


def _log_table(tables: dict[str, Any]) -> str:
    header = "Log", "Start", *_COUNTS.values(), "Way to a right claim, median (m)", "Processor time (s/m)"
    lines: list[list[object]] = []
    for log, kinds in tables.items():
        for kind, numbers in kinds.items():
            way = "" if numbers["way_to_success_m"] is None else f"{numbers['way_to_success_m']:.1f}"
            cost = "" if numbers["processor_s_per_m"] is None else f"{numbers['processor_s_per_m']:.2f}"
            lines.append([f"`{log}`", kind, *(numbers[name] for name in _COUNTS), way, cost])
    sums = [sum(kinds[kind][name] for kinds in tables.values() for kind in kinds) for name in _COUNTS]
    return markdown(header, [*lines, ["all", "", *sums, "", ""]])


_COUNTS = {"starts": "Starts", "right": "Right", "false_claims": "False claims"}

_INTRODUCTION = """# Relocalisation: kidnapped starts in a saved map

Written by `{command}` at revision {revision}, mazes of the {split} split. [Localise in a saved
map](how-to/localise_in_a_saved_map.md) says how to use it.

{mazes} mazes that nothing was trained or chosen on. One drive of 2000 frames in each makes the map, by the whole online
system. A robot starts at {starts} frames of another drive ({aliased_starts} in aliased mazes) with another start, other
noise and another driver. It knows the map and nothing else. Aliased mazes repeat one module of 2 x 2 cells with one
texture.

- **Success**: the first pose that is claimed is right (0.5 m, 5 deg), within 50 frames.
- **False claim**: the first pose that is claimed is wrong, however late.
- **Heading RMSE after**: of all claimed poses from a success on, up to frame 60.
- A pose is compared with the frames of the map that are truly within one place (0.5 m in 2D, 1 m in 3D) of the robot,
  and with the truth as seen from the map's first frame; the smallest error counts. A map has errors of its own. Where
  it is bent, two of its frames do not agree on where the robot is.
- A start counts as mapped where 90 % of its first 50 frames lie within two places of a frame of the map.

Brackets hold 95 % intervals by resampling mazes."""


def _map_line(maps: dict[str, Any]) -> str:
    position, heading = maps["position_rmse_m"]["mean"], maps["heading_rmse_deg"]["mean"]
    online = maps["online_heading_rmse_deg"]["mean"]
    return (
        f"Errors of the maps themselves, aligned at the first pose: position RMSE {position:.3g} m, heading RMSE "
        f"{heading:.3g} deg, {online:.3g} deg while they were made (SLAM)."
    )


def _table(rows: dict[str, Any]) -> str:
    if not rows:
        return ""
    counted = {
        _TITLES[row]: {**numbers, "starts": {**numbers["starts"], "ci95": None}} for row, numbers in rows.items()
    }
    return table(counted, _COLUMNS, "Row")
