"""Where the ranges in a relative pose are: in the key scans of a lidar, or behind its place codes."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ngo_estimator.data.lidar_file import is_lidar
from ngo_estimator.data.relative_step import RejectedStep, RelativeStep, check_step
from ngo_estimator.mapping.range_scan import Array, RangeScan, range_scan

if TYPE_CHECKING:
    from ngo_estimator.geometry.scan_registration import RegistrationConfig

Stamped = tuple[int, RangeScan]

_SURE_M = 0.15  # Ranges are used as far as their deviation stays below this, where no largest range is given.


class ScanSource(Protocol):
    """Finds the scans in relative poses."""

    def scans(self, step: RelativeStep) -> list[Stamped]:
        """The scans in a step with their stamps; raises ``RejectedStep`` for ranges that cannot be used."""


@dataclass(frozen=True)
class KeyScans:
    """The key scans of a lidar, up to ``max_range_m``; 0: as far as the lidar sees."""

    max_range_m: float = 0.0

    def scans(self, step: RelativeStep) -> list[Stamped]:
        """The key scan, and the first scan of all."""
        if step.origin_scan is None and step.key is None:
            return []
        check_step(step, 0, None)
        keys = [step.origin_scan, step.key.scan if step.key is not None else None]
        return [
            (scan.stamp_ns, range_scan(scan.angles, scan.ranges, scan.sensor_xyyaw, self._limit(scan.max_range)))
            for scan in keys
            if scan is not None
        ]

    def _limit(self, of_sensor_m: float) -> float:
        return min(self.max_range_m or math.inf, of_sensor_m)


@dataclass(frozen=True, eq=False)
class CodeRanges:
    """The ranges behind the ``code_size`` learned numbers of place codes, at ``angles`` ``(rays,)`` of the base."""

    code_size: int
    angles: Array
    max_range_m: float

    @classmethod
    def of(cls, code_size: int, registration: "RegistrationConfig", max_range_m: float = 0.0) -> "CodeRanges":
        """Of codes with this registration; with ``max_range_m`` 0 as far as their ranges are sure."""
        sure_m = math.inf
        if registration.noise_share:
            sure_m = max(0.0, _SURE_M - registration.noise_m) / registration.noise_share
        angles = registration.angles_rad.numpy().astype(np.float64)
        return cls(code_size, angles, max_range_m or min(sure_m, 1e4))

    def scans(self, step: RelativeStep) -> list[Stamped]:
        """The ranges of the newer frame, and those of the older one where they are there."""
        codes = [(step.stamp_ns, step.place_code)]
        if step.from_place_code is not None:
            codes.insert(0, (step.from_stamp_ns, step.from_place_code))
        return [(stamp, self._scan(code)) for stamp, code in codes]

    def _scan(self, code: np.ndarray) -> RangeScan:
        expected = self.code_size + len(self.angles)
        if code.shape != (expected,):
            raise RejectedStep(f"place_code has {code.size} numbers; expected {expected}")
        ranges = code[self.code_size :].astype(np.float64)
        return range_scan(self.angles, ranges, np.zeros(3), self.max_range_m)


def scan_source(weights: Path, world: str | None = None, max_range_m: float = 0.0) -> ScanSource | None:
    """The source of scans for the relative poses of a folder of weights; None where these hold no ranges.

    Args:
        weights: a lidar's settings, or networks; the place codes of most hold ranges.
        max_range_m: rays count up to it; 0: as far as the sensor is sure.

    Raises:
        ValueError: of one line, about weights that cannot be read.
    """
    if is_lidar(weights):
        return KeyScans(max_range_m)
    # Imported here because torch takes seconds, and a lidar needs none.
    from ngo_estimator.checkpoint import PLACE
    from ngo_estimator.data.configuration import config_from_dict
    from ngo_estimator.data.weights_file import load_description
    from ngo_estimator.networks.place_encoder import PlaceConfig

    description = load_description(weights / f"{PLACE}.safetensors", PLACE, world)
    config = config_from_dict(PlaceConfig, description.get("config"))
    if config.registration is None:
        return None
    return CodeRanges.of(config.code_size, config.registration, max_range_m)
