"""Episodes: frames, actions and drivers, and commands from outside."""

import math

import numpy as np
import pytest

from ngo_sim.driver_choice import driver_generator, make_driver
from ngo_sim.drivers import Action
from ngo_sim.episodes import record_episode
from ngo_sim.external_actions import ExternalActions
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.simulation import Simulation, body_twist, yaw_quaternion_zw


def test_is_what_an_episode_records() -> None:
    episode = record_episode(Maze2D(), "corners", frames=40, seed=3)
    simulation = Simulation(Maze2D(), seed=3, driver="corners")
    for index in range(40):
        frame = simulation.frame
        assert frame.index == index
        np.testing.assert_array_equal(frame.observation, episode.observations[index])
        np.testing.assert_array_equal(frame.pose_xyyaw, episode.poses_xyyaw[index])
        if index < 39:
            action = simulation.choose_action(0.0, 0.5, hold=True)
            assert action == episode.actions[index]
            simulation.advance(action)


def test_a_maze_of_another_seed_keeps_start_and_driver_of_the_seed() -> None:
    own, other, mixed = (Simulation(Maze2D(), *of) for of in ((3, "corners"), (8, "corners"), (3, "corners", 8)))
    assert (mixed.world.maze.walls == other.world.maze.walls).all()  # type: ignore[union-attr]
    assert (mixed.frame.pose_xyyaw == own.frame.pose_xyyaw).all()
    assert (mixed.frame.pose_xyyaw != other.frame.pose_xyyaw).any()


def test_auto_is_the_driver_that_the_world_names() -> None:
    runs = [Simulation(Maze2D(), seed=3, driver=driver) for driver in ("auto", "corners")]
    for _ in range(50):
        actions = [run.choose_action(0.0, 0.5, hold=True) for run in runs]
        assert actions[0] is not None and actions[0] == actions[1]
        for run in runs:
            run.advance(actions[0])


def test_without_a_driver_it_waits_for_actions() -> None:
    simulation = Simulation(Maze2D(), seed=3, driver="none")
    assert not simulation.ready(0.0, 0.5, hold=False)
    simulation.external.command(Action.TURN_LEFT, 0.0)
    assert simulation.ready(0.0, 0.5, hold=False)
    assert simulation.choose_action(0.0, 0.5, hold=False) is Action.TURN_LEFT
    assert not simulation.ready(0.0, 0.5, hold=False)


def test_actions_from_outside_come_before_the_driver() -> None:
    simulation = Simulation(Maze2D(), seed=3, driver="corners")
    simulation.external.command(Action.TURN_RIGHT, 0.0)
    chosen = [simulation.choose_action(0.1, 0.5, hold=True) for _ in range(5)]
    assert chosen == [Action.TURN_RIGHT] * 5
    assert simulation.ready(1.0, 0.5, hold=True)  # the driver again


@pytest.mark.parametrize("twist", [(1.0, 0.0, 0.0), (0.7, -0.2, 1.1), (0.4, 0.3, -2.0), (0.5, 0.1, 1e-9)])
def test_twist_leads_from_one_pose_to_the_other(twist: tuple[float, float, float]) -> None:
    start, period_s, parts = np.array([1.0, -2.0, 2.9]), 0.4, 20_000
    x, y, yaw = start
    for _ in range(parts):  # midpoint rule
        heading = yaw + twist[2] * period_s / parts / 2
        x += (twist[0] * math.cos(heading) - twist[1] * math.sin(heading)) * period_s / parts
        y += (twist[0] * math.sin(heading) + twist[1] * math.cos(heading)) * period_s / parts
        yaw += twist[2] * period_s / parts
    end = np.array([x, y, math.remainder(yaw, math.tau)])
    np.testing.assert_allclose(body_twist(start, end, period_s), twist, atol=1e-7)


def test_quaternion_of_a_turn() -> None:
    assert yaw_quaternion_zw(0.0) == (0.0, 1.0)
    np.testing.assert_allclose(yaw_quaternion_zw(math.pi / 2), [math.sqrt(0.5)] * 2)


def test_an_episode_has_the_worlds_shapes_and_types() -> None:
    env = Maze2D(Maze2DConfig(rows=3, cols=4, rays=61))
    episode = record_episode(env, "corners", 50, seed=7)
    assert (episode.observations.shape, episode.observations.dtype) == ((50, 61, 4), np.float32)
    assert (episode.actions.shape, episode.actions.dtype) == ((49,), np.uint8)
    assert (episode.poses_xyyaw.shape, episode.poses_xyyaw.dtype) == ((50, 3), np.float64)
    assert episode.period_s == 0.1
    env.reset(seed=7)
    np.testing.assert_array_equal(episode.maze.walls, env.maze.walls)


@pytest.mark.parametrize("driver", ["corners", "random_goals", "explorer", "random"])
def test_action_k_leads_from_frame_k_to_frame_k_plus_1(driver: str) -> None:
    episode = record_episode(Maze2D(), driver, 200, seed=1)
    env = Maze2D()
    observation, info = env.reset(seed=1)
    chooser = make_driver(driver, env.maze, driver_generator(1))
    for frame in range(200):
        np.testing.assert_array_equal(episode.observations[frame], observation)
        np.testing.assert_array_equal(episode.poses_xyyaw[frame], info["pose_xyyaw"])
        if frame < 199:
            assert episode.actions[frame] == chooser.action(info["pose_xyyaw"])
            observation, _, _, _, info = env.step(int(episode.actions[frame]))


TIMEOUT_S = 0.5


def test_is_not_in_charge_before_the_first_command_nor_after_the_timeout() -> None:
    external = ExternalActions()
    assert not external.in_charge(0.0, TIMEOUT_S, hold=True)
    external.command(Action.TURN_LEFT, 1.0)
    assert external.in_charge(1.49, TIMEOUT_S, hold=True)
    assert not external.in_charge(1.5, TIMEOUT_S, hold=True)
    assert external.next_action(hold=True) is None


def test_holds_the_newest_command_at_a_pace() -> None:
    external = ExternalActions()
    external.command(0, 0.0)
    external.command(2, 0.0)
    assert [external.next_action(hold=True) for _ in range(3)] == [Action.TURN_RIGHT] * 3
    external.command(1, 0.1)
    assert external.next_action(hold=True) is Action.TURN_LEFT


def test_uses_each_command_once_without_a_pace() -> None:
    external = ExternalActions()
    for action in (0, 1, 2):
        external.command(action, 0.0)
    taken = [external.next_action(hold=False) for _ in range(4)]
    assert taken == [Action.FORWARD, Action.TURN_LEFT, Action.TURN_RIGHT, None]
    assert external.in_charge(0.1, TIMEOUT_S, hold=False)  # waits for the next one
    assert not external.pending()


def test_without_a_pace_no_command_is_forgotten_while_others_are_slow() -> None:
    external = ExternalActions()
    external.command(1, 0.0)
    assert external.in_charge(100.0, TIMEOUT_S, hold=False)
    assert external.next_action(hold=False) is Action.TURN_LEFT
    assert not external.in_charge(100.0, TIMEOUT_S, hold=False)
