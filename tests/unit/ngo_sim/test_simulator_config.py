import dataclasses
import math
import re
from dataclasses import dataclass
from typing import Any

import pytest

from ngo_sim.maze2d import Maze2DConfig
from ngo_sim.maze3d import Maze3DConfig
from ngo_sim.simulator_config import SimulatorConfig, field_descriptions, field_limits


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("seed", -1, "a whole number from 0 to 2147483647"),
        ("seed", 1.0, "a whole number"),
        ("rate", -0.1, "a number from 0 to 10000"),
        ("rate", math.nan, "a number"),
        ("rate", True, "a number"),
        ("driver", "fast", "one of auto, corners, random_goals, distance, learned, explorer, random, none"),
        ("frames", -1, "a whole number from 0"),
        ("wait_for_flow_control", 1, "true or false"),
        ("flow_control_topics", "odom", "a list of topic names"),
        ("flow_control_topics", ("",), "a list of topic names"),
        ("max_in_flight", 0, "a whole number from 1"),
        ("start_time_s", 0.0, "a number from 0.001"),
        ("base_frame", "", "a name that is not empty"),
    ],
)
def test_refuses_and_says_what_is_allowed(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(ValueError, match=f"^{name} is ") as error:
        SimulatorConfig(**{name: value})
    assert f"{value!r}; allowed: {allowed}" in str(error.value)


def test_refuses_a_simulated_clock_beside_wall_stamps() -> None:
    with pytest.raises(ValueError, match="publish_clock is True"):
        SimulatorConfig(publish_clock=True, use_wall_stamps=True)


def test_stamps_never_drift() -> None:
    config = SimulatorConfig(start_time_s=1.0)
    assert config.stamp_ns(0, 2 / 35) == 1_000_000_000
    assert config.stamp_ns(35_000_000, 2 / 35) == 1_000_000_000 + 2_000_000 * 10**9
    assert config.stamp_ns(3, 0.1) == 1_300_000_000


@pytest.mark.parametrize("config_type", [SimulatorConfig, Maze2DConfig, Maze3DConfig])
def test_every_field_is_described(config_type: type) -> None:
    descriptions = field_descriptions(config_type)
    assert list(descriptions) == [field.name for field in dataclasses.fields(config_type)]
    assert all(text[0].isupper() and text.endswith(".") for text in descriptions.values())


@pytest.mark.parametrize("config_type", [SimulatorConfig, Maze2DConfig, Maze3DConfig])
def test_every_field_says_what_is_allowed(config_type: type) -> None:
    assert list(field_limits(config_type)) == [field.name for field in dataclasses.fields(config_type)]


@pytest.mark.parametrize("config_type", [Maze2DConfig, Maze3DConfig])
def test_what_a_world_says_is_allowed_is_what_it_takes(config_type: type) -> None:
    kinds = {field.name: type(field.default) for field in dataclasses.fields(config_type)}
    checked = 0
    for name, text in field_limits(config_type).items():
        match = re.fullmatch(r"([\d.]+) to ([\d.]+)", text)
        if match is None:
            continue  # it depends on other fields
        low, high = (kinds[name](bound) for bound in match.groups())
        for bound, beyond in ((low, -1), (high, 1)):
            scale = {"radius_m": 0.2 * bound, "thrust_m": 0.0} if name == "block_m" and "radius_m" in kinds else {}
            others = {"extra_openings": 0, **scale, name: bound}
            config_type(**others)
            with pytest.raises(ValueError, match=f"^{name} is "):
                config_type(**{**others, name: bound + beyond * (1 if kinds[name] is int else 1e-6)})
        checked += 1
    assert checked >= 9


def test_descriptions_come_from_docstring_or_comment() -> None:
    @dataclass
    class Documented:
        """Title.

        Attributes:
            size: How large
                it is.
        """

        size: int = 1
        color: str = "red"  # what it looks like

    assert field_descriptions(Documented) == {"size": "How large it is.", "color": "What it looks like."}


def test_a_field_without_description_is_a_mistake() -> None:
    @dataclass
    class Silent:
        """Title."""

        size: int = 1

    with pytest.raises(ValueError, match=r"Silent\.size is described nowhere"):
        field_descriptions(Silent)
