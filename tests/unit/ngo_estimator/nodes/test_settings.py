"""The estimator nodes' parameters: what is allowed, and the files that list them."""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import pytest
import rclpy
import yaml
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from ngo_estimator.nodes.parameters import (
    BadParameter,
    LiveSettings,
    Settings,
    frame,
    frame_prefix,
    make_settings,
    pose,
    setting,
    topic,
)
from ngo_estimator.nodes.settings import LocalNodeSettings, NgoNodeSettings

CONFIG = Path(__file__).parents[4] / "ros_ws/src/ngo_estimator/config"
KINDS = {"local_node": LocalNodeSettings, "ngo_node": NgoNodeSettings}


@dataclass(frozen=True)
class Example(Settings):
    count: int = setting(3, "A count.", minimum=1, maximum=5)
    share: float = setting(0.5, "A share.", minimum=0.0, maximum=1.0)
    mode: str = setting("slow", "A mode.", choices=("slow", "fast"))
    switch: bool = setting(True, "A switch.")
    stream: str = topic("image", "A topic.")
    place: str = frame("map", "A frame.")
    prefix: str = frame_prefix("", "A prefix.")
    start: tuple[float, float, float] = pose((0.0, 0.0, 0.0), "A pose.")
    pace: float = setting(1.0, "A pace.", minimum=0.0, maximum=9.0, live=True)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("count", 0, "an integer from 1 to 5"),
        ("count", 6, "an integer from 1 to 5"),
        ("count", 2.0, "an integer from 1 to 5"),
        ("count", True, "an integer from 1 to 5"),
        ("count", None, "an integer from 1 to 5"),
        ("share", float("nan"), "a number from 0 to 1"),
        ("share", float("inf"), "a number from 0 to 1"),
        ("share", "half", "a number from 0 to 1"),
        ("mode", "medium", "slow or fast"),
        ("switch", 1, "true or false"),
        ("switch", "yes", "true or false"),
        ("stream", "two words", "a topic name, as in image or /robot/image"),
        ("stream", "", "a topic name, as in image or /robot/image"),
        ("place", "/map", "a frame name without / in front"),
        ("place", "", "a frame name without / in front"),
        ("prefix", "/red/", "what a frame name may begin with, as in robot_1/, or nothing"),
        ("start", (1.0, 2.0), "three numbers: x (m), y (m), yaw (rad)"),
        ("start", (1.0, 2.0, float("nan")), "three numbers: x (m), y (m), yaw (rad)"),
        ("start", ("a", "b", "c"), "three numbers: x (m), y (m), yaw (rad)"),
        ("start", 3.0, "three numbers: x (m), y (m), yaw (rad)"),
    ],
)
def test_a_bad_value_is_named_with_what_is_allowed(name: str, value: Any, allowed: str) -> None:
    with pytest.raises(BadParameter) as error:
        Example(**{name: value})
    assert str(error.value) == f"parameter '{name}' is {value!r}; allowed: {allowed}"


def test_the_limits_themselves_are_allowed() -> None:
    Example(count=1, share=0.0, mode="fast", switch=False, stream="/robot_1/image", place="robot_1/map")
    Example(count=5, share=1.0)


@pytest.mark.parametrize("name", KINDS)
def test_the_file_lists_every_parameter_with_its_default(name: str) -> None:
    listed = yaml.safe_load((CONFIG / f"{name}.yaml").read_text())[f"/**/{name}"]["ros__parameters"]
    defaults = {entry.name: entry.default for entry in fields(KINDS[name])}
    assert listed == {key: list(value) if isinstance(value, tuple) else value for key, value in defaults.items()}
    assert make_settings(KINDS[name], listed) == KINDS[name]()


@pytest.mark.parametrize("path", sorted(CONFIG.glob("*.yaml")), ids=lambda path: path.name)
def test_every_file_is_accepted(path: Path) -> None:
    for name, content in yaml.safe_load(path.read_text()).items():
        if (node := name.removeprefix("/**/")) in KINDS:
            make_settings(KINDS[node], content["ros__parameters"])


def test_what_ros_gives_is_taken_as_what_it_means() -> None:
    given = {"share": 1, "start": array("d", [1.0, 2.0, 3.0]), "pace": 2}
    assert make_settings(Example, given) == Example(share=1.0, start=(1.0, 2.0, 3.0), pace=2.0)
    assert make_settings(Example, {"start": [1, 2, 3]}) == Example(start=(1.0, 2.0, 3.0))
    with pytest.raises(BadParameter, match="parameter 'speed' is 3, but unknown; allowed: count, mode, pace"):
        make_settings(Example, {"speed": 3})


@pytest.fixture
def node() -> Iterator[Node]:
    context = Context()
    arguments = ["--ros-args", "-p", "count:=4", "-p", "start:=[1, 2, 3]"]
    rclpy.init(args=arguments, context=context)
    node = rclpy.create_node(
        "example",
        context=context,
        automatically_declare_parameters_from_overrides=True,
        start_parameter_services=False,
    )
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def test_only_what_is_live_changes_while_locked_and_nothing_bad_ever(node: Node) -> None:
    live = LiveSettings(node, Example)
    assert live.values == Example(count=4, start=(1.0, 2.0, 3.0))
    changes: list[Example] = []
    live.on_change(changes.append)
    live.lock()

    def change(name: str, value: Any) -> str:
        (result,) = node.set_parameters([Parameter(name, value=value)])
        return "" if result.successful else str(result.reason)

    assert "'count' cannot change now" in change("count", 5)
    assert change("pace", 3.0) == "" and live.values.pace == 3.0
    assert "pace" in change("pace", 10.0)
    assert [changed.pace for changed in changes] == [3.0]
    live.lock(False)
    assert change("count", 5) == "" and change("start", [3.0, 2.0, 1.0]) == ""
    assert "parameter 'mode' is 'medium'; allowed: slow or fast" in change("mode", "medium")
    assert live.values == Example(count=5, start=(3.0, 2.0, 1.0), pace=3.0) == changes[-1]


def test_every_parameter_is_described_with_what_it_may_be(node: Node) -> None:
    LiveSettings(node, Example)
    described = {name: node.describe_parameter(name) for name in ("share", "pace", "start")}
    assert [entry.description for entry in described.values()] == ["A share.", "A pace.", "A pose."]
    assert described["share"].additional_constraints == "a number from 0 to 1"
    assert described["pace"].additional_constraints == "a number from 0 to 9; at any time"
    assert described["pace"].floating_point_range[0].to_value == 9.0


def test_frames_that_would_coincide_and_a_short_queue_are_errors() -> None:
    with pytest.raises(BadParameter, match="another name than odom_frame's"):
        LocalNodeSettings(base_frame="odom")
    with pytest.raises(BadParameter, match="another name than odom_frame's"):
        NgoNodeSettings(map_frame="odom")
    with pytest.raises(BadParameter, match="at least window_frames, which is 3000"):
        NgoNodeSettings(window_frames=3000)


def test_any_world_may_be_named_together_with_its_weights() -> None:
    for world in ("maze2d", "maze3d", "scan"):
        assert LocalNodeSettings(world=world).world == world
    assert NgoNodeSettings(world="our_robot-2", weights="/weights").world == "our_robot-2"
    for world, weights in (("our_robot", ""), ("../maze2d", "/weights"), ("", "/weights")):
        with pytest.raises(BadParameter, match=f"'world' is '{world}'; allowed: maze2d, maze3d or scan, or the name"):
            LocalNodeSettings(world=world, weights=weights)
