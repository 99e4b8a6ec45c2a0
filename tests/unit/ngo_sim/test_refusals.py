"""What a caller gives wrongly is refused, with its value and what is expected."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ngo_sim.building2d import Building2d
from ngo_sim.driver_choice import make_driver
from ngo_sim.drivers import PathDriver
from ngo_sim.episodes import record_episode
from ngo_sim.floor_plans import draw_floor_plan
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.mazes import Maze, kruskal_maze
from ngo_sim.policy_network import load_policy
from ngo_sim.velocity_command import VelocityCommand, VelocityLimits

RNG = np.random.default_rng(0)
SMALL = Maze(np.pad(np.zeros((3, 3), dtype=bool), 1, constant_values=True), block_m=1.0)


def ready() -> Maze2D:
    env = Maze2D()
    env.reset(seed=0)
    return env


@pytest.mark.parametrize(
    ("refused", "words"),
    [
        (lambda: Maze2DConfig(rows=1), "rows.* is 1; .*an integer from 2 to 100"),
        (lambda: Maze2DConfig(extra_openings=37), "extra_openings.* is 37; .*an integer from 0 to 36"),
        (lambda: Maze2DConfig(radius_m=0.5), "radius_m.* is 0.5; .*a number from 0.001 to 0.45"),
        (lambda: Maze2D(render_mode="human"), "render_mode is 'human'; it must be None or 'rgb_array'"),
        (lambda: Maze2D().step(0), "before reset"),
        (lambda: ready().step(3), "action is 3; it must be 0"),
        (lambda: ready().reset(options={"pose": 1}), r"options has \['pose'\]; it may have 'maze'"),
        (lambda: ready().reset(options={"pose_xyyaw": (0.5, 0.5, 0.0)}), "pose_xyyaw is "),
        (lambda: Maze3DConfig(width=81), "width x height is 81 x 60; it must be one of 80 x 60"),
        (lambda: Maze3DConfig(textures="wool"), "'textures' is 'wool'; .*one of all, stone"),
        (lambda: Maze3DConfig(wad="a.wad", map="map01", textures="brick"), "'textures' is 'brick'; allowed: 'all'"),
        (lambda: Maze3D().step(0), "before reset"),
        (lambda: Maze3D().preload([]), "seeds is empty"),
        (lambda: Maze3D().preload([1, 2], [3]), "maze_seeds has 1 seeds; it must have 2"),
        (lambda: Maze(np.ones((4, 5), dtype=bool)), r"walls has shape \(4, 5\); it must be 2-D with odd sizes"),
        (lambda: kruskal_maze(1, 7, RNG), "rows is 1; it must be an integer from 2 to 100"),
        (lambda: kruskal_maze(3, 4, RNG, 7), "extra_openings is 7; it must be an integer from 0 to 6 in a maze of 3"),
        (lambda: make_driver("walls", SMALL, RNG), "driver is 'walls'; it must be one of corners"),
        (lambda: PathDriver(SMALL, RNG, lookahead_blocks=2.0), "lookahead_blocks is 2.0; it must be from "),
        (lambda: record_episode(Maze2D(), "corners", 0, 0), "frames is 0; it must be an integer of at least 1"),
        (lambda: Building2d().record(0, 0.0), "length_m is 0.0; it must be above 0"),
        (lambda: draw_floor_plan(-1), "seed is -1; it must be a whole number"),
        (lambda: VelocityCommand(VelocityLimits(1.0, 1.0, 1.0, 1.0), 1.0).set(np.nan, 0.0), "expected finite numbers"),
        (lambda: load_policy(Path("/nowhere/driver.safetensors")), "cannot be read .*; expected a driver's weights"),
    ],
)
def test_it_is_refused_by_its_value(refused: Callable[[], object], words: str) -> None:
    with pytest.raises((ValueError, RuntimeError), match=words):
        refused()
