"""The page of the table of faults, docs/results_faults.md."""

from typing import Any

from training.report.page import Column, markdown, short
from training.report.page import page as whole

_WORLDS = {"maze2d": "2D mazes", "maze3d": "3D mazes", "doom": "Doom's scenarios, with the weights of `maze3d`"}
_COLUMNS = (
    Column("unfamiliar", "Unfamiliar (%)", short, 100.0),
    Column("odometry_m", "Odometry RMSE (m)", short),
    Column("corrected_m", "Corrected RMSE (m)", short),
    Column("deviation_m", "Published deviation, median (m)", short),
    Column("within_odometry", "`odom` within 3 deviations (%)", short, 100.0),
    Column("within_published", "`ngo/pose` within 3 deviations (%)", short, 100.0),
)

_INTRODUCTION = """# Results: faults of the sensor, and worlds that the networks do not know

Written by `{command}` at revision {revision}, {split} split. {drives} drives of {frames} frames in each row, each in a
maze of its own or with a seed of its own. A fault begins after a quarter of the drive and stays.
[Faults](reference/faults.md) says how nodes tell them. Everything was chosen on validation mazes and other Doom
maps.

- **Within 3 deviations**: share of the poses, as they were published, whose x, y and heading are each within three of
  their own deviations of the truth. The bar is 95 %.
- **Corrected / odometry**: the largest ratio of the two position RMSE over the drives. The bar is 1.05.
- **Unfamiliar**: share of the frames with an unlikeness over 1.

Brackets hold 95 % intervals by resampling drives."""


def page(result: dict[str, Any]) -> str:
    """The page of a JSON's content."""
    parts = [_INTRODUCTION.format(**result)]
    for world, rows in result["tables"].items():
        parts.append(f"## {_WORLDS[world]}\n\n{_table(rows)}")
        if "clean" in rows:
            growth, odometry = (rows["clean"][key]["mean"] for key in ("deviation_growth", "odometry_deviation_growth"))
            parts.append(
                f"On clean drives deviations grow by {100.0 * (growth - 1.0):.1f} % (`ngo/pose`) and "
                f"{100.0 * (odometry - 1.0):.1f} % (`odom`), in the mean of the drives' medians. The bar is 20 %."
            )
    return whole(parts)


def _table(rows: dict[str, Any]) -> str:
    header = ["Drives", *(column.title for column in _COLUMNS), "Corrected / odometry, largest"]
    lines = (
        [name, *(column.cell(row) for column in _COLUMNS), f"{row['corrected_to_odometry']['largest']:.3f}"]
        for name, row in rows.items()
    )
    return markdown(header, lines)
