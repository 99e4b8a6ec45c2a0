"""Settings of simulators: what is allowed, and what is refused by its value."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_common.settings import BadParameter
from ngo_sim.building2d import Building2d
from ngo_sim.driver_choice import make_driver
from ngo_sim.episodes import record_episode
from ngo_sim.floor_plans import draw_floor_plan
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.mazes import Maze, kruskal_maze
from ngo_sim.policy_network import load_policy
from ngo_sim.simulator_config import SimulatorConfig
from ngo_sim.velocity_command import VelocityCommand, VelocityLimits


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("seed", -1, "an integer from 0 to 2147483647"),
        ("seed", 1.0, "an integer"),
        ("rate", -0.1, "a number from 0 to 10000"),
        ("rate", math.nan, "a number"),
        ("rate", True, "a number"),
        ("driver", "fast", "one of auto, corners, random_goals, distance, learned, explorer, random, none"),
        ("frames", -1, "an integer from 0"),
        ("wait_for_flow_control", 1, "true or false"),
        ("flow_control_topics", "odom", "a list of topic names"),
        ("flow_control_topics", ("",), "a list of topic names"),
        ("max_in_flight", 0, "an integer from 1"),
        ("start_time_s", 0.0, "a number from 0.001 to 2000000000"),
        ("base_frame", "", "a frame name without / in front"),
    ],
)
def test_refuses_and_says_what_is_allowed(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"^parameter '{name}' is ") as error:
        SimulatorConfig(**{name: value})
    assert f"{value!r}; allowed: {allowed}" in str(error.value)


def test_refuses_a_simulated_clock_beside_wall_stamps() -> None:
    with pytest.raises(ValueError, match="'publish_clock' is True"):
        SimulatorConfig(publish_clock=True, use_wall_stamps=True)


def test_stamps_never_drift() -> None:
    config = SimulatorConfig(start_time_s=1.0)
    assert config.stamp_ns(0, 2 / 35) == 1_000_000_000
    assert config.stamp_ns(35_000_000, 2 / 35) == 1_000_000_000 + 2_000_000 * 10**9
    assert config.stamp_ns(3, 0.1) == 1_300_000_000


@pytest.mark.parametrize("config_type", [SimulatorConfig, Maze2DConfig, Maze3DConfig])
def test_every_field_says_what_it_means_and_what_is_allowed(config_type: type) -> None:
    for item in dataclasses.fields(config_type):
        assert item.metadata["description"][0].isupper() and item.metadata["description"].endswith("."), item.name
        assert item.metadata["allowed"], item.name


def test_the_truth_has_another_frame_above_it() -> None:
    assert SimulatorConfig(truth_parent_frame="map", frame_prefix="red/").framed("map") == "red/map"
    with pytest.raises(BadParameter, match="another name than ground_truth_frame's"):
        SimulatorConfig(truth_parent_frame="maze")


@pytest.mark.parametrize(("name", "value"), [("textures", "brick"), ("decorations", 3), ("rows", 7)])
def test_settings_of_mazes_are_refused_on_a_doom_map(name: str, value: object) -> None:
    with pytest.raises(BadParameter, match=f"'{name}' is {value!r}; allowed: .* together with wad, for it shapes"):
        Maze3DConfig(wad="my_way_home.wad", map="map01", **{name: value})
    Maze3DConfig(wad="my_way_home.wad", map="map01", width=160, height=120, thrust=50)


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
