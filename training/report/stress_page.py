"""The page of the table of changed logs, docs/results_stress.md."""

from typing import Any

from training.data.lidar_changes import CHANGES

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
mean over the seeds of a change; `±` is the half of the range between them.

- **At scans**: our error over the relations with a scan at both ends alone. Elsewhere poses are interpolated.
- **Best possible**: our own solution without the change, read at the scans that the change left.
- KISS-ICP has neither wheels nor loops."""


def page(result: dict[str, Any]) -> str:
    """The page of a JSON's content."""
    parts = [_INTRODUCTION.format(**result)]
    parts += [f"## {log}\n\n{_table(table)}" for log, table in result["logs"].items()]
    parts.append("## The changes\n\n" + _changes())
    return "\n\n".join(parts) + "\n"


def _table(table: dict[str, Any]) -> str:
    head = ["Change", *_ROWS.values(), "at scans", "best possible"]
    body = []
    for change, rows in table.items():
        ours = rows.get("ours", {})
        cells = [_both(rows.get(row, {}), "translation_m", "rotation_deg") for row in _ROWS]
        cells += [_both(ours, "at_scans_m", "at_scans_deg"), _both(ours, "best_possible_m", "best_possible_deg")]
        body.append([f"`{change}`", *cells])
    return _markdown([head, ["---"] * len(head), *body])


def _both(numbers: dict[str, Any], metres: str, degrees: str) -> str:
    if "failed" in numbers:
        return "fails"
    if metres not in numbers:
        return ""
    values = [one[metres] for one in numbers["seeds"].values()]
    spread = f" ± {(max(values) - min(values)) / 2:.2g}" if len(values) > 1 else ""
    return f"{numbers[metres]:.3f}{spread} / {numbers[degrees]:.2f}"


def _changes() -> str:
    rows = [[f"`{name}`", (change.__doc__ or "").strip()] for name, change in CHANGES.items()]
    return _markdown([["Change", "What happens"], ["---", "---"], *rows])


def _markdown(lines: list[list[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
