"""Estimated trajectories against the truth: everything that is reported about them, as JSON and as a table."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from rich.table import Table

from ngo_estimator.trajectory.errors import (
    ALIGNMENTS,
    KITTI_LENGTHS_M,
    Alignment,
    PoseErrors,
    RelativeDelta,
    Summary,
    absolute_errors,
    aligned,
    associate,
    path_length_m,
    relative_errors,
    segment_errors,
)
from ngo_estimator.trajectory.files import SpatialPoses

Report = dict[str, Any]

_ALIGNED = {"none": "not aligned", "first": "first pose aligned", "best": "best alignment"}


@dataclass(frozen=True)
class ReportSettings:
    """What is measured.

    ``tolerance_s``: how far apart in time an estimated and a true pose of one moment may be; ``delta``: between which
    poses the RPE is taken; ``segment_lengths_m``: of KITTI's segments.
    """

    tolerance_s: float = 0.01
    delta: RelativeDelta = field(default_factory=RelativeDelta)
    segment_lengths_m: tuple[float, ...] = KITTI_LENGTHS_M


def trajectory_report(estimate: SpatialPoses, truth: SpatialPoses, settings: ReportSettings | None = None) -> Report:
    """All errors of an estimate, of plain numbers; what cannot be measured is a text that says why.

    Keys: ``poses`` (that were compared), ``estimated_poses``, ``true_poses``, ``path_m`` (of the truth, there),
    ``final_percent`` (distance between the last positions in percent of it, first pose aligned), ``ate`` by alignment
    and ``rpe``, each with ``translation_m`` and ``rotation_deg``, and ``kitti``.

    Raises:
        ValueError: no pose of the two is of one moment, or the truth does not move.
    """
    settings = settings or ReportSettings()
    ours, true = associate(estimate, truth, settings.tolerance_s)
    length_m = path_length_m(true)
    if length_m <= 0.0:
        raise ValueError(f"the truth has no length in the {len(true)} poses compared; expected one that moves")
    first = absolute_errors(aligned(ours, true, "first"), true)
    return {
        "poses": len(ours),
        "estimated_poses": len(estimate),
        "true_poses": len(truth),
        "path_m": length_m,
        "final_percent": float(100.0 * first.translation_m[-1] / length_m),
        "ate": {how: _or_why(partial(_absolute, ours, true, how)) for how in ALIGNMENTS},
        "rpe": {
            "delta": settings.delta.size,
            "unit": settings.delta.unit,
            "all_pairs": settings.delta.all_pairs,
            **_or_why(lambda: relative_errors(ours, true, settings.delta)),
        },
        "kitti": _segments(ours, true, settings.segment_lengths_m),
    }


def report_table(title: str, reports: Mapping[str, Report], alignments: Sequence[Alignment] = ALIGNMENTS) -> Table:
    """One column for each estimate; of the ATE the rows of ``alignments``."""
    table = Table(title=title)
    table.add_column("")
    for name in reports:
        table.add_column(name, justify="right")
    for label, cell in _rows(next(iter(reports.values())), alignments):
        table.add_row(label, *(cell(report) for report in reports.values()))
    return table


def remarks(reports: Mapping[str, Report]) -> list[str]:
    """What could not be measured, and over how much of the estimates: a line each, without repetitions."""
    lines = []
    for name, report in reports.items():
        if (left := min(report["estimated_poses"], report["true_poses"]) - report["poses"]) > 0:
            lines.append(f"{name}: {left} poses have no partner in time")
        parts = {"ATE": report["ate"]["best"], "RPE": report["rpe"], "KITTI": report["kitti"]}
        lines += [f"{part}: {found['not_measured']}" for part, found in parts.items() if "not_measured" in found]
        missing = [length for length, count in report["kitti"].get("segments", {}).items() if count == 0]
        if missing:
            lines.append(f"KITTI: the path is too short for segments of {', '.join(missing)} m")
    return list(dict.fromkeys(lines))


def _absolute(ours: SpatialPoses, true: SpatialPoses, how: Alignment) -> PoseErrors:
    return absolute_errors(aligned(ours, true, how), true)


def _or_why(measure: Callable[[], PoseErrors]) -> dict[str, Any]:
    try:
        errors = measure()
    except ValueError as error:
        return {"not_measured": str(error)}
    return {
        "translation_m": dataclasses.asdict(Summary.of(errors.translation_m)),
        "rotation_deg": dataclasses.asdict(Summary.of(errors.rotation_deg)),
    }


def _segments(ours: SpatialPoses, true: SpatialPoses, lengths_m: tuple[float, ...]) -> dict[str, Any]:
    try:
        errors = segment_errors(ours, true, lengths_m)
    except ValueError as error:
        return {"not_measured": str(error)}
    return {
        "translation_percent": errors.translation_percent,
        "rotation_deg_per_m": errors.rotation_deg_per_m,
        "segments": {f"{length:g}": count for length, count in errors.segments.items()},
    }


def _rows(report: Report, alignments: Sequence[Alignment]) -> list[tuple[str, Any]]:
    """Label of each row, and what gives its cell."""

    def rmse(*keys: str) -> Any:
        def cell(of: Report) -> str:
            for key in keys[:-1]:
                of = of[key]
            return f"{of[keys[-1]]['rmse']:.4f}" if keys[-1] in of else "-"

        return cell

    rows: list[tuple[str, Any]] = [
        ("poses compared", lambda of: str(of["poses"])),
        ("true path, m", lambda of: f"{of['path_m']:.2f}"),
        ("final error, % of the path", lambda of: f"{of['final_percent']:.3f}"),
    ]
    for how in alignments:
        rows.append((f"ATE, RMSE, m ({_ALIGNED[how]})", rmse("ate", how, "translation_m")))
        rows.append((f"ATE, RMSE, deg ({_ALIGNED[how]})", rmse("ate", how, "rotation_deg")))
    size, unit = report["rpe"]["delta"], report["rpe"]["unit"]
    delta = f"{size:g} {unit.removesuffix('s') if size == 1 else unit}"
    rows.append((f"RPE over {delta}, RMSE, m", rmse("rpe", "translation_m")))
    rows.append((f"RPE over {delta}, RMSE, deg", rmse("rpe", "rotation_deg")))
    for key, unit in (("translation_percent", "%"), ("rotation_deg_per_m", "deg/m")):
        rows.append((f"{_kitti_title(report)}, {unit}", lambda of, key=key: _number(of["kitti"], key)))
    return rows


def _kitti_title(report: Report) -> str:
    used = [length for length, count in report["kitti"].get("segments", {}).items() if count]
    return f"KITTI segments of {', '.join(used)} m" if used else "KITTI segments"


def _number(values: Mapping[str, float], key: str) -> str:
    return f"{values[key]:.4f}" if key in values else "-"
