"""ROS parameters from a frozen dataclass: one field a parameter, described and checked in one place."""

import math
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.validate_topic_name import validate_topic_name

# Every rclpy node has these, and declares them itself.
_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides.")
_KINDS = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


def setting(
    default: bool | int | float | str | tuple[float, ...],
    description: str,
    *,
    choices: tuple[str, ...] = (),
    minimum: float = -math.inf,
    maximum: float = math.inf,
    allowed: str = "",
    check: Callable[[Any], bool] | None = None,
    live: bool = False,
) -> Any:
    """A field of a ``Settings`` class: its default, its description and what it may be.

    Numbers may lie from ``minimum`` to ``maximum``, texts may be limited to ``choices``; any other condition
    is a ``check`` with ``allowed``, its description in words. What is ``live`` may change while the node runs.
    """
    if not allowed:
        kind = _KINDS[type(default)]
        if math.isfinite(minimum) and math.isfinite(maximum):
            kind += f" from {minimum:g} to {maximum:g}"
        allowed = " or ".join(choices) if choices else kind
    limits = {"choices": choices, "minimum": minimum, "maximum": maximum, "allowed": allowed, "check": check}
    return field(default=default, metadata={"description": description, "live": live, **limits})


def topic(default: str, description: str) -> Any:
    """A field that holds the name of a topic."""
    return setting(default, description, allowed="a topic name, as in image or /robot/image", check=_is_topic_name)


def frame(default: str, description: str) -> Any:
    """A field that holds the name of a coordinate frame."""
    return setting(default, description, allowed="a frame name without / in front", check=_is_frame_name)


def frame_prefix(default: str, description: str) -> Any:
    """A field that holds what stands before the names of frames."""
    allowed = "what a frame name may begin with, as in robot_1/, or nothing"
    return setting(default, description, allowed=allowed, check=lambda value: value == "" or _is_frame_name(value))


def pose(default: tuple[float, float, float], description: str, live: bool = False) -> Any:
    """A field that holds a planar pose (x, y, yaw)."""
    return setting(default, description, allowed="three numbers: x (m), y (m), yaw (rad)", check=_is_pose, live=live)


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


def make_settings(settings_type: type[SettingsType], given: Mapping[str, Any]) -> SettingsType:
    """Settings of the values that a user gave; raises ``BadParameter`` for unknown names and values not allowed.

    An integer given for a number is taken as that number, a list as the sequence that it is.
    """
    known = {entry.name: entry for entry in fields(settings_type)}
    for name, value in given.items():
        if name not in known:
            raise BadParameter(f"parameter '{name}' is {value!r}, but unknown; allowed: {', '.join(sorted(known))}")
    return settings_type(**{name: _converted(known[name], value) for name, value in given.items()})


class LiveSettings(Generic[SettingsType]):
    """The parameters of a node as its ``Settings``, of which some may change while it runs.

    The node must be made with ``automatically_declare_parameters_from_overrides=True``: this is how the names
    that the user gave become visible. A change that is not allowed is refused with one line. Raises
    ``BadParameter`` for unknown names and values that are not allowed.
    """

    def __init__(self, node: Node, settings_type: type[SettingsType]) -> None:
        """Declare every field of ``settings_type`` on ``node``."""
        self._node = node
        self._entries = {entry.name: entry for entry in fields(settings_type)}
        self._locked = False
        simulated = node.get_parameter("use_sim_time").value
        if not isinstance(simulated, bool):
            raise BadParameter(f"parameter 'use_sim_time' is {simulated!r}; allowed: true or false")
        given = {
            name: parameter.value
            for name, parameter in node.get_parameters_by_prefix("").items()
            if not name.startswith(_OF_RCLPY)
        }
        self.values = make_settings(settings_type, given)
        """What is set now."""
        for name, entry in self._entries.items():
            if name in given:
                node.undeclare_parameter(name)
            node.declare_parameter(name, _for_ros(getattr(self.values, name)), _descriptor(entry), ignore_override=True)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)
        self._listeners: list[Callable[[SettingsType], None]] = []

    def lock(self, locked: bool = True) -> None:
        """From now on only what is live may change; unlocked, everything may."""
        self._locked = locked

    def on_change(self, listener: Callable[[SettingsType], None]) -> None:
        """Have ``listener`` called with the new settings after each change."""
        self._listeners.append(listener)

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            entry = self._entries.get(parameter.name)
            if entry is not None and self._locked and not entry.metadata["live"]:
                reason = f"parameter '{parameter.name}' cannot change now: start or configure the node with it"
                return SetParametersResult(successful=False, reason=reason)
        try:
            self._changed(parameters)
        except BadParameter as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _take(self, parameters: list[Parameter]) -> None:
        changed = self._changed(parameters)
        if changed != self.values:
            self.values = changed
            for listener in self._listeners:
                listener(changed)

    def _changed(self, parameters: list[Parameter]) -> SettingsType:
        own = {parameter.name: parameter.value for parameter in parameters if parameter.name in self._entries}
        return replace(self.values, **{name: _converted(self._entries[name], value) for name, value in own.items()})


def _converted(entry: "Field[Any]", value: Any) -> Any:
    if isinstance(entry.default, float) and type(value) is int:
        return float(value)
    if isinstance(entry.default, tuple) and hasattr(value, "__iter__") and not isinstance(value, str):
        return tuple(float(item) if type(item) is int else item for item in value)
    return value


def _for_ros(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


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


def _is_pose(value: tuple[Any, ...]) -> bool:
    return len(value) == 3 and all(type(item) is float and math.isfinite(item) for item in value)


def _descriptor(entry: "Field[Any]") -> ParameterDescriptor:
    limits = entry.metadata
    allowed = limits["allowed"] + ("; at any time" if limits["live"] else "")
    descriptor = ParameterDescriptor(description=limits["description"], additional_constraints=allowed)
    if math.isfinite(limits["minimum"]) and math.isfinite(limits["maximum"]):
        if isinstance(entry.default, float):
            span = FloatingPointRange(from_value=float(limits["minimum"]), to_value=float(limits["maximum"]))
            descriptor.floating_point_range = [span]
        else:
            span = IntegerRange(from_value=int(limits["minimum"]), to_value=int(limits["maximum"]), step=1)
            descriptor.integer_range = [span]
    return descriptor
