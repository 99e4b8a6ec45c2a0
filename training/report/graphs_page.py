"""The page of pose graphs with wrong loops, from the table's JSON."""

from typing import Any

import numpy as np

from training.report.graphs_figure import CAPTION
from training.report.page import markdown

_HEAD = """# Pose graphs with wrong loops

Made by `{command}` at {revisions}.

{summary}

`peer solves more` counts cells in which some peer solves a larger share. There is no learned row:
[four networks were tried](explanation/learned_correctors.md), and none ships. How to read the tables:

- **Solved** is a graph whose error (ATE after the best alignment) is below 1.5 times that of its right loops alone.
  Manhattan's truth is itself a solution, with its own loops: there an error below 0.5 m counts as solved.
- A **cell**'s name is the kind of its wrong loops and their percentage. `_place`: loops know no relative pose, only
  "the same place". `hard_` graphs have a poor odometry, and twice as many loops as `synthetic_` ones.
- **Seconds** are computing time, so that a busy machine does not change them. A peer that computes for longer than
  its limit (30 or 60 s) is stopped: it counts as not solved, and its error is that of the odometry.
- A loop is **believed** where the poses fit it within its stated threshold. All peers get the stated covariances;
  those of Manhattan are far too large.
- **Cheapest** is the share of graphs where the truncated cost of what was found is not above that of the right loops'
  solution. A graph that is not solved there has a cheaper wrong solution: no search for a lower cost would find the
  right one.
- In `GRAPH_online` loops come in blocks of 120, in the order of their later poses, and numbers are means over the
  blocks. There `robust` goes on from its last solution, and `robust_anew` begins anew in each block; `changed` is the
  share of verdicts about known loops that changed.
- Rows and cells that are missing were not measured: `--graphs`, `--kinds`, `--percents`, `--seeds` and `--rows`
  measure a part. `graphs.json` has each number of each cell, with intervals of 95 % and how many graphs there were:
  slow peers have one of Manhattan, not three.

| kind | wrong loops |
|---|---|
| random | between any two nodes |
| local | between nodes near each other along the chain |
| grouped | in groups of ten that agree with each other |
| lookalike | between stretches of fifty nodes that look alike |
| offset | right ones, shifted by 3 m, all in the same way, drawn with replacement: at 70 % each is there 2.6 times |
"""

_OWN = ("odometry", "right_loops", "robust", "robust_anew")
"""Rows that are no peers."""

_MEANS = ("solved", "seconds", "precision", "recall", "cheapest", "changed")


def page(result: dict[str, Any]) -> str:
    """The page in Markdown."""
    known = (
        row.get("revision") for cells in result["tables"].values() for cell in cells.values() for row in cell.values()
    )
    revisions = list(dict.fromkeys(revision for revision in known if revision)) or [result["revision"]]
    said = ("revision " if len(revisions) == 1 else "revisions ") + ", ".join(revisions)
    parts = [_HEAD.format(command=result["command"], revisions=said, summary=_summary(result["tables"]))]
    for graph, cells in result["tables"].items():
        rows = list(dict.fromkeys(row for cell in cells.values() for row in cell))
        parts.append(f"## {graph}\n\nShare solved, and in brackets the mean error in metres:\n")
        parts.append(
            markdown(
                ("cell", *rows), [(name, *(_short(cell.get(row)) for row in rows)) for name, cell in cells.items()]
            )
            + "\n"
        )
        parts.append(_over_cells(cells, rows) + "\n")
        both = [cell for cell in cells.values() if {"gtsam_gnc", "robust"} <= cell.keys()]
        if graph.endswith("_online") and both:
            error, seconds = (
                np.divide(*(np.mean([cell[row][key]["mean"] for cell in both]) for row in ("robust", "gtsam_gnc")))
                for key in ("ate_m", "seconds")
            )
            share = f"{error:.2f} of the error of GNC in the mean over the blocks, in {seconds:.3f} of its time"
            parts.append(f"`robust` has {share}.\n")
        if graph in result.get("pictures", {}):
            name, cell = result["pictures"][graph]
            parts.append(f"`{cell}`: {CAPTION}\n\n![Verdicts about the loops of {graph} as they come](images/{name})\n")
    return "\n".join(parts).rstrip() + "\n"


def _summary(tables: dict[str, Any]) -> str:
    """A line a graph: ours beside the right loops, and beside the peers cell by cell."""
    lines = []
    for graph, table in tables.items():
        cells = [cell for cell in table.values() if "robust" in cell]
        if not cells:
            continue
        of = {
            (row, key): f"{np.mean([cell[row][key]['mean'] for cell in cells]):.3g}"
            for row in ("robust", "right_loops")
            for key in ("solved", "ate_m", "seconds")
        }
        peers = [(cell["robust"], [cell[row] for row in cell if row not in _OWN]) for cell in cells]
        better = [any(peer["solved"]["mean"] > ours["solved"]["mean"] for peer in them) for ours, them in peers if them]
        lines.append(
            (
                graph,
                str(len(cells)),
                *(of["robust", key] for key in ("solved", "ate_m", "seconds")),
                of["right_loops", "ate_m"],
                f"{sum(better)} of {len(better)}" if better else "",
            )
        )
    columns = ("graph", "cells", "solved", "ATE, m", "seconds", "right loops' ATE, m", "peer solves more")
    return markdown(columns, lines)


def _short(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    stopped = row["stopped"]["mean"] if "stopped" in row else 0.0
    late = f", {stopped:.0%} stopped" if stopped > 0.0 else ""
    return f"{row['solved']['mean']:.2f} ({row['ate_m']['mean']:.2f}{late})"


def _over_cells(cells: dict[str, Any], rows: list[str]) -> str:
    """A table of what each row has in the mean over the cells where it was measured."""
    keys = [key for key in _MEANS if any(key in of for cell in cells.values() for of in cell.values())]
    lines = []
    for row in rows:
        measured = [cell[row] for cell in cells.values() if row in cell]
        means = [[of[key]["mean"] for of in measured if key in of] for key in keys]
        lines.append((row, str(len(measured)), *(f"{np.mean(values):.3g}" if values else "" for values in means)))
    return markdown(("mean over cells", "cells", *keys), lines)
