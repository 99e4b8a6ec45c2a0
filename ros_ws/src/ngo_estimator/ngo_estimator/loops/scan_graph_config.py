"""Settings of the graph of key scans."""

import math
from dataclasses import dataclass, field

from ngo_estimator.loops.scan_loop_candidates import WindowConfig
from ngo_estimator.loops.scan_loop_config import ScanLoopConfig


@dataclass(frozen=True)
class ScanGraphConfig:
    """How key scans are optimised.

    An optimisation begins once ``keys_between`` key scans came since the last one, or at once where a new loop is
    ``surprise`` deviations off the graph and ``surprise_m`` at the walls. The Cauchy kernel that softens the covariance
    of the newest pose is ``kernel`` deviations wide. A loop is left out where a way through the graph joins its keys
    with at most ``redundant`` times its variance, unless it is that far off. Where the robot may be outside of the
    widest window, ``agreeing_beyond`` loops must agree with one. ``step_m`` and ``step_deg`` are deviations that are
    added to each step's covariance: registration in the same few key scans does not see them. About ``most_scans`` key
    scans are kept; where there are more, places that many of them show lose some. Their poses stay.
    """

    loops: ScanLoopConfig = field(default_factory=ScanLoopConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    keys_between: int = 8
    surprise: float = 3.0
    surprise_m: float = 0.06
    redundant: float = 15.0
    agreeing_beyond: int = 8
    kernel: float = 3.0
    step_m: float = 0.005
    step_deg: float = 0.15
    most_scans: int = 4000

    def __post_init__(self) -> None:
        if self.keys_between < 1 or self.most_scans < 100 or self.agreeing_beyond < 0:
            raise ValueError(
                f"keys_between, most_scans, agreeing_beyond are {self.keys_between}, {self.most_scans}, "
                f"{self.agreeing_beyond}; expected at least 1, 100 and 0"
            )
        positive = (self.surprise, self.surprise_m, self.redundant, self.kernel, self.step_m, self.step_deg)
        if not all(0.0 < value < math.inf for value in positive):
            raise ValueError(
                f"surprise, surprise_m, redundant, kernel, step_m, step_deg are {positive}; expected positive numbers"
            )
