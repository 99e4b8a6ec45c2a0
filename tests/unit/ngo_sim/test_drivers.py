"""Drivers of simulated robots, with a plan of the maze and without one."""

import math

import numpy as np
import pytest

from ngo_sim.driver_choice import DRIVER_NAMES, driver_generator, make_driver
from ngo_sim.drivers import Action, PathDriver
from ngo_sim.episodes import record_episode
from ngo_sim.explorer import ExploringDriver
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.mazes import Maze, kruskal_maze


def maze_of(picture: str, block_m: float = 1.0) -> Maze:
    """A maze from its rows between bars: # is wall, the first is row 0."""
    return Maze(np.array([[block == "#" for block in row] for row in picture.split("|")]), block_m)


HOOK = maze_of("#######|#     #|##### #|#     #|#######")


class HeavyRobot:
    """A disc with the momentum of the 3D world: 3 m corridors, radius 0.5 m, w <- 0.75 w +- 2.2 degrees."""

    def __init__(self, maze: Maze, pose_xyyaw: np.ndarray) -> None:
        self.maze, self.pose_xyyaw = maze, pose_xyyaw
        self._velocity, self._turn_rate = np.zeros(2), 0.0
        self._lows = np.argwhere(maze.walls)[:, ::-1] * maze.block_m

    def step(self, action: Action) -> None:
        yaw = self.pose_xyyaw[2]
        thrust = 0.06 * np.array((math.cos(yaw), math.sin(yaw))) * (action == Action.FORWARD)
        before = self.pose_xyyaw[:2]
        position = before + 0.82 * (self._velocity + thrust)
        for _ in range(2):  # a corner pushes twice
            nearest = np.clip(position, self._lows, self._lows + self.maze.block_m)
            gaps = np.linalg.norm(position - nearest, axis=1)
            wall = gaps.argmin()
            if gaps[wall] < 0.5:
                position = nearest[wall] + (position - nearest[wall]) * 0.5 / gaps[wall]
        self._velocity = position - before
        self._turn_rate = 0.75 * self._turn_rate + math.radians((0.0, 2.2, -2.2)[action])
        self.pose_xyyaw = np.array((*position, math.remainder(yaw + self._turn_rate, math.tau)))


def drive(
    world: str, seed: int, steps: int, goals: str = "corners", random_action_probability: float = 0.05
) -> tuple[PathDriver, np.ndarray, np.ndarray]:
    """The driver, the poses (steps + 1, 3) and the actions (steps,) of one drive."""
    rng = np.random.default_rng(seed)
    if world == "2d":
        env = Maze2D(Maze2DConfig())
        pose, maze = env.reset(seed=seed)[1]["pose_xyyaw"], env.maze
    else:
        maze = kruskal_maze(5, 5, rng, extra_openings=2, block_m=3.0)
        start = np.array((*maze.block_center(rng.choice(maze.free_blocks())), rng.uniform(-3, 3)))
        robot = HeavyRobot(maze, start)
        pose = robot.pose_xyyaw
    driver = PathDriver(maze, rng, goals, random_action_probability=random_action_probability)
    poses, actions = [pose], []
    for _ in range(steps):
        actions.append(driver.action(pose))
        if world == "2d":
            pose = env.step(actions[-1])[4]["pose_xyyaw"]
        else:
            robot.step(actions[-1])
            pose = robot.pose_xyyaw
        poses.append(pose)
    return driver, np.array(poses), np.array(actions)


@pytest.mark.parametrize(("world", "steps"), [("2d", 1300), ("3d", 1300)])
def test_all_four_corners_are_visited(world: str, steps: int) -> None:
    for seed in range(4):
        driver, poses, _ = drive(world, seed, steps)
        maze = driver.maze
        blocks = {maze.block_at(x, y) for x, y, _ in poses}
        assert {tuple(map(int, corner)) for corner in maze.corners()} <= blocks
        assert set(driver.goals_reached) <= blocks


@pytest.mark.parametrize("world", ["2d", "3d"])
def test_momentum_does_not_make_it_turn_to_and_fro(world: str) -> None:
    for seed in range(3):
        _, _, actions = drive(world, seed, 800, random_action_probability=0.0)
        turned_back = actions[1:] * actions[:-1] == Action.TURN_LEFT * Action.TURN_RIGHT
        assert turned_back.mean() < 0.01
        assert (actions == Action.FORWARD).mean() > 0.4


@pytest.mark.parametrize("world", ["2d", "3d"])
@pytest.mark.parametrize("random_action_probability", [0.0, 0.05, 0.5])
@pytest.mark.parametrize("goals", ["corners", "random"])
def test_it_never_gets_stuck(world: str, random_action_probability: float, goals: str) -> None:
    for seed in range(3):
        driver, poses, _ = drive(world, seed, 600, goals, random_action_probability)
        windows = np.lib.stride_tricks.sliding_window_view(poses[:, :2], 80, axis=0)
        extent = (windows.max(axis=-1) - windows.min(axis=-1)).max(axis=-1) / driver.maze.block_m
        assert extent.min() > 0.5, "half a block in any 80 steps"


def test_corners_come_in_rounds_of_four_and_never_twice_in_a_row() -> None:
    maze = HOOK
    driver = PathDriver(maze, np.random.default_rng(0))
    centers = {tuple(map(int, corner)): maze.block_center(corner) for corner in maze.corners()}
    for _ in range(200):  # a robot that appears on its next corner at once
        for center in centers.values():
            driver.action(np.array((*center, 0.0)))
    goals = driver.goals_reached
    assert len(goals) > 100
    assert all(first != second for first, second in zip(goals[:-1], goals[1:], strict=True))
    assert all(set(goals[start : start + 4]) == set(centers) for start in range(0, len(goals) - 3, 4))
    assert len({tuple(goals[start : start + 4]) for start in range(0, len(goals) - 3, 4)}) > 5


def test_without_progress_it_heads_for_the_centre_of_its_block() -> None:
    driver = PathDriver(HOOK, np.random.default_rng(0), random_action_probability=0.0)
    # Held at the upper edge of a corridor along x, looking at the block's centre: the way on is to one side.
    held = np.array((3.5, 3.75, -math.pi / 2))
    actions = [driver.action(held) for _ in range(60)]
    assert Action.FORWARD not in actions[:40]
    assert Action.FORWARD in actions[40:]


def test_path_driver_replaces_the_share_of_actions_it_is_told_to() -> None:
    def actions(probability: float) -> np.ndarray:
        driver = PathDriver(HOOK, np.random.default_rng(0), random_action_probability=probability)
        return np.array([driver.action(np.array((1.3, 1.5, 1.0))) for _ in range(4000)])

    np.testing.assert_allclose(np.bincount(actions(1.0), minlength=3) / 4000, 1 / 3, atol=0.03)
    usual = np.bincount(actions(0.0), minlength=3).argmax()
    assert (actions(0.0)[:40] == usual).all()
    assert (actions(0.3)[:40] != usual).any()


@pytest.mark.parametrize("name", [name for name in DRIVER_NAMES if name != "learned"])
def test_a_driver_is_a_function_of_its_generator_and_the_poses(name: str) -> None:
    poses = drive("2d", 0, 200)[1]
    env = Maze2D()
    env.reset(seed=0)

    def actions(seed: int) -> list[Action]:
        driver = make_driver(name, env.maze, driver_generator(seed))
        return [driver.action(pose) for pose in poses]

    assert actions(0) == actions(0) != actions(1)
    assert all(isinstance(action, Action) for action in actions(0))


SPIRAL = maze_of(
    "###########|#         #|# ####### #|# #     # #|# # ### # #|# #   # # #|# ##### # #|#       # #|######### #|"
    "#         #|###########",
    block_m=3.0,
)


def explored(seed: int) -> set[tuple[int, int]]:
    """The blocks of the spiral that an explorer gets to."""
    driver, robot = ExploringDriver(np.random.default_rng(seed)), HeavyRobot(SPIRAL, np.array((4.5, 4.5, 0.3)))
    blocks = set()
    for _ in range(6000):
        robot.step(driver.action(robot.pose_xyyaw))
        blocks.add(SPIRAL.block_at(*robot.pose_xyyaw[:2]))
    return blocks


def test_it_gets_about_in_a_spiral_that_it_has_no_plan_of() -> None:
    free = int((~SPIRAL.walls).sum())
    visited = [explored(seed) for seed in range(6)]
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
