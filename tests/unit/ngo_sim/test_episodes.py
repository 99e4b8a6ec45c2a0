import numpy as np
import pytest

from ngo_sim.driver_choice import driver_generator, make_driver
from ngo_sim.episodes import record_episode
from ngo_sim.maze2d import Maze2D, Maze2DConfig


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


def test_the_same_seed_gives_the_same_bytes() -> None:
    env = Maze2D()
    first, other, again = (record_episode(env, "corners", 300, seed) for seed in (2, 3, 2))
    for name in ("observations", "actions", "poses_xyyaw"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
        assert getattr(first, name).tobytes() != getattr(other, name).tobytes()
