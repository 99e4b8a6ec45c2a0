import dataclasses
import math
from typing import Any

import pytest

from ngo_common.settings import BadParameter
from ngo_sim.maze2d import Maze2DConfig
from ngo_sim.maze3d import Maze3DConfig
from ngo_sim.simulator_config import SimulatorConfig


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
