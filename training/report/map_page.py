"""The page of the maps, docs/results_map.md."""

from typing import Any

from training.report.page import Column, markdown, number
from training.report.page import page as whole

_COLUMNS = Column("free_iou", "Free cells, IoU", number), Column("occupied_iou", "Occupied cells, IoU", number)

_INTRODUCTION = """# Maps

Made by `{command}`. Intervals are of 95 %, by resampling mazes.

Intersection over union of the map's cells with all cells that exact rays from the true poses see: free
cells, and cells that a wall's surface crosses. {mazes} mazes a world, of the {split}
split, {frames} frames each, cells of 0.05 m, all poses seen from the first one."""


def page(result: dict[str, Any]) -> str:
    """The page of a JSON's content."""
    header = ["World", "Poses", *(column.title for column in _COLUMNS)]
    mazes = (
        [f"`{world}`", row, *(column.cell(numbers) for column in _COLUMNS)]
        for world, rows in result["tables"].items()
        for row, numbers in rows.items()
    )
    return whole([_INTRODUCTION.format(**result), markdown(header, mazes)])
