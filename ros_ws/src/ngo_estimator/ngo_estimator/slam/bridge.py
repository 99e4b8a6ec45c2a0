"""The motion of a robot that nobody saw: from the end of one trajectory to where it was found again in its map."""

import math

import numpy as np

from ngo_estimator.geometry.planar_covariance import bounded, propagate
from ngo_estimator.geometry.planar_motion import between, turned_covariance

_MAP_PER_M, _MAP_RAD = 0.02, math.radians(1.0)
"""Deviations of the map between two places, a metre between them, and of its heading.

The loops behind the bridge are better than that. A bridge of a smaller deviation would keep the map from being bent by
loops that come later.
"""


def bridged(
    newest: np.ndarray, newest_covariance: np.ndarray, found: np.ndarray, found_covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pose ``(3,)`` found in the map, seen from the newest one, and its covariance ``(3, 3)``.

    Both poses are given in one frame, as their covariances are: the newest one's is that of the whole way to it, the
    found one's is against the map around it.
    """
    relative = between(newest, found)
    of_map = np.diag((*2 * (float(np.hypot(*relative[:2])) * _MAP_PER_M,), _MAP_RAD)) ** 2
    in_map = propagate(newest_covariance, found, relative, of_map) + found_covariance
    return relative, bounded(turned_covariance(-float(newest[2]), bounded(in_map)))
