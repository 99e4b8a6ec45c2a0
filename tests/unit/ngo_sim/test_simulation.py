import math

import numpy as np
import pytest

from ngo_sim.drivers import Action
from ngo_sim.episodes import record_episode
from ngo_sim.maze2d import Maze2D
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
