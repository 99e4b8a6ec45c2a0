"""The errors of estimated trajectories against the truth, all of them TUM files."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from ngo_estimator.trajectory.files import SpatialPoses, read_tum
from ngo_estimator.trajectory.report import ReportSettings, remarks, report_table, trajectory_report


def evaluate_files(
    estimates: Sequence[Path], truth: Path, settings: ReportSettings | None = None
) -> dict[str, dict[str, Any]]:
    """Print one column for each estimate, and return its report by the file's name without its ending.

    The last line printed is all of it as one JSON object.

    Raises:
        ValueError: two estimates of one name, a file that is not TUM, or nothing in it that can be compared.
        OSError: a file cannot be read.
    """
    names = _names(estimates)
    true = read_tum(truth)
    reports = {}
    for name, path in zip(names, estimates, strict=True):
        estimate: SpatialPoses = read_tum(path)
        try:
            reports[name] = trajectory_report(estimate, true, settings)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
    console = Console()
    console.print(report_table(f"against {truth.name}", reports))
    for line in remarks(reports):
        console.print(line, soft_wrap=True, highlight=False)
    print(json.dumps(reports))
    return reports


def _names(estimates: Sequence[Path]) -> list[str]:
    """The files' names, with their folders where these alone tell them apart."""
    names = [path.stem for path in estimates]
    if len(set(names)) < len(names):
        names = [str(path.with_suffix("")) for path in estimates]
    if len(set(names)) < len(names):
        raise ValueError(f"estimates are {', '.join(map(str, estimates))}; expected each file once")
    return names
