"""A scan without its sweep's motion, and which of two registrations of it is right.

Not in the paper. The wheels tell how a robot moves during a sweep. Wheels that slip or freeze bend the scan, and the
bent scan fits the walls where it is turned. Then the velocity that the scans tell bends it back. Where nothing sweeps,
slipping wheels still lead the registration to a wrong place.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.line_map import LineMap
from ngo_estimator.geometry.planar_motion import Array, wrap
from ngo_estimator.geometry.scan_matching import IcpConfig, Registration
from ngo_estimator.geometry.scan_misfit import misfit


@dataclass(frozen=True, eq=False)
class SweptScan:
    """A scan with its sweep's motion removed: a base velocity of ``twist`` ``(3,)`` (m/s, m/s, rad/s), whose middle is
    ``middle_s`` after the stamp; zeros where nothing was removed."""

    scan: KeyScan
    middle_s: float = 0.0
    twist: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def middle(self) -> tuple[int, float]:
        """Time of the sweep's middle after the stamp (ns), and the turn until then (rad) that was removed."""
        return round(self.middle_s * 1e9), self.middle_s * float(self.twist[2])

    def velocity(self, step: Array, elapsed_s: float) -> Array:
        """The velocity ``(3,)`` that a step ``(3,)`` to this scan tells, registered ``elapsed_s`` after the last one.

        Points that were moved by another velocity lie off by its error until the sweep's middle, and so does the step.
        """
        result: Array = (step + self.middle_s * self.twist) / (elapsed_s + self.middle_s)
        return result

    def off(self, velocity: Array) -> Array:
        """How far ``(3,)`` the scan's pose is off where the robot moved with another ``velocity`` ``(3,)``."""
        result: Array = self.middle_s * (velocity - self.twist)
        return result


Registered = tuple[SweptScan, Registration]


def likelier(
    lines: LineMap, config: IcpConfig, first: Registered, second: Registered, rare: float = 0.0
) -> tuple[Registered, Array]:
    """The registration that fits the ``lines`` better, where the second is ``exp(rare)`` times as rare as the first.

    Returns:
        It, and the covariance ``(3, 3)`` that the pose has since the other one may be right.
    """
    squares = [
        misfit(lines, swept.scan.points, swept.scan.normals, found.pose, config) for swept, found in (first, second)
    ]
    independent = max(first[1].fitted, second[1].fitted) / config.correlation
    odds = 0.5 * independent * (squares[0] - squares[1]) / max(min(squares), config.noise_m**2) - rare
    apart = second[1].pose - first[1].pose
    apart[2] = wrap(apart[2])
    doubt = np.outer(apart, apart) / (1.0 + math.exp(min(abs(odds), 100.0)))
    return second if odds > 0.0 else first, doubt
