"""The page of the table of changed logs, docs/results_stress.md."""

from typing import Any

from training.data.lidar_changes import CHANGES
from training.report.page import markdown
from training.report.page import page as whole

_ROWS = {
    "wheels": "wheels",
    "ours": "ours",
    "ours_without_wheels": "ours, without wheels",
    "kiss_icp": "KISS-ICP",
}

_INTRODUCTION = """# Results: what real robots do to their data

Written by `{command}` at revision {revision}. Each row of a table is a log after one change, which is made in memory
(`training/data/lidar_changes.py`). A cell is the mean translational error in m, and the mean rotational one in deg,
over the relations that people checked ([lidar](results_scan.md)), at the times when scans were really taken. It is the
mean over the seeds of a change; `±` is the half of the range between them. The JSON names the revision of each cell
that is of an earlier one.

- **At scans**: our error over the relations with a scan at both ends alone. Elsewhere poses are interpolated.
- **Best possible**: our own solution without the change, read at the scans that the change left.
- KISS-ICP has neither wheels nor loops."""


def page(result: dict[str, Any]) -> str:
    """The page of a JSON's content."""
    parts = [_INTRODUCTION.format(**result)]
    parts += [f"## {log}\n\n{_table(table)}" for log, table in result["logs"].items()]
    ablated = {log: text for log, table in result["logs"].items() if (text := _ablation(table))}
    if ablated:
        parts += [_ABLATION, *(f"### {log}\n\n{text}" for log, text in ablated.items())]
    if result["bars"]:
        parts.append("## Bars\n\n" + _bars(result["bars"]))
    parts += [_simulated(name, table) for name, table in result["tables"].items() if table]
    parts.append("## The changes\n\n" + _changes())
    return whole(parts)


_TABLES = {
    "buildings": """## Simulated buildings

150 m in each building, where the truth is known. Errors are those at the scans that the change left.
`within_three_deviations` is the share of the published poses whose x, y and heading are each within three of their own
deviations of the truth.""",
    "loops": """## Loops of poor wheels

1 km in each building. `largest_m` is the largest error with the first pose right. `last_loop_m` is the error of the
robot's position at the last loop, seen from where it was at the same place before.""",
    "joins": """## Wrong joins

Drives among rooms that look alike, drives that are put together from two buildings, and from two drives through the
same building. Numbers are means over the drives. A loop is wrong by more than 0.5 m or 5 deg. It is believed if its
weight in the graph is over one half. `lost_at_end` is the share of drives in whose end no loop tells where the robot is
in the map: right of two buildings, and wrong of the same one where the second drive meets the first.""",
    "car": """## A car's loop

There is no truth. The second visit is the last 20 m of the way. `metres` is how far it lies from where its scans fit
those of the first visit. `share` of its points have one of the first visit within 0.3 m there, `share_before` in the
map.""",
}


def _simulated(name: str, table: dict[str, Any]) -> str:
    keys = list(dict.fromkeys(key for rows in table.values() for row in rows.values() for key in row["each"]))
    head = ["Drives", "Row", "n", *keys]
    body = [
        [f"`{group}`", _ROWS.get(row, row), str(numbers["drives"]), *(_number(numbers, key) for key in keys)]
        for group, rows in table.items()
        for row, numbers in rows.items()
    ]
    return f"{_TABLES[name]}\n\n{markdown(head, body)}"


def _number(numbers: dict[str, Any], key: str) -> str:
    return f"{numbers[key]:.3g}" if key in numbers else ""


def _table(table: dict[str, Any]) -> str:
    head = ["Change", *_ROWS.values(), "at scans", "best possible"]
    body = []
    for change, rows in table.items():
        ours = rows.get("ours", {})
        cells = [_both(rows.get(row, {}), "translation_m", "rotation_deg") for row in _ROWS]
        cells += [_both(ours, "at_scans_m", "at_scans_deg"), _both(ours, "best_possible_m", "best_possible_deg")]
        body.append([f"`{change}`", *cells])
    return markdown(head, body)


_ABLATION = """## What each part of the front end brings

Errors (m, deg) without one part of it: a hypothesis of the motion, or a step. The first row has all of them."""


def _ablation(table: dict[str, Any]) -> str:
    ablated = {change: rows for change, rows in table.items() if any(row.startswith("without_") for row in rows)}
    names = dict.fromkeys(row for rows in ablated.values() for row in rows if row.startswith("without_"))
    if not names:
        return ""
    body = [
        [
            row.replace("_", " "),
            *(_both(rows.get(row, {}), "translation_m", "rotation_deg") for rows in ablated.values()),
        ]
        for row in ("ours", *names)
    ]
    return markdown(["", *(f"`{change}`" for change in ablated)], body)


def _both(numbers: dict[str, Any], metres: str, degrees: str) -> str:
    if "failed" in numbers:
        return "fails"
    if metres not in numbers:
        return ""
    values = [one[metres] for one in numbers["seeds"].values()]
    spread = f" ± {(max(values) - min(values)) / 2:.2g}" if len(values) > 1 else ""
    return f"{numbers[metres]:.3f}{spread} / {numbers[degrees]:.2f}"


def _bars(bars: list[dict[str, Any]]) -> str:
    missed = [bar for bar in bars if not bar["met"]]
    body = [[bar["name"], f"{bar['value']:.3f}", f"{bar['at_most']:.3f}"] for bar in missed]
    text = f"{len(bars) - len(missed)} of {len(bars)} are met. Missed are:"
    return f"{text}\n\n{markdown(['', 'error (m)', 'at most (m)'], body)}"


def _changes() -> str:
    rows = [[f"`{name}`", (change.__doc__ or "").strip()] for name, change in CHANGES.items()]
    return markdown(["Change", "What happens"], rows)
