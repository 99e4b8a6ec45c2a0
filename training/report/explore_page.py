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
    Column("iou", "IoU of the map", number),
    Column("collisions", "Collisions a km", number),
    Column("decision_ms", "Decision, 99 %, ms", number),
)
_ROWS = {
    "random": "random",
    "nearest": "nearest frontier",
    "explore_lite": "explore_lite's rule",
    "gain_distance": "gain over distance",
    "d_optimality": "D-optimality of the graph",
    "known_tour": "tour on the known map",
    "ours": "**tour over frontiers**",
}
_INTRODUCTION = """# Results: exploration

Written by `{command}`
at revision {revision}. {count} places of each kind, {split} seeds, one run each; drawn buildings have corridors of
{scale:g} of the usual length. The robot drives at **true poses**: no row says anything about the error of
the estimator. Robot, map, path follower and limits are the same in all rows; explore_lite's has its own
smallest frontier, pace and blacklist. Intervals are of 95 %, by resampling places; few places make them too narrow.

Coverage counts the free cells that exact rays see from all places where the robot can go. The ratio is the geometric
mean over the places where both rules came to 95 %. The tour on the known map is searched for (insertion, 2-opt, or-opt,
large neighbourhoods); the shortest one may be a little shorter.
IoU is the mean of free and occupied cells beside those exact rays. Decisions are timed as processor time."""


def page(result: Mapping[str, Any], images: Mapping[str, str]) -> str:
    """The page of a JSON's content."""
    parts = [_INTRODUCTION.format(**result, **result["settings"])]
    for kind, rows in result["tables"].items():
        shown = {}
        for row, numbers in rows.items():
            ratio = result["paired"][kind].get(row, {}).get("path_to_95_ratio")
            shown[_ROWS[row]] = {**numbers, "ratio": ratio} if ratio else numbers
        parts += [f"## {kind.capitalize()}", table(shown, _COLUMNS, "Rule")]
    return whole([*parts, *figures(images)])
