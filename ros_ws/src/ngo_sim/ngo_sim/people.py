"""People who walk from room to room, as the two legs that a lidar sees: a function of time without any state."""

from __future__ import annotations

import numpy as np

from ngo_sim.convex_shapes import Floats
from ngo_sim.routes import RouteMap

_LEG_RADIUS_M = 0.07
_STEP_M = 0.7
_KEEP_OFF_M = 0.55


class People:
    """Each person walks a tour of some rooms over and over, with stops, and keeps 0.55 m off the robot."""

    def __init__(self, routes: RouteMap, count: int, rng: np.random.Generator) -> None:
        self.tours: list[tuple[Floats, Floats, float]] = []  # times (n,), points (n, 2), time at the beginning
        for _ in range(count):
            stops = routes.goals_m[rng.choice(len(routes.goals_m), min(4, len(routes.goals_m)), replace=False)]
            speed = rng.uniform(0.6, 1.5)
            times, points, now = [], [], 0.0
            for start, goal in zip(stops, np.roll(stops, -1, axis=0), strict=True):
                path = routes.path(start, goal)
                walked = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(path, axis=0).T)))) / speed
                times += [now + walked, np.array((now + walked[-1] + rng.uniform(1.0, 60.0),))]
                points += [path, path[-1:]]
                now = float(times[-1][-1]) + 1e-6
            self.tours.append((np.concatenate(times), np.concatenate(points), float(rng.uniform(0.0, now))))

    def circles(self, times_s: Floats, robot_xy: Floats) -> Floats:
        """(times, 2 people, 3) x, y, radius of all legs at some times, with the robot then at (times, 2)."""
        legs = np.zeros((len(times_s), 2 * len(self.tours), 3))
        legs[:, :, 2] = _LEG_RADIUS_M
        for person, (moments, points, phase) in enumerate(self.tours):
            at = (times_s + phase) % moments[-1]
            here, soon = (
                np.stack([np.interp(moment, moments, axis) for axis in points.T], axis=1) for moment in (at, at + 0.1)
            )
            away = here - robot_xy
            gap = np.hypot(*away.T)
            away = np.where(gap[:, None] > 1e-6, away / np.maximum(gap, 1e-6)[:, None], (1.0, 0.0))
            here = here + away * np.maximum(0.0, _KEEP_OFF_M - gap)[:, None]
            ahead = soon - np.stack([np.interp(at, moments, axis) for axis in points.T], axis=1)
            speed = np.hypot(*ahead.T)
            ahead = np.where(speed[:, None] > 1e-6, ahead / np.maximum(speed, 1e-6)[:, None], (1.0, 0.0))
            stride = np.where(speed > 1e-6, 0.18 * np.sin(np.pi * at / _STEP_M), 0.0)[:, None]
            side = 0.11 * np.stack((-ahead[:, 1], ahead[:, 0]), axis=1)
            legs[:, 2 * person, :2] = here + side + stride * ahead
            legs[:, 2 * person + 1, :2] = here - side - stride * ahead
        return legs
