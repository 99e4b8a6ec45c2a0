"""Places to go back to before the robot's position gets too uncertain: it knows them better than where it would be."""

from __future__ import annotations

import math

import numpy as np

from ngo_explorer.known_map import Floats, KnownMap
from ngo_explorer.planner import cost_field, cost_m

_APART_M = 1.0


class Revisits:
    """Writes down how well the robot knew its position where, and how fast it comes to know it worse."""

    def __init__(self, limit_m: float) -> None:
        """limit_m: largest standard deviation of the position that a goal may have."""
        self._limit_m = limit_m
        self._points, self._variances = np.zeros((0, 2)), np.zeros(0)
        self._way_m = self._grown_m2 = 0.0
        self._last: tuple[Floats, float] | None = None

    def note(self, robot_xy: Floats, deviation_m: float) -> None:
        """The robot is here now, and its position has this deviation. What was known of places nearby is replaced."""
        variance = deviation_m**2
        if self._last is not None:
            point, before = self._last
            moved_m = float(np.hypot(*(robot_xy - point)))
            if moved_m < _APART_M:
                return
            self._way_m += moved_m
            self._grown_m2 += max(0.0, variance - before)
        self._last = np.array(robot_xy), variance
        far = np.hypot(*(self._points - robot_xy).T) >= _APART_M
        self._points = np.vstack((self._points[far], robot_xy))
        self._variances = np.append(self._variances[far], variance)

    def place(
        self, known: KnownMap, field: np.ndarray, goal_xy: Floats, way_m: float, deviation_m: float, need_m: float
    ) -> Floats | None:
        """Where to go before a goal ``(2,)``; None where the robot may go there straight, or nothing would help.

        The variance at the goal is predicted to be that at the robot, or at the place, and what a metre of the way
        added so far. The place is on the shortest detour that keeps the limit. field: costs from the robot. way_m: its
        way to the goal. need_m: clearance of the robot's middle.
        """
        a_metre_m2 = self._grown_m2 / max(self._way_m, _APART_M)
        if deviation_m**2 + a_metre_m2 * way_m <= self._limit_m**2 or not len(self._points):
            return None
        from_goal = cost_field(known, goal_xy, need_m)
        there = np.array([cost_m(known, field, point) for point in self._points])
        back = np.array([cost_m(known, from_goal, point) for point in self._points])
        detours = np.where(self._variances + a_metre_m2 * back <= self._limit_m**2, there + back, math.inf)
        best = int(np.argmin(detours))
        return self._points[best] if math.isfinite(detours[best]) else None
