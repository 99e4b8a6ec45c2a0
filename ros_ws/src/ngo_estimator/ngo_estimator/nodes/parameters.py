"""ROS parameters from a frozen dataclass: one field a parameter, described and checked in one place."""

import math
from collections.abc import Callable
from dataclasses import Field, dataclass, field, fields
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.validate_topic_name import validate_topic_name

# Every rclpy node has these, and declares them itself.
_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides.")
_KINDS = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


def setting(
    default: bool | int | float | str,
    description: str,
    *,
    choices: tuple[str, ...] = (),
    minimum: float = -math.inf,
    maximum: float = math.inf,
    allowed: str = "",
    check: Callable[[Any], bool] | None = None,
) -> Any:
    """A field of a ``Settings`` class: its default, its description and what it may be.

    Numbers may lie from ``minimum`` to ``maximum``, texts may be limited to ``choices``; any other condition
    is a ``check`` with ``allowed``, its description in words.
    """
    if not allowed:
        kind = _KINDS[type(default)]
        if math.isfinite(minimum) and math.isfinite(maximum):
            kind += f" from {minimum:g} to {maximum:g}"
        allowed = " or ".join(choices) if choices else kind
    limits = {"choices": choices, "minimum": minimum, "maximum": maximum, "allowed": allowed, "check": check}
    return field(default=default, metadata={"description": description, **limits})


def topic(default: str, description: str) -> Any:
    """A field that holds the name of a topic."""
    return setting(default, description, allowed="a topic name, as in image or /robot/image", check=_is_topic_name)


def frame(default: str, description: str) -> Any:
    """A field that holds the name of a coordinate frame."""
    return setting(default, description, allowed="a frame name without / in front", check=_is_frame_name)


class BadParameter(ValueError):
    """A parameter that is unknown or outside what is allowed; the message is one line that says so."""


@dataclass(frozen=True)
class Settings:
    """A node's parameters; raises ``BadParameter`` for the first value that is not allowed."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not _is_allowed(entry, value):
                raise BadParameter(f"parameter '{entry.name}' is {value!r}; allowed: {entry.metadata['allowed']}")


SettingsType = TypeVar("SettingsType", bound=Settings)


def declare_settings(node: Node, settings_type: type[SettingsType]) -> SettingsType:
    """Declare every field of ``settings_type`` on ``node`` and return what the user set.

    The node must be made with ``automatically_declare_parameters_from_overrides=True``: this is how the names
    that the user gave become visible. All parameters are read-only, as they shape what is built at the start.
    An integer given for a number is taken as that number. Raises ``BadParameter`` for unknown names and
    values that are not allowed.
    """
    known = {entry.name: entry for entry in fields(settings_type)}
    simulated = node.get_parameter("use_sim_time").value
    if not isinstance(simulated, bool):
        raise BadParameter(f"parameter 'use_sim_time' is {simulated!r}; allowed: true or false")
    given = {
        name: parameter.value
        for name, parameter in node.get_parameters_by_prefix("").items()
        if not name.startswith(_OF_RCLPY)
    }
    for name, value in given.items():
        if name not in known:
            raise BadParameter(f"parameter '{name}' is {value!r}, but unknown; allowed: {', '.join(sorted(known))}")
        if isinstance(known[name].default, float) and type(value) is int:
            given[name] = float(value)
    settings = settings_type(**given)
    for name, entry in known.items():
        if name in given:
            node.undeclare_parameter(name)
        node.declare_parameter(name, getattr(settings, name), _descriptor(entry), ignore_override=True)
    return settings


def _is_allowed(entry: "Field[Any]", value: object) -> bool:
    limits = entry.metadata
    if type(value) is not type(entry.default):
        return False
    if isinstance(value, (int, float)) and not limits["minimum"] <= value <= limits["maximum"]:
        return False  # written so that NaN is outside, too
    if limits["choices"] and value not in limits["choices"]:
        return False
    return limits["check"] is None or bool(limits["check"](value))


def _is_topic_name(value: str) -> bool:
    try:
        return bool(validate_topic_name(value))
    except InvalidTopicNameException:
        return False


def _is_frame_name(value: str) -> bool:
    return value != "" and not value.startswith("/") and not any(character.isspace() for character in value)


def _descriptor(entry: "Field[Any]") -> ParameterDescriptor:
    limits = entry.metadata
    descriptor = ParameterDescriptor(
        description=limits["description"], additional_constraints=limits["allowed"], read_only=True
    )
    if math.isfinite(limits["minimum"]) and math.isfinite(limits["maximum"]):
        if isinstance(entry.default, float):
            span = FloatingPointRange(from_value=float(limits["minimum"]), to_value=float(limits["maximum"]))
            descriptor.floating_point_range = [span]
        else:
            span = IntegerRange(from_value=int(limits["minimum"]), to_value=int(limits["maximum"]), step=1)
            descriptor.integer_range = [span]
    return descriptor
