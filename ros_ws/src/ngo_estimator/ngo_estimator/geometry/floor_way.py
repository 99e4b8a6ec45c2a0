"""How far a camera went, from two pictures of the floor: the scale that two views do not tell.

A ray below the horizon meets the floor at a distance that the camera's height tells. Where heading and direction of the
motion are known, each corner tells how long the way is if it lies on the floor. Corners on the floor agree; those above
it tell longer ways, each its own.
"""

import math

import numpy as np

from ngo_estimator.geometry import se2

Array = np.ndarray

BELOW = math.sin(math.radians(3.0))
"""A ray that is steeper meets the floor near enough to tell a way."""

_AGREES = 2.0
"""Deviations within which ways agree."""

_ROUNDS = 4

_MANY = 0.7
"""Of the corners that agree on one way so many must agree on a shorter one to be the floor: nothing lies below it."""


def floor_way(
    first: Array, second: Array, std_rad: Array, height_m: float, yaw: float, axis: Array, least: int, share: float
) -> float | None:
    """The way (m) of a camera along an ``axis`` ``(2,)``, from rays ``(n, 3)`` in base axes to the same corners.

    Args:
        std_rad: deviations ``(n,)`` of where a corner is seen the second time.
        yaw: turn between the pictures.
        least: fewest corners on the floor; share: and how large a share they are of those below the horizon.

    Returns:
        None where fewer agree.
    """
    steepness = -np.maximum(first[:, 2], second[:, 2])
    below = np.flatnonzero(steepness > BELOW)
    if len(below) < least:
        return None
    before, after = (-height_m * rays[below, :2] / rays[below, 2:] for rays in (first, second))
    moved, std = before - se2.rotate(np.asarray(yaw), after), height_m * std_rad[below] / steepness[below] ** 2
    straight = np.abs(moved @ np.array((-axis[1], axis[0]))) < _AGREES * std
    ways, std = (moved @ axis)[straight], std[straight]
    agree = np.abs(ways[:, None] - ways) < _AGREES * std  # of each way, with which others
    votes = agree.sum(1)
    if len(votes) == 0 or votes.max() < max(least, share * len(below)):
        return None
    shortest = np.flatnonzero(votes >= _MANY * votes.max())
    within = agree[shortest[np.abs(ways[shortest]).argmin()]]
    for _ in range(_ROUNDS):
        way = float(np.average(ways[within], weights=std[within] ** -2.0))
        within = np.abs(ways - way) < _AGREES * std
    return way
