"""What the errors of changed logs must stay below."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from training.scoring.stress_cells import CLEAN

OURS = ("ours", "ours_without_wheels")
_HARM = 1.05


@dataclass(frozen=True)
class Bar:
    """Something that must be reached: ``value`` at most ``most``."""

    name: str
    value: float
    most: float

    @property
    def met(self) -> bool:
        """Whether it is reached."""
        return self.value <= self.most

    def as_json(self) -> dict[str, Any]:
        return {"name": self.name, "value": self.value, "at_most": self.most, "met": self.met}


StressLogs = Mapping[str, Mapping[str, Mapping[str, Mapping[str, Any]]]]  # ``LOG.CHANGE.ROW.KEY`` as in the JSON.

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
