"""Where a map says that one frame is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep


@dataclass(frozen=True)
class Sightings:
    """Hypotheses of the pose of one frame in a map.

    ``poses`` ``(n, 3)`` (m, m, rad) with ``covariance`` ``(n, 3, 3)`` along the axes of the map, and ``belief``
    ``(n,)`` that each is right, zero to one.
    """

    poses: np.ndarray
    covariance: np.ndarray
    belief: np.ndarray

    def __len__(self) -> int:
        return len(self.poses)

    def where(self, which: np.ndarray) -> Sightings:
        """Some of them."""
        return Sightings(self.poses[which], self.covariance[which], self.belief[which])

    def and_also(self, others: Sightings) -> Sightings:
        """These and others of the same frame."""
        return Sightings(
            np.concatenate((self.poses, others.poses)),
            np.concatenate((self.covariance, others.covariance)),
            np.concatenate((self.belief, others.belief)),
        )

    @staticmethod
    def none() -> Sightings:
        """No hypothesis."""
        return Sightings(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))


class MapMatcher(Protocol):
    """Compares the newest frame with a map that stays as it is."""

    place_m: float
    """Distance of two frames that show one place."""
    look_m: float
    """Motion after which it is worth comparing another frame."""
    search_every: int
    """Where the pose is known, the whole map is asked at every so many looks: it may cost a lot."""

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        """Take the next frame and its pose ``(3,)`` by odometry; returns whether the map may be asked about it."""

    def everywhere(self) -> Sightings:
        """Hypotheses of the newest frame's pose, wherever it may be."""

    def around(self, expected: np.ndarray) -> Sightings:
        """Hypotheses of the newest frame's pose, which should be near ``expected`` ``(3,)``."""

    def is_clear(self, pose: np.ndarray) -> bool:
        """Whether one sighting is enough for a pose ``(3,)``, by what else is known of the way and the map."""

    def allows(self, pose: np.ndarray) -> bool:
        """Whether many sightings are enough for a pose ``(3,)``; else no number of them is."""

    def reset(self) -> None:
        """Forget all frames but those of the map."""


class SightingsAlone:
    """The part of a ``MapMatcher`` that knows nothing of a pose but its sightings."""

    def is_clear(self, pose: np.ndarray) -> bool:
        """One sighting is never enough."""
        return False

    def allows(self, pose: np.ndarray) -> bool:
        """Many sightings are enough."""
        return True
