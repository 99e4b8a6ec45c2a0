"""A table of trajectory errors on the terminal, and its means."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from training.scoring.metrics import TrajectoryError


def print_errors(title: str, errors: Mapping[str, Sequence[TrajectoryError]]) -> dict[str, dict[str, float]]:
    """Print a row for each estimate, mean and median of every error; returns ``ESTIMATE.ERROR`` of the means."""
    columns = [field.name for field in dataclasses.fields(TrajectoryError)]
    table = Table(title=f"{title}: mean (median)")
    for column in ("", *columns):
        table.add_column(column)
    means = {}
    for name, found in errors.items():
        values = np.array([dataclasses.astuple(error) for error in found])
        table.add_row(name, *(f"{m:.3f} ({d:.3f})" for m, d in zip(values.mean(0), np.median(values, 0), strict=True)))
        means[name] = {column: float(mean) for column, mean in zip(columns, values.mean(0), strict=True)}
    Console().print(table)
    return means
