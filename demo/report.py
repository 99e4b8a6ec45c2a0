"""Tables for people, and one JSON object on the last line for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

_ROWS = (
    ("position RMSE [m]", "position_rmse_m"),
    ("final error [% of the path]", "final_percent"),
    ("heading RMSE [deg]", "heading_rmse_deg"),
)


def result_table(result: dict[str, Any]) -> Table:
    """Odometry and corrected path against the truth."""
    table = Table(
        title=f"{result['world']}, seed {result['seed']}, {result['frames']} frames, {result['path_m']:.1f} m"
    )
    for name in ("against ground truth", "odometry", "corrected", "change"):
        table.add_column(name, justify="left" if name.startswith("against") else "right")
    for label, key in _ROWS:
        before, after = result["odometry"][key], result["corrected"][key]
        change = f"{100 * (after / before - 1):+.1f} %" if before > 0 else "-"
        table.add_row(escape(label), f"{before:.3f}", f"{after:.3f}", change)
    return table


def latency_table(latency: dict[str, float]) -> Table:
    """From the publication of an image to the receipt of the corrected path that holds its pose."""
    table = Table(
        title="Latency from image to corrected path",
        caption=(
            "From the publish call of an image in the simulator to the arrival, at the recorder, of the ngo/path "
            "message whose newest pose has its stamp. Times are those that DDS takes, all by the same clock; "
            "transport and both estimators are included."
        ),
    )
    for name in ("median", "p99", "largest", "frames"):
        table.add_column(name, justify="right")
    table.add_row(*(f"{latency[name]:.1f} ms" for name in ("median", "p99", "max")), str(int(latency["frames"])))
    return table


def summary_table(summary: dict[str, Any]) -> Table:
    """A row a maze, and the medians."""
    table = Table(
        title=f"{summary['world']}: {summary['wins']} of {summary['mazes']} mazes better, median RMSE "
        f"{summary['reduction_of_median_percent']:.1f} % lower",
        show_footer=True,
    )
    medians = summary["median_position_rmse_m"]
    for name, footer in (
        ("seed", "median"),
        ("path [m]", ""),
        ("odom. RMSE [m]", f"{medians['odometry']:.3f}"),
        ("corr. RMSE [m]", f"{medians['corrected']:.3f}"),
        ("change [%]", f"{-summary['median_reduction_percent']:+.1f}"),
        ("odom. end [%]", ""),
        ("corr. end [%]", ""),
        ("odom. head. [deg]", ""),
        ("corr. head. [deg]", ""),
    ):
        table.add_column(escape(name), footer=footer, justify="right")
    for result in summary["results"]:
        before, after = result["odometry"], result["corrected"]
        change = 100 * (after["position_rmse_m"] / before["position_rmse_m"] - 1)
        table.add_row(
            str(result["seed"]),
            f"{result['path_m']:.1f}",
            f"{before['position_rmse_m']:.3f}",
            f"{after['position_rmse_m']:.3f}",
            f"{change:+.1f}",
            f"{before['final_percent']:.2f}",
            f"{after['final_percent']:.2f}",
            f"{before['heading_rmse_deg']:.2f}",
            f"{after['heading_rmse_deg']:.2f}",
        )
    return table


def print_json(value: dict[str, Any], path: Path) -> None:
    """Print the value on one line, and write it to a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=2) + "\n")
    print(json.dumps(value), flush=True)
