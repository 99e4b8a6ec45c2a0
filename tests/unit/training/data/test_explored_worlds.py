"""What is in reach of a robot in a building whose doors open and shut."""

from dataclasses import replace

import numpy as np

from ngo_sim.floor_plans import FloorPlanConfig
from training.data.explored_worlds import Building
from training.scoring.exploring import Seen


def test_what_counts_is_in_reach_but_not_from_behind_a_door_while_it_is_shut() -> None:
    world = Building(12_000, FloorPlanConfig(scale=0.3, people=0))
    start = world.step(0.0, 0.0)
    seen = Seen(*world.exact_scans())
    assert world.in_reach(seen.poses).all() and seen.in_reach(world) is seen
    doors, times_s = world.plan.doors, np.arange(0.0, 3000.0, 10.0)
    opened = doors.opened_rad(times_s)
    door = np.flatnonzero(~doors.passable & (opened.max(axis=0) > 1.4) & (opened.min(axis=0) == 0.0))[0]
    yaw = doors.closed_rad[door] + doors.turn[door] * np.array((0.0, np.pi / 2))
    along, inwards = np.stack((np.cos(yaw), np.sin(yaw)), axis=-1)
    behind = doors.hinges_m[door] + 0.5 * doors.widths_m[door] * along + 1.2 * inwards

    def near(at: int) -> np.ndarray:
        world._sight = replace(start, time_s=float(times_s[at]), pose_xyyaw=np.array((*behind, 0.0)))
        return world.in_reach(seen.poses)

    assert near(int(np.argmax(opened[:, door]))).all()
    assert not near(int(np.argmin(opened[:, door]))).any()
    nothing = Seen([], np.zeros((0, 3)))
    assert seen.in_reach(world).coverage(nothing.map) == 1.0 and seen.coverage(nothing.map) == 0.0
