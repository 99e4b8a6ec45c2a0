"""The page of exploration, docs/results_explore.md."""

from collections.abc import Mapping
from typing import Any

from training.report.page import Column, figures, number, table
from training.report.page import page as whole

_COLUMNS = (
    Column("path_to_95_m", "Path to 95 %, m", number),
    Column("ratio", "by explore_lite's", number),
    Column("path_m", "Whole path, m", number),
    Column("coverage", "Seen at the end, %", number, 100.0),
    Column("ended_early", "Ended under 98 %, %", number, 100.0),
    Column("in_reach", "Seen of what is in reach at the end, %", number, 100.0),
    Column("in_reach_early", "Ended under 98 % of it, %", number, 100.0),
    Column("iou", "IoU of the map", number),
    Column("iou_true_poses", "IoU at true poses", number),
    Column("ate_m", "ATE at 95 %, m", number),
    Column("ate_end_m", "ATE at the end, m", number),
    Column("within", "Within three deviations, %", number, 100.0),
    Column("collisions", "Collisions a km", number),
    Column("decision_ms", "Decision, 99 %, ms", number),
)
_ROWS = {
    "random": "random",
    "nearest": "nearest frontier",
    "explore_lite": "explore_lite's rule",
    "d_optimality": "D-optimality of the graph",
    "known_tour": "tour on the known map",
    "ours": "**gain over distance (ours)**",
}
_INTRODUCTION = """# Results: exploration

One run a place and rule. Ours is the unknown area that a frontier shows by the way there. Robot, map, path follower and
limits are the same in all rows; explore_lite's has its own smallest frontier, pace and blacklist. Intervals are of
95 %, by resampling places; few places make them too narrow.

Coverage counts the free cells that exact rays see from all places where the robot can go; what a robot has seen is
entered at its true poses. Doors that may shut are shut for this, and fill their frames: what lies behind them does not
count. A robot may go in there, and the door may shut behind it. What is in reach at the end is what counts and can be
seen from where a way led then, by the leaves of all doors.

The ratio is the geometric mean over the places where both rules came to 95 %; a mean path is over those where its own
rule did, so that a rule which gives long places up has a short one. The tour on the known map is searched for
(insertion, 2-opt, or-opt, large neighbourhoods); the shortest one may be a little shorter.
In buildings of this size a lidar that sees 12 m drifts by millimetres, with wheels or without: the ATE tells no rules
apart. IoU is the mean of free and occupied cells of the robot's own map beside those exact rays, a map of own poses
aligned as for the ATE; at true poses it is that of the scans of the same path. Decisions are timed as processor
time."""
_KINDS = {
    "mazes": "Mazes",
    "buildings": "Buildings",
    "plans": "Floor plans",
    "good_wheels": "Buildings, good wheels",
    "slipping_wheels": "Buildings, slipping wheels",
    "no_wheels": "Buildings, no wheels",
    "short_range": "Buildings, no wheels, a lidar of 4 m",
}
_POSES = {
    "true": "The robot knows its **true poses**: no row says anything about the error of the estimator.",
    "own": "Poses and map are **those of the lidar's estimators**. ATE is of the trajectory as it was "
    "known then, after the best rigid alignment. A pose is within three deviations by its covariance "
    "when it was the newest.",
}


_MEASURED = """Written by `{command}`
at revision {revision}: {places} places, seeds of {split}{scaled}. {poses}"""


def page(result: Mapping[str, Any]) -> str:
    """The page of a JSON's content."""
    parts = [_INTRODUCTION]
    images: dict[str, str] = {}
    for kind in [kind for kind in _KINDS if kind in result["tables"]]:
        rows, shown, measured = result["tables"][kind], {}, result["measured"][kind]
        images |= result["images"][kind]
        for row, numbers in rows.items():
            ratio = result["paired"][kind].get(row, {}).get("path_to_95_ratio")
            shown[_ROWS[row]] = {**numbers, "ratio": ratio} if ratio else numbers
        poses = result["poses"][kind]
        columns = [column for column in _COLUMNS if any(column.cell(numbers) for numbers in shown.values())]
        if poses == "true":  # both maps are of the same path
            columns = [column for column in columns if column.key != "iou_true_poses"]
        settings, places = measured["settings"], result["places"][kind]
        scaled = "" if kind in ("mazes", "plans") else f", corridors of {settings['scale']:g} of the usual length"
        values = {**measured, **settings, "places": places, "scaled": scaled, "poses": _POSES[poses]}
        parts += [f"## {_KINDS[kind]}", _MEASURED.format(**values), table(shown, columns, "Rule")]
    return whole([*parts, *figures(images)])
