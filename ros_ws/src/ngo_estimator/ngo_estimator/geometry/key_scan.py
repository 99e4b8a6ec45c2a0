"""A scan as the estimator keeps it: points and surface normals, and the rays that free space is read from."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KeyScan:
    """One scan in the robot's base frame (m, rad).

    Attributes:
        stamp_ns: time of the base frame that the points are given in.
        points: ends of rays ``(n, 2)`` in the base frame, thinned, by increasing angle of the sensor.
        normals: unit normals of the surfaces at the points ``(n, 2)``, towards the sensor; zero where none is known.
        sensor_xyyaw: pose of the sensor ``(3,)`` in the base frame.
        angles: directions of the rays ``(m,)`` in the sensor's frame, counter-clockwise, increasing. A sensor that is
            mounted upside down has its angles mirrored already.
        ranges: ranges along them ``(m,)``; infinite where nothing came back, and NaN where nothing is known.
        max_range: range (m) beyond which the sensor sees nothing.
    """

    stamp_ns: int
    points: Array
    normals: Array
    sensor_xyyaw: Array
    angles: Array
    ranges: Array
    max_range: float

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 2 or self.normals.shape != self.points.shape:
            raise ValueError(
                f"points and normals have shapes {self.points.shape} and {self.normals.shape}; expected (n, 2) twice"
            )
        if self.angles.ndim != 1 or self.ranges.shape != self.angles.shape or self.sensor_xyyaw.shape != (3,):
            raise ValueError(
                f"angles, ranges and sensor_xyyaw have shapes {self.angles.shape}, {self.ranges.shape} and "
                f"{self.sensor_xyyaw.shape}; expected (m,), (m,) and (3,)"
            )
        if not (np.isfinite(self.points).all() and np.isfinite(self.normals).all()):
            raise ValueError("points or normals are not finite; expected finite numbers, and zero where no normal is")
        if not (np.isfinite(self.angles).all() and np.isfinite(self.sensor_xyyaw).all()):
            raise ValueError("angles or sensor_xyyaw are not finite; expected finite numbers")
        if not 0.0 < self.max_range < np.inf:
            raise ValueError(f"max_range is {self.max_range}; expected a positive, finite range")


def no_scan(stamp_ns: int) -> KeyScan:
    """A scan that saw nothing: it stands for one that is not known."""
    nothing = np.zeros(0)
    return KeyScan(stamp_ns, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(3), nothing, nothing, 1.0)
