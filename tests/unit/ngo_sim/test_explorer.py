import math

import numpy as np
import pytest

from ngo_sim.drivers import Action
from ngo_sim.episodes import record_episode
from ngo_sim.explorer import ExploringDriver
from ngo_sim.maze2d import Maze2D, Maze2DConfig

PICTURE = ("###########",
           "#         #",
           "# ####### #",
           "# #     # #",
           "# # ### # #",
           "# #   # # #",
           "# ##### # #",
           "#       # #",
           "######### #",
           "#         #",
           "###########")  # fmt: skip


class Robot:
    """A point with the 3D world's pace and inertia that stops at walls; blocks are 3 m."""

    def __init__(self, picture: tuple[str, ...], x: float, y: float) -> None:
        self._walls = np.array([[block == "#" for block in row] for row in picture])
        self.pose_xyyaw = np.array((x, y, 0.3))
        self._velocity, self._turn_rate = np.zeros(2), 0.0

    def step(self, action: Action) -> None:
        x, y, yaw = self.pose_xyyaw
        thrust = 0.06 * np.array((math.cos(yaw), math.sin(yaw))) * (action == Action.FORWARD)
        self._velocity = 0.88 * (self._velocity + thrust)
        for axis in (0, 1):  # along a wall it slides
            moved = np.array((x, y))
            moved[axis] += self._velocity[axis]
            if self._walls[int(moved[1] // 3), int(moved[0] // 3)]:
                self._velocity[axis] = 0.0
            else:
                x, y = moved
        self._turn_rate = 0.75 * self._turn_rate + math.radians((0.0, 2.2, -2.2)[action])
        self.pose_xyyaw = np.array((x, y, math.remainder(yaw + self._turn_rate, math.tau)))

    def block(self) -> tuple[int, int]:
        return int(self.pose_xyyaw[1] // 3), int(self.pose_xyyaw[0] // 3)


def explore(seed: int, steps: int) -> tuple[ExploringDriver, list[tuple[int, int]], list[Action]]:
    driver, robot = ExploringDriver(np.random.default_rng(seed)), Robot(PICTURE, 4.5, 4.5)
    blocks, actions = [robot.block()], []
    for _ in range(steps):
        actions.append(driver.action(robot.pose_xyyaw))
        robot.step(actions[-1])
        blocks.append(robot.block())
    return driver, blocks, actions


def test_it_gets_about_in_a_spiral_that_it_has_no_plan_of() -> None:
    free = sum(row.count(" ") for row in PICTURE)
    visited = [set(explore(seed, 6000)[1]) for seed in range(6)]
    assert min(map(len, visited)) > 0.5 * free
    assert np.mean([len(blocks) for blocks in visited]) > 0.7 * free
    assert len(set.union(*visited)) == free


def test_what_it_bumps_into_is_not_tried_again_at_once() -> None:
    """Held in place it tries one direction after the other."""
    driver, pose, headings = ExploringDriver(np.random.default_rng(1)), np.array((0.75, 0.75, 0.0)), []
    for _ in range(2000):
        action = driver.action(pose)
        if action == Action.FORWARD:
            headings.append(round(math.degrees(pose[2])) % 360)
        else:
            pose = pose + (0.0, 0.0, math.radians(4.0 if action == Action.TURN_LEFT else -4.0))
    assert len(set(headings)) >= 8
    assert len(driver.visited) == 1


@pytest.mark.parametrize("seed", [0, 1])
def test_it_covers_more_of_a_maze_than_chance(seed: int) -> None:
    env = Maze2D(Maze2DConfig())
    visited = {}
    for driver in ("explorer", "random"):
        episode = record_episode(env, driver, 2000, seed)
        assert episode.maze is not None
        visited[driver] = len({episode.maze.block_at(x, y) for x, y, _ in episode.poses_xyyaw})
    assert visited["explorer"] > 1.5 * visited["random"]
