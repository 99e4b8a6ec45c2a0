"""The page of pose graphs with wrong loops, from the table's JSON."""

from typing import Any

import numpy as np

from training.report.page import interval, markdown

_HEAD = """# Pose graphs with wrong loops

Made by `{command}` at {revisions}. A graph counts as solved where its error (ATE after the best alignment) is below
1.5 times that of its right loops alone. Manhattan's truth is itself a solution, with its own loops: there an error
below 0.5 m counts as solved. Means are over so many graphs as the second table says, with intervals of 95 %. Times
are computing times, so that a busy machine does not change them. A peer that computes for longer than its limit is
stopped: it counts as not solved, and its error is that of the odometry. A cell's name is the kind of its wrong loops
and their percentage. `_place`: loops know no relative pose, only "the same place". All peers get the stated
covariances; those of Manhattan are far too large. Rows and cells that are missing were not measured: `--graphs`,
`--kinds`, `--percents`, `--seeds` and `--rows` measure a part. In `GRAPH_online` loops come in blocks of 120, in the
order of their later poses, and numbers are means over the blocks. There `robust` goes on from its last solution, and
`robust_anew` begins anew in each block; `changed` is the share of verdicts about known loops that changed. `hard_`
graphs have a poor odometry, and twice as many loops as `synthetic_` ones. A loop counts as believed where the poses
fit it within its stated threshold. `cheapest` is the share of graphs where the truncated cost of what was found is not
above that of the right loops' solution. A graph that is not solved there has a cheaper wrong solution: no search for a
lower cost would find the right one. Four designs of networks that judge loops or solutions were tried: one solves more
graphs, in 2 to 2.8 times the time ([notebook](notebook.md#pose-graphs-with-wrong-loops)).

| kind | wrong loops |
|---|---|
| random | between any two nodes |
| local | between nodes near each other along the chain |
| grouped | in groups of ten that agree with each other |
| lookalike | between stretches of fifty nodes that look alike |
| offset | right ones, shifted by 3 m, all in the same way, drawn with replacement: at 70 % each is there 2.6 times |
"""


def page(result: dict[str, Any]) -> str:
    """The page in Markdown."""
    known = (
        row.get("revision") for cells in result["tables"].values() for cell in cells.values() for row in cell.values()
    )
    revisions = list(dict.fromkeys(revision for revision in known if revision)) or [result["revision"]]
    said = ("revision " if len(revisions) == 1 else "revisions ") + ", ".join(revisions)
    parts = [_HEAD.format(command=result["command"], revisions=said)]
    for graph, cells in result["tables"].items():
        rows = list(dict.fromkeys(row for cell in cells.values() for row in cell))
        parts.append(f"## {graph}\n\nShare solved, and in brackets the mean error in metres:\n")
        parts.append(
            markdown(
                ("cell", *rows), [(name, *(_short(cell.get(row)) for row in rows)) for name, cell in cells.items()]
            )
            + "\n"
        )
        if len(cells) > 1:
            parts.append(f"{_over_cells(cells, rows)}\n")
        parts.append("Time in seconds, precision and recall of the loops that are believed:\n")
        keys = ["seconds", "precision", "recall"]
        keys += [
            key for key in ("cheapest", "changed") if any(key in row for of in cells.values() for row in of.values())
        ]
        lines = [
            (name, row, str(of.get("graphs", "")), *(interval(of[key]) if key in of else "" for key in keys))
            for name, cell in cells.items()
            for row, of in cell.items()
        ]
        parts.append(markdown(("cell", "row", "graphs", *keys), lines) + "\n")
    return "\n".join(parts).rstrip() + "\n"


def _short(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    stopped = row["stopped"]["mean"] if "stopped" in row else 0.0
    late = f"; {stopped:.2f} did not end in {row['limit_s']} s" if stopped > 0.0 else ""
    return f"{row['solved']['mean']:.2f} ({row['ate_m']['mean']:.2f}{late})"


def _over_cells(cells: dict[str, Any], rows: list[str]) -> str:
    """Mean share solved of each row over the cells where it was measured."""
    means = {row: [cell[row]["solved"]["mean"] for cell in cells.values() if row in cell] for row in rows}
    said = (
        f"{row} {np.mean(values):.2f}" + (f" ({len(values)} of {len(cells)} cells)" if len(values) < len(cells) else "")
        for row, values in means.items()
    )
    return f"Mean over cells: {', '.join(said)}."
