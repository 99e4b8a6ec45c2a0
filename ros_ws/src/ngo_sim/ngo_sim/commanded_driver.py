"""A robot in a building that drives as it is told, and stops at what it runs into."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numba import njit

from ngo_sim.building_drivers import TURN_RPS2, BuildingDriverConfig, arc_end
from ngo_sim.convex_shapes import Floats
from ngo_sim.lidar import CELL_M, RayWorld
from ngo_sim.velocity_command import VelocityCommand, VelocityLimits

_STEP_M = 0.01  # between two looks for a collision


class CommandedDriver:
    """Moves a disc by commands, one period after the other; it stops where it would touch walls, furniture or doors.

    pose_xyyaw: (3,) where it is. twist: (2,) speed in m/s and turn rate in rad/s of the last period. blocked: whether
    something stopped it in the last period.
    """

    def __init__(
        self,
        world: RayWorld,
        leaves_at: Callable[[float], Floats],
        config: BuildingDriverConfig,
        period_s: float,
        start_xyyaw: Floats,
    ) -> None:
        """leaves_at gives the door leaves (d, 4) at a time in s."""
        self._world, self._leaves_at, self._radius_m, self._period_s = world, leaves_at, config.radius_m, period_s
        limits = VelocityLimits(config.speed_mps, config.turn_rate_rps, config.acceleration_mps2, TURN_RPS2)
        self.command = VelocityCommand(limits, config.cmd_vel_timeout_s)
        self.pose_xyyaw = start_xyyaw
        self.twist = np.zeros(2)
        self.blocked = False
        self._time_s = 0.0

    def advance(self) -> Floats:
        """(2,) mean speed and turn rate with which the robot drives for one period; pose_xyyaw is then at its end."""
        wanted = self.command.next_twist(self.twist, self._period_s)
        share = self._free_share(wanted, self._leaves_at(self._time_s))
        self._time_s += self._period_s
        self.blocked = share < 1.0
        # It turns on where it stands: a disc touches nothing new by that.
        driven = np.array((share * wanted[0], wanted[1]))
        self.pose_xyyaw = arc_end(self.pose_xyyaw, driven[0], driven[1], self._period_s)
        self.twist = np.array((0.0 if self.blocked else wanted[0], wanted[1]))
        return driven

    def _free_share(self, twist: Floats, leaves: Floats) -> float:
        """How much of the period's way is free. What comes near already may come no nearer."""
        steps = math.ceil(abs(twist[0]) * self._period_s / _STEP_M)
        gap = self._gap(self.pose_xyyaw, leaves)
        for step in range(1, steps + 1):
            share = step / steps
            there = arc_end(self.pose_xyyaw, share * twist[0], twist[1], self._period_s)
            next_gap = self._gap(there, leaves)
            if next_gap < self._radius_m and next_gap < gap:
                return (step - 1) / steps
            gap = next_gap
        return 1.0

    def _gap(self, pose_xyyaw: Floats, leaves: Floats) -> float:
        return float(_nearest(pose_xyyaw[0], pose_xyyaw[1], self._world, leaves))


@njit(cache=True)
def _to_segment(x: float, y: float, segment: Floats) -> float:
    dx, dy = segment[2] - segment[0], segment[3] - segment[1]
    length2 = dx * dx + dy * dy
    along = 0.0 if length2 == 0.0 else ((x - segment[0]) * dx + (y - segment[1]) * dy) / length2
    along = min(max(along, 0.0), 1.0)
    return float(np.hypot(x - segment[0] - along * dx, y - segment[1] - along * dy))


@njit(cache=True)
def _nearest(x: float, y: float, world: RayWorld, leaves: Floats) -> float:
    """Distance to the nearest thing in this cell and those around it, infinite where there is none."""
    segments, circles, columns, low = world.segments_m, world.circles_m, world.columns, world.low_m
    col, row = int(np.floor((x - low[0]) / CELL_M)), int(np.floor((y - low[1]) / CELL_M))
    best = np.inf
    for r in range(max(0, row - 1), min(world.rows, row + 2)):
        for c in range(max(0, col - 1), min(columns, col + 2)):
            cell = r * columns + c
            for k in range(world.starts[cell], world.starts[cell + 1]):
                index = world.items[k]
                if index < len(segments):
                    best = min(best, _to_segment(x, y, segments[index]))
                elif index < len(segments) + len(circles):
                    circle = circles[index - len(segments)]
                    best = min(best, np.hypot(x - circle[0], y - circle[1]) - circle[2])
                else:
                    best = min(best, _to_segment(x, y, leaves[index - len(segments) - len(circles)]))
    return best
