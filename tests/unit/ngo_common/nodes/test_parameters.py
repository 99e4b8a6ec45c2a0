"""Settings as the parameters of a node."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidTopicNameException
from rclpy.expand_topic_name import expand_topic_name
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.validate_full_topic_name import validate_full_topic_name

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.settings import BadParameter, Settings, is_topic_name, pose, setting, topics


@dataclass(frozen=True)
class Example(Settings):
    count: int = setting(3, "A count.", minimum=1, maximum=5)
    share: float = setting(0.5, "A share.", minimum=0.0, maximum=1.0)
    mode: str = setting("slow", "A mode.", choices=("slow", "fast"))
    start: tuple[float, float, float] = pose((0.0, 0.0, 0.0), "A pose.")
    pace: float = setting(1.0, "A pace.", minimum=0.0, maximum=9.0, live=True)


@dataclass(frozen=True)
class Beside(Settings):
    rate: float = setting(1.0, "A rate.", minimum=0.0, maximum=9.0)
    streams: tuple[str, ...] = topics(("odom",), "Topics.")


def make_node(*arguments: str) -> Iterator[Node]:
    context = Context()
    rclpy.init(args=["--ros-args", *(word for argument in arguments for word in ("-p", argument))], context=context)
    node = rclpy.create_node("example", context=context, start_parameter_services=False)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


@pytest.fixture
def node(request: pytest.FixtureRequest) -> Iterator[Node]:
    yield from make_node(*getattr(request, "param", ("count:=4", "start:=[1, 2, 3]")))


def change(node: Node, name: str, value: Any) -> str:
    (result,) = node.set_parameters([Parameter(name, value=value)])
    return "" if result.successful else str(result.reason)


def test_only_live_parameters_change_while_locked_and_nothing_bad_ever(node: Node) -> None:
    live = LiveSettings(node, Example)
    assert live.values == Example(count=4, start=(1.0, 2.0, 3.0))
    changes: list[Example] = []
    live.on_change(changes.append)
    live.lock()
    assert "'count' cannot change now" in change(node, "count", 5)
    assert change(node, "pace", 3.0) == "" and live.values.pace == 3.0
    assert "pace" in change(node, "pace", 10.0)
    assert [changed.pace for changed in changes] == [3.0]
    live.lock(False)
    assert change(node, "count", 5) == "" and change(node, "start", [3.0, 2.0, 1.0]) == ""
    assert "parameter 'mode' is 'medium'; allowed: slow or fast" in change(node, "mode", "medium")
    assert live.values == Example(count=5, start=(3.0, 2.0, 1.0), pace=3.0) == changes[-1]


def test_every_parameter_is_described_with_what_it_may_be(node: Node) -> None:
    LiveSettings(node, Example)
    described = {name: node.describe_parameter(name) for name in ("share", "pace", "start")}
    assert [entry.description for entry in described.values()] == ["A share.", "A pace.", "A pose."]
    assert described["share"].additional_constraints == "a number from 0 to 1"
    assert described["pace"].additional_constraints == "a number from 0 to 9; at any time"
    assert described["pace"].floating_point_range[0].to_value == 9.0


@pytest.mark.parametrize("node", [("count:=2", "rate:=3", "streams:=[]")], indirect=True)
def test_a_node_may_have_settings_of_several_types(node: Node) -> None:
    types = Example, Beside
    first = LiveSettings(node, Example, defaults={"pace": 2.0}, beside=types)
    second = LiveSettings(node, Beside, beside=types)
    assert first.values == Example(count=2, pace=2.0)
    assert second.values == Beside(rate=3.0, streams=())
    first.lock()
    second.lock()
    assert change(node, "pace", 4.0) == "" and "'rate' cannot change now" in change(node, "rate", 2.0)


@pytest.mark.parametrize("node", [("rte:=3",)], indirect=True)
def test_a_name_that_no_type_has_is_an_error(node: Node) -> None:
    with pytest.raises(BadParameter, match="parameter 'rte' is 3, but unknown; did you mean rate"):
        LiveSettings(node, Example, beside=(Beside,))


@pytest.mark.parametrize(
    "name",
    ["a", "/a", "~/a", "~", "a/b_1/c", "{node}/x", "a{node}", "_a", "", "/", "a/", "//a", "a//b", "1a", "a/1b", "a b",
     "a~", "~a", "/~/a", "a-b", "a.b", "ä", "{1}", "{", "a__b", "a\n"],
)  # fmt: skip
def test_topic_names_are_those_of_ros(name: str) -> None:
    try:
        valid = bool(validate_full_topic_name(expand_topic_name(name, "node", "/robot")))
    except (InvalidTopicNameException, ValueError):
        valid = False
    assert is_topic_name(name) == valid
