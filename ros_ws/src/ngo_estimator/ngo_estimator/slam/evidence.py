"""Hypotheses of one pose from several frames: which agree, and the pose that those which agree have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, flat, part, require, split, taken, under
from ngo_estimator.geometry.planar_covariance import propagate
from ngo_estimator.geometry.se2 import compose
from ngo_estimator.slam.sightings import Sightings

_DEVIATIONS = 3.0
"""Deviations up to which two hypotheses agree."""

_MOST_PLACES, _MOST_RAD = 0.4, math.radians(5.0)
"""They agree no farther than that from each other, in places, however uncertain they are."""

_FLOOR_PLACES, _FLOOR_RAD = 0.04, math.radians(0.5)
"""Errors of the map between two frames, beside the deviations."""

_APART = 3.0
"""Modes are so many times as far from each other as hypotheses that agree are at most."""

_MODES = 4
_REWEIGHTINGS = 3


@dataclass(frozen=True)
class Hypotheses:
    """Hypotheses of one pose: ``poses`` ``(n, 3)``, ``covariance`` ``(n, 3, 3)``, ``belief`` ``(n,)``, zero to one.

    ``look`` ``(n,)`` is the number of the frame that each comes from, ascending.
    """

    poses: np.ndarray
    covariance: np.ndarray
    belief: np.ndarray
    look: np.ndarray

    def where(self, which: np.ndarray) -> Hypotheses:
        """Some of them."""
        return Hypotheses(self.poses[which], self.covariance[which], self.belief[which], self.look[which])


@dataclass(frozen=True)
class Mode:
    """A pose ``(3,)`` that hypotheses agree on; ``support`` is the belief of the best of each look, summed."""

    pose_xyyaw: np.ndarray
    covariance: np.ndarray
    support: float
    looks: np.ndarray


class HypothesisWindow:
    """The sightings of the last frames at which the map was looked at, carried along with the robot."""

    def __init__(self, size: int) -> None:
        self._size = size
        self.clear()

    def clear(self) -> None:
        """Forget all sightings."""
        self._sightings: list[Sightings] = []
        # The newest frame seen from that of each look, its covariance, and the way since.
        self._since, self._covariance, self._way_m = np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)

    def __len__(self) -> int:
        return len(self._sightings)

    @property
    def sightings(self) -> list[Sightings]:
        """Those of each look, as they were then."""
        return self._sightings

    @property
    def way_m(self) -> np.ndarray:
        """Way since each look ``(looks,)``."""
        return self._way_m

    def map_sightings(self, mapped: Callable[[Sightings], Sightings]) -> None:
        """Put others in the place of the sightings of each look, as where the map was laid out anew."""
        self._sightings = [mapped(sightings) for sightings in self._sightings]

    def move(self, relative: np.ndarray, covariance: np.ndarray) -> None:
        """Carry the sightings over a step ``(3,)`` with its covariance ``(3, 3)``."""
        if not self._sightings:
            return
        self._since = compose(self._since, relative)
        self._covariance = propagate(self._covariance, self._since, relative, covariance)
        self._way_m = self._way_m + np.hypot(relative[0], relative[1])

    def add(self, sightings: Sightings) -> None:
        """Take the sightings of the newest frame."""
        drop = max(0, len(self._sightings) + 1 - self._size)
        self._sightings = [*self._sightings[drop:], sightings]
        self._since = np.concatenate((self._since[drop:], np.zeros((1, 3))))
        self._covariance = np.concatenate((self._covariance[drop:], np.zeros((1, 3, 3))))
        self._way_m = np.append(self._way_m[drop:], 0.0)

    def state(self) -> Arrays:
        """All looks, for ``restore``."""
        columns = {
            "poses": flat([s.poses for s in self._sightings], np.zeros((0, 3))),
            "covariance": flat([s.covariance for s in self._sightings], np.zeros((0, 3, 3))),
            "belief": flat([s.belief for s in self._sightings], np.zeros(0)),
        }
        arrays: Arrays = {"since": self._since.copy(), "since_covariance": self._covariance.copy()}
        arrays["way_m"] = self._way_m.copy()
        for name, column in columns.items():
            arrays |= under(name, column)
        return arrays

    def restore(self, arrays: Arrays) -> None:
        """Take a ``state()``, in place of what is here; raises ``StateError``."""
        shapes = {"poses": (3,), "covariance": (3, 3), "belief": ()}
        columns = [split(part(arrays, name), np.float64, *shape) for name, shape in shapes.items()]
        looks = len(columns[0])
        require(looks <= self._size, f"there are {looks} looks; expected at most {self._size}")
        same = all([len(x) for x in column] == [len(x) for x in columns[0]] for column in columns)
        require(same, "the sightings of a look have no pose, no covariance or no belief")
        self._sightings = [Sightings(*rows) for rows in zip(*columns, strict=True)]
        self._since = taken(arrays, "since", np.float64, looks, 3)
        self._covariance = taken(arrays, "since_covariance", np.float64, looks, 3, 3)
        self._way_m = taken(arrays, "way_m", np.float64, looks)

    def hypotheses(self) -> Hypotheses:
        """All sightings as poses of the newest frame."""
        look = np.repeat(np.arange(len(self)), [len(sightings) for sightings in self._sightings])
        columns = zip(*((s.poses, s.covariance, s.belief) for s in self._sightings), strict=True)
        poses, covariance, belief = (np.concatenate(column) for column in columns)
        since = self._since[look]
        poses = compose(poses, since)
        return Hypotheses(poses, propagate(covariance, poses, since, self._covariance[look]), belief, look)


def strongest_modes(hypotheses: Hypotheses, place_m: float) -> tuple[Mode, ...]:
    """The poses that most looks agree on, best first, each well apart from the better ones."""
    if len(hypotheses.poses) == 0:
        return ()
    at, variance = hypotheses.poses, _variances(hypotheses.covariance)
    distance, turn = _apart(at[:, None], at[None])
    agree = _agree(distance, turn, variance[:, None] + variance[None], place_m)
    by_look = _by_look(agree * hypotheses.belief, hypotheses.look)
    total = by_look.sum(-1)
    left = np.ones(len(at), bool)
    found: list[Mode] = []
    while len(found) < _MODES and left.any():
        best = int(np.where(left, total, -1.0).argmax())
        looks = np.unique(hypotheses.look[agree[best]])
        found.append(Mode(at[best], hypotheses.covariance[best], float(total[best]), looks))
        left &= _well_apart(distance[best], turn[best], place_m)
    return tuple(found)


def agreeing(hypotheses: Hypotheses, pose: np.ndarray, covariance: np.ndarray, place_m: float) -> np.ndarray:
    """Which hypotheses agree ``(n,)`` with a pose ``(3,)`` of a covariance ``(3, 3)``."""
    distance, turn = _apart(hypotheses.poses, pose)
    return _agree(distance, turn, _variances(hypotheses.covariance) + _variances(covariance), place_m)


def support(hypotheses: Hypotheses, which: np.ndarray) -> float:
    """The belief of the best of each look, of those in ``which`` ``(n,)``, summed."""
    if len(hypotheses.look) == 0:
        return 0.0
    return float(_by_look(which * hypotheses.belief, hypotheses.look).sum())


def fused(
    hypotheses: Hypotheses, pose: np.ndarray, covariance: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A pose ``(3,)`` and its covariance ``(3, 3)`` after hypotheses, robustly; without a covariance it is a guess.

    Hypotheses of one look err together: they count as one, looks as independent.
    """
    information = np.linalg.inv(hypotheses.covariance) * hypotheses.belief[:, None, None]
    information /= np.bincount(hypotheses.look)[hypotheses.look][:, None, None]
    prior = np.zeros((3, 3)) if covariance is None else np.linalg.inv(covariance)
    off = hypotheses.poses - pose
    off[:, 2] = _wrapped(off[:, 2])
    mean = np.zeros(3)
    for _ in range(_REWEIGHTINGS + 1):
        left = off - mean
        squared = np.einsum("ni,nij,nj->n", left, np.linalg.inv(hypotheses.covariance), left)
        weighted = information / (1.0 + squared / _DEVIATIONS**2)[:, None, None]
        total = prior + weighted.sum(0)
        mean = np.linalg.solve(total, (weighted @ off[..., None]).sum(0)[:, 0])
    result = pose + mean
    result[2] = _wrapped(result[2])
    return result, np.linalg.inv(total)


def _variances(covariance: np.ndarray) -> np.ndarray:
    """Variances of position (mean of both axes) and heading ``(..., 2)``."""
    diagonal = np.diagonal(covariance, axis1=-2, axis2=-1)
    return np.stack((0.5 * (diagonal[..., 0] + diagonal[..., 1]), diagonal[..., 2]), axis=-1)


def _apart(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    off = a - b
    return np.hypot(off[..., 0], off[..., 1]), np.abs(_wrapped(off[..., 2]))


def _well_apart(distance: np.ndarray, turn: np.ndarray, place_m: float) -> np.ndarray:
    apart: np.ndarray = (distance > _APART * _MOST_PLACES * place_m) | (turn > _APART * _MOST_RAD)
    return apart


def _agree(distance: np.ndarray, turn: np.ndarray, variance: np.ndarray, place_m: float) -> np.ndarray:
    reach = _DEVIATIONS * np.sqrt(variance)
    most_m = np.minimum(_FLOOR_PLACES * place_m + reach[..., 0], _MOST_PLACES * place_m)
    within: np.ndarray = (distance <= most_m) & (turn <= np.minimum(_FLOOR_RAD + reach[..., 1], _MOST_RAD))
    return within


def _by_look(belief: np.ndarray, look: np.ndarray) -> np.ndarray:
    """The largest value of each look ``(..., looks)`` of values ``(..., n)``."""
    first = np.flatnonzero(np.diff(look, prepend=-1))
    best: np.ndarray = np.maximum.reduceat(belief, first, axis=-1)
    return best


def _wrapped(angle: np.ndarray) -> np.ndarray:
    wrapped: np.ndarray = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped
