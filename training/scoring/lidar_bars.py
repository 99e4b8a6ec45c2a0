"""What the lidar's results must reach, on logs as they are and after changes, and whether they do."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from training.scoring.stress_cells import CLEAN
from training.scoring.table import Measured

Table = Mapping[str, Mapping[str, Measured]]
"""By the drive's name, then the row's."""

PUBLISHED: dict[str, dict[str, dict[str, float]]] = {
    "aces": {"cartographer_published": {"translation_m": 0.0375, "rotation_deg": 0.373}},
    "mit-csail": {"cartographer_published": {"translation_m": 0.0319, "rotation_deg": 0.369}},
}
"""By log and row, not run here: from Hess et al., "Real-time loop closure in 2D LIDAR SLAM" (ICRA 2016)."""

NETWORKS_POSITION_M: dict[str, float] = {
    "as drawn in training": 0.33,
    "noise 0 cm": 0.31,
    "noise 1 cm": 0.32,
    "noise 3 cm": 0.35,
    "noise 5 cm": 0.43,
    "dropouts 0 %": 0.30,
    "dropouts 5 %": 0.38,
    "dropouts 20 %": 2.24,
    "noise 5 cm, dropouts 20 %": 2.25,
    "field of view 180 deg": 1.31,
    "field of view 360 deg": 0.28,
    "range 4 m": 0.70,
    "maze2d": 0.25,
}
"""Mean position RMSE (m) of the networks of version 0.1.0 for each scanner, corrected: 8 mazes of 2000 frames."""

OURS = ("ours", "ours_without_wheels")
_HARM = 1.05
_ROUNDING = 1.0 + 1e-6


@dataclass(frozen=True)
class Bar:
    """Something that must be reached: ``value`` at most ``most``, or with ``least`` at least that."""

    name: str
    value: float
    most: float | None = None
    least: float | None = None

    @property
    def met(self) -> bool:
        """Whether it is reached."""
        return (self.most is None or self.value <= self.most) and (self.least is None or self.value >= self.least)

    def as_json(self) -> dict[str, Any]:
        limit = {"at_most": self.most} if self.least is None else {"at_least": self.least}
        return {"name": self.name, "value": self.value, **limit, "met": self.met}


def bars(tables: Mapping[str, Table], scanners: Mapping[str, Table]) -> list[Bar]:
    """All bars that the measured drives say something about; ``tables`` has ``logs`` among them where there are any."""
    logs = tables.get("logs", {})
    mazes = {f"{drive} {name}": rows for name, table in scanners.items() for drive, rows in table.items()}
    drives = {**tables, "scanners": mazes}
    mappers = {name: rows for name, rows in logs.items() if "ate_m" in _of(rows, "ours")}
    return [
        *_relation_bars(logs),
        *_mapper_bars(mappers),
        *_building_bars(tables),
        *_scanner_bars(tables.get("maze2d", {}), scanners),
        *_harm_bars(drives),
        *_covariance_bars(drives),
    ]


_RELATION_LIMITS: dict[tuple[str, str], dict[str, float]] = {
    ("aces", "ours"): {"translation_m": 0.0375, "rotation_deg": 0.373, "far_m": 0.06},
    ("aces", "ours_without_wheels"): {"translation_m": 0.549, "rotation_deg": 2.2},
    ("mit-csail", "ours"): {"translation_m": 0.0319, "rotation_deg": 0.369, "far_m": 0.055},
    ("mit-csail", "ours_without_wheels"): {"translation_m": 0.0319, "rotation_deg": 0.40},
}


def _relation_bars(logs: Table) -> Iterator[Bar]:
    for (log, row), limits in _RELATION_LIMITS.items():
        errors = _of(logs.get(log, {}), row)
        for key in (key for key in limits if key in errors):
            yield Bar(f"{log}, {row}: {key}", float(errors[key].mean()), most=limits[key])


def _mapper_bars(logs: Table) -> Iterator[Bar]:
    if not logs:
        return
    found = {name: float(_of(rows, "ours")["ate_m"][0]) for name, rows in logs.items()}
    yield Bar(
        f"median ate_m of {len(found)} logs with a mapper's poses", float(np.median(list(found.values()))), most=0.30
    )
    for name, value in found.items():
        if "ate_m" in (wheels := _of(logs[name], "wheels")):
            yield Bar(f"{name}: ate_m, at most that of raw odometry", value, most=float(wheels["ate_m"][0]))


def _building_bars(tables: Mapping[str, Table]) -> Iterator[Bar]:
    found = [
        float(errors["ate_m"][0]) for rows in tables.get("buildings", {}).values() if (errors := _of(rows, "ours"))
    ]
    if found:
        yield Bar(f"median ate_m of {len(found)} buildings", float(np.median(found)), most=0.10)
        yield Bar(f"worst ate_m of {len(found)} buildings", max(found), most=0.5)
    for name, rows in tables.get("aliased", {}).items():
        if errors := _of(rows, "ours"):
            most = float(errors["odometry_ate_m"][0]) * _ROUNDING
            yield Bar(f"{name}: ate_m, no worse than odometry", float(errors["ate_m"][0]), most=most)


def _scanner_bars(maze2d: Table, scanners: Mapping[str, Table]) -> Iterator[Bar]:
    for name, table in {"maze2d": maze2d, **scanners}.items():
        found = [
            errors["position_rmse_m"][0] for rows in table.values() if (errors := _of(rows, "ours_without_wheels"))
        ]
        if found:
            value = float(np.mean(found))
            yield Bar(f"scanner, {name}: mean position RMSE, m", value, most=NETWORKS_POSITION_M[name])


def _harm_bars(tables: Mapping[str, Table]) -> Iterator[Bar]:
    """The largest ratio of corrected to odometry in each table, beside the drive that has it."""
    for table, drives in tables.items():
        ratios = {
            f"{drive}, {row}": float(errors[key].mean() / errors[f"odometry_{key}"].mean())
            for drive, rows in drives.items()
            for row in OURS
            for errors in [_of(rows, row)]
            for key in ("translation_m", "ate_m")
            if key in errors
        }
        if ratios:
            worst = max(ratios, key=lambda name: ratios[name])
            yield Bar(f"{table}: corrected by odometry, worst of {len(ratios)} ({worst})", ratios[worst], most=_HARM)


def _covariance_bars(tables: Mapping[str, Table]) -> Iterator[Bar]:
    """The share over all drives of each table."""
    for table, drives in tables.items():
        for row in OURS:
            key = "within_three_deviations"
            found = [errors[key][0] for rows in drives.values() if key in (errors := _of(rows, row))]
            if found:
                yield Bar(f"{table}, {row}: truth within three deviations", float(np.mean(found)), least=0.95)


def _of(rows: Mapping[str, Measured], row: str) -> dict[str, np.ndarray]:
    return rows[row].errors if row in rows else {}


StressLogs = Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]]
"""``LOG.CHANGE.ROW.KEY`` as in the JSON."""

_TIMES_CLEAN = 1.3
_LESS_SEEN = {"noise_5cm": 1.6, "range_5m": 1.6, "quarter_of_rays": 1.6}
_METRES = {
    "no_scans_for_10s": ("at_scans_m", 0.06),
    "carried_while_paused": ("at_scans_m", 0.1),
    "half_covered": ("translation_m", 0.15),
    "people": ("translation_m", 0.15),
}
_TIMES_POSSIBLE = {"one_scan_in_ten": 2.0}
_WITHOUT_WHEELS = 2.0


def stress_bars(logs: StressLogs) -> Iterator[Bar]:
    """The bars of all rows of ours that are known: an error after each change, and no harm to the wheels' odometry.

    Most changes may cost 1.3 times the error without them. Without wheels an error may be twice as large.
    """
    for log, changes in logs.items():
        for change, rows in changes.items():
            for row in OURS:
                numbers, clean = rows.get(row, {}), changes.get(CLEAN, {}).get(row, {})
                if change == CLEAN or "translation_m" not in numbers or "translation_m" not in clean:
                    continue
                key, most = _limit(change, numbers, clean)
                if key in numbers:
                    most *= 1.0 if row == "ours" else _WITHOUT_WHEELS
                    yield Bar(f"{log}, {change}, {row}, {key}", numbers[key], most=most)
            ours_m, wheels_m = (rows.get(row, {}).get("translation_m") for row in ("ours", "wheels"))
            if ours_m is not None and wheels_m is not None:
                yield Bar(f"{log}, {change}, ours beside wheels", ours_m, most=_HARM * wheels_m)


def _limit(change: str, numbers: Mapping[str, float], clean: Mapping[str, float]) -> tuple[str, float]:
    if change in _METRES:
        return _METRES[change]
    if change in _TIMES_POSSIBLE:
        return "translation_m", _TIMES_POSSIBLE[change] * numbers["best_possible_m"]
    return "translation_m", _LESS_SEEN.get(change, _TIMES_CLEAN) * clean["translation_m"]
