import hashlib
import math
import os
import subprocess
import sys
import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ngo_sim.drivers import Action
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.mazes import Maze

# Two straight corridors, free for x in [1, 12] and y in [1, 2] or [3, 4], joined at x in [3, 4].
CORRIDOR = Maze(
    np.array(
        [
            [block == "#" for block in row]
            for row in ("#############", "#           #", "### #########", "#           #", "#############")
        ]
    )
)
CORRIDOR_CONFIG = Maze2DConfig(rows=2, cols=6, actuation_noise=0.0)
FORWARD, LEFT, RIGHT = Action.FORWARD, Action.TURN_LEFT, Action.TURN_RIGHT


def in_corridor(
    x: float, y: float, yaw_deg: float, config: Maze2DConfig = CORRIDOR_CONFIG
) -> tuple[Maze2D, np.ndarray, dict[str, Any]]:
    env = Maze2D(config)
    options = {"maze": CORRIDOR, "pose_xyyaw": (x, y, math.radians(yaw_deg))}
    return env, *env.reset(seed=0, options=options)


def gap_to_walls(maze: Maze, x: float, y: float) -> float:
    """Distance from a point to the nearest wall block."""
    lows = np.argwhere(maze.walls)[:, ::-1] * maze.block_m
    return float(np.linalg.norm(np.clip((x, y), lows, lows + maze.block_m) - (x, y), axis=1).min())


def reference_scan(env: Maze2D, pose_xyyaw: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depths (rays,), colours (rays, 3), which are unambiguous: each ray against each wall block (slabs)."""
    x, y, yaw = pose_xyyaw
    angles = yaw + np.radians(np.linspace(150.0, -150.0, 241))
    direction = np.stack((np.cos(angles), np.sin(angles)), axis=-1)[:, None]
    blocks = np.argwhere(env.maze.walls)
    lows = blocks[:, ::-1] * env.maze.block_m - (x, y)
    with np.errstate(divide="ignore"):
        enter, leave = lows[None] / direction, (lows[None] + env.maze.block_m) / direction
    first = np.minimum(enter, leave).max(axis=-1)
    last = np.maximum(enter, leave).min(axis=-1)
    depth = np.where((first <= last + 1e-12) & (first >= 0), first, np.inf)
    order = np.argsort(depth, axis=1)
    nearest = np.take_along_axis(depth, order[:, :2], axis=1)
    colors = env.colors[tuple(blocks[order[:, 0]].T)]
    return nearest[:, 0], colors, nearest[:, 1] - nearest[:, 0] > 1e-9


def test_observations_show_what_is_at_the_true_pose() -> None:
    env = Maze2D(Maze2DConfig(extra_openings=4))
    rng = np.random.default_rng(0)
    for seed in range(3):
        observation, info = env.reset(seed=seed)
        for _ in range(60):
            depth, colors, clear = reference_scan(env, info["pose_xyyaw"])
            np.testing.assert_allclose(observation[:, 3], depth, rtol=2e-7, atol=1e-7)
            assert clear.mean() > 0.95
            np.testing.assert_array_equal(observation[clear, :3], colors[clear])
            for _ in range(5):
                observation, _, _, _, info = env.step(int(rng.choice(3, p=(0.7, 0.2, 0.1))))


def test_depths_of_known_walls() -> None:
    _, observation, _ = in_corridor(4.5, 3.3, 0.0)
    depth = observation[:, 3]
    assert depth[120] == np.float32(7.5), "straight ahead is the end of the corridor at x = 12"
    for ray, angle_deg in ((48, 90.0), (64, 70.0), (24, 120.0)):
        assert depth[ray] == pytest.approx(0.7 / math.sin(math.radians(angle_deg))), "left: the wall at y = 4"
    for ray, angle_deg in ((192, 90.0), (176, 70.0), (240 - 24, 120.0)):
        assert depth[ray] == pytest.approx(0.3 / math.sin(math.radians(angle_deg))), "right: wall at y = 3"


def test_the_first_ray_is_the_leftmost() -> None:
    env, observation, _ = in_corridor(6.5, 1.5, 90.0)
    np.testing.assert_allclose(np.degrees(env.ray_angles_rad[[0, 120, 240]]), (150.0, 0.0, -150.0))
    np.testing.assert_allclose(np.diff(np.degrees(env.ray_angles_rad)), -1.25)
    # Facing +y in the corridor along x: left is -x with its end at x = 1, right is +x with its end at x = 12.
    assert observation[48, 3] == np.float32(5.5) and observation[192, 3] == np.float32(5.5)
    np.testing.assert_array_equal(observation[48, :3], env.colors[1, 0])
    np.testing.assert_array_equal(observation[192, :3], env.colors[1, 12])


def test_forward_speed_follows_its_recurrence_to_24_cm_a_step() -> None:
    env, _, info = in_corridor(1.5, 3.5, 0.0)
    x, speed = 1.5, 0.0
    for step in range(30):
        speed = 0.8 * (speed + 0.06)
        x += speed
        _, reward, _, _, info = env.step(FORWARD)
        np.testing.assert_allclose(info["pose_xyyaw"], (x, 3.5, 0.0), atol=1e-12)
        assert reward == pytest.approx(speed)
        assert info["time_s"] == pytest.approx(0.1 * (step + 1))
    assert speed == pytest.approx(0.24, rel=0.01)
    _, coasting, _, _, _ = env.step(LEFT)
    assert coasting == pytest.approx(0.8 * speed), "a turn gives no thrust"


@pytest.mark.parametrize(("action", "sign"), [(LEFT, 1), (RIGHT, -1)])
def test_turn_rate_follows_its_recurrence_to_9_degrees_a_step(action: Action, sign: int) -> None:
    env, _, info = in_corridor(1.5, 3.5, 0.0)
    yaw, rate = 0.0, 0.0
    for _ in range(60):
        rate = 0.6 * (rate + sign * 6.0)
        yaw += rate
        _, reward, _, _, info = env.step(action)
        error = math.remainder(info["pose_xyyaw"][2] - math.radians(yaw), math.tau)
        assert error == pytest.approx(0.0, abs=1e-12)
        assert abs(info["pose_xyyaw"][2]) <= math.pi
        assert reward == 0.0
    assert rate == pytest.approx(9.0 * sign)


def test_the_body_slides_along_a_wall_with_what_is_left_of_its_thrust() -> None:
    env, _, info = in_corridor(1.5, 3.5, 45.0)
    for _ in range(30):
        _, reward, _, _, info = env.step(FORWARD)
        assert info["pose_xyyaw"][1] <= 4.0 - 0.2 + 2e-6
    assert info["pose_xyyaw"][1] == pytest.approx(4.0 - 0.2, abs=2e-6)
    assert reward == pytest.approx(0.24 * math.cos(math.radians(45.0)), rel=0.01), "no friction"
    assert info["pose_xyyaw"][2] == pytest.approx(math.radians(45.0), abs=1e-12), "a wall does not turn it"


@pytest.mark.parametrize(
    "config",
    [
        Maze2DConfig(),
        Maze2DConfig(actuation_noise=1.0),
        Maze2DConfig(thrust_m=0.3, extra_openings=10),
        Maze2DConfig(block_m=3.0, radius_m=0.5, thrust_m=0.2),
        Maze2DConfig(radius_m=0.45),
        Maze2DConfig(radius_m=0.05),
    ],
)
def test_the_body_never_enters_a_wall(config: Maze2DConfig) -> None:
    env = Maze2D(config)
    rng = np.random.default_rng(0)
    closest = math.inf
    for seed in range(3):
        _, info = env.reset(seed=seed)
        for action in rng.choice(3, 700, p=(0.8, 0.1, 0.1)).tolist():
            _, _, _, _, info = env.step(action)
            closest = min(closest, gap_to_walls(env.maze, *info["pose_xyyaw"][:2]))
    assert config.radius_m - 1e-5 <= closest <= config.radius_m + 1e-5, "it touched, and did not enter"


def test_actuation_noise_scales_accelerations_by_its_standard_deviation() -> None:
    env, _, info = in_corridor(1.5, 3.5, 0.0, Maze2DConfig(rows=2, cols=6, actuation_noise=0.1))
    yaws = [info["pose_xyyaw"][2]]
    for _ in range(3000):
        yaws.append(env.step(LEFT)[4]["pose_xyyaw"][2])
    rates = np.remainder(np.diff(yaws), math.tau)
    strength = np.degrees(rates[1:] / 0.6 - rates[:-1]) / 6.0
    assert strength.mean() == pytest.approx(1.0, abs=0.01)
    assert strength.std() == pytest.approx(0.1, rel=0.05)


def digest(seed: int, env: Maze2D) -> str:
    """Everything that 300 steps of one seed show, as one hash."""
    observation, info = env.reset(seed=seed)
    seen = hashlib.sha256(env.maze.walls.tobytes() + env.colors.tobytes())
    for action in np.random.default_rng(1).choice(3, 300, p=(0.8, 0.1, 0.1)).tolist():
        seen.update(observation.tobytes() + info["pose_xyyaw"].tobytes())
        observation, reward, _, _, info = env.step(action)
        seen.update(str(reward).encode())
    return seen.hexdigest()


def test_a_seed_gives_the_same_bytes_whatever_came_before() -> None:
    env = Maze2D()
    first, other, again = (digest(seed, env) for seed in (3, 4, 3))
    assert first == again == digest(3, Maze2D())
    assert first != other
    result = subprocess.run(
        [sys.executable, __file__],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert result.stdout.strip() == first


def test_an_option_replaces_what_is_drawn_and_nothing_else() -> None:
    env = Maze2D()
    _, drawn = env.reset(seed=5)
    maze, colors = env.maze, env.colors
    _, info = env.reset(seed=5, options={"pose_xyyaw": (1.5, 1.5, 4.0)})
    np.testing.assert_allclose(info["pose_xyyaw"], (1.5, 1.5, 4.0 - math.tau))
    np.testing.assert_array_equal(env.maze.walls, maze.walls)
    np.testing.assert_array_equal(env.colors, colors)
    _, again = env.reset(seed=5, options={"maze": maze})
    np.testing.assert_array_equal(again["pose_xyyaw"], drawn["pose_xyyaw"])


def test_the_environment_checker_has_nothing_to_say() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(Maze2D(), skip_render_check=True)


if __name__ == "__main__":  # run by test_a_seed_gives_the_same_bytes_whatever_came_before
    print(digest(3, Maze2D()))


def test_a_maze_seed_takes_maze_and_colours_of_another_seed_and_nothing_else() -> None:
    env, other = Maze2D(Maze2DConfig(rows=4, cols=4)), Maze2D(Maze2DConfig(rows=4, cols=4))
    env.reset(seed=3)
    _, own = env.reset(seed=5)
    other.reset(seed=3)
    walls, colors = other.maze.walls, other.colors
    _, info = env.reset(seed=5, options={"maze_seed": 3})
    assert (env.maze.walls == walls).all() and (env.colors == colors).all()
    assert (info["pose_xyyaw"] == own["pose_xyyaw"]).all()


def test_an_aliased_maze_has_one_colour() -> None:
    env = Maze2D(Maze2DConfig(rows=4, cols=6, aliased=True))
    env.reset(seed=1)
    assert env.maze.walls.shape == (9, 13) and (env.colors == env.colors[0, 0]).all()
    with pytest.raises(ValueError, match="an aliased maze has multiples of 2"):
        Maze2DConfig(rows=5, aliased=True)
