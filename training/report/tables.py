"""The numbers of the results as one JSON object, from each trajectory's errors."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from training.data.worlds import World
from training.scoring.prefix_errors import stacked
from training.scoring.scores import METRICS
from training.scoring.statistics import compare, mean_interval
from training.scoring.table import Measured

Table = Mapping[str, Sequence[Measured]]  # The measurements of each row, one for each training seed.

PAIRS = (
    ("smoothed", "local"),
    ("local_no_action", "local"),
    ("deepvo", "local"),
    ("paper_5", "local"),
    ("gtsam", "local"),
    ("gauss_newton", "local"),
    ("ngo_1", "local"),
    ("ngo_5", "local"),
    ("ngo_5", "deepvo"),
    ("ngo_5", "smoothed"),
    ("ngo_5", "ngo_1"),
    ("ngo_5", "paper_5"),
    ("ngo_5", "gauss_newton"),
    ("ngo_5", "registered"),
    ("ngo_5", "gtsam"),
    ("ngo_5", "gtsam_registered"),
    ("ngo_5", "gtsam_smoothed"),
    ("end_to_end", "ngo_5"),
)
"""Rows that are compared on the same trajectories."""


def table_json(table: Table, prefixes: Sequence[int], steps: int, world: World) -> dict[str, Any]:
    """``ROW.METRIC.{mean, ci95, seeds}`` of whole trajectories, and ``ROW.prefixes.STEPS.METRIC.{mean, ci95}``."""
    return {
        row: {
            **_metrics(found, steps, world),
            "prefixes": {str(length): _metrics(found, length, world) for length in prefixes},
        }
        for row, found in table.items()
    }


def _metrics(row: Sequence[Measured], steps: int, world: World) -> dict[str, Any]:
    result: dict[str, Any] = {}
    for metric in METRICS[world.name]:
        values = stacked(row, steps, metric.key)
        result[metric.key] = mean_interval(values).as_json()
        if len(values) > 1:
            result[metric.key]["seeds"] = values.mean(axis=1).tolist()
    return result


def paired_json(table: Table, steps: int, world: World) -> dict[str, Any]:
    """``ROW_vs_OTHER.METRIC.{difference, relative_percent}`` of whole trajectories, for the pairs that are there."""
    return {
        f"{row}_vs_{other}": {
            metric.key: compare(
                stacked(table[row], steps, metric.key), stacked(table[other], steps, metric.key)
            ).as_json()
            for metric in METRICS[world.name]
        }
        for row, other in PAIRS
        if row in table and other in table
    }


def path_json(truth: np.ndarray, prefixes: Sequence[int]) -> dict[str, float]:
    """Mean length (m) of the path through true poses ``(trajectories, steps, 3)`` after so many steps."""
    xy = np.concatenate((np.zeros_like(truth[:, :1, :2]), truth[..., :2]), axis=1)
    path_m = np.linalg.norm(np.diff(xy, axis=1), axis=2).cumsum(axis=1).mean(axis=0)
    return {str(length): float(path_m[length - 1]) for length in prefixes}
