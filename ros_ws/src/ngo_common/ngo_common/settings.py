"""Settings as frozen dataclasses: each field carries its description and its limits, and is checked. No ROS in here."""

import difflib
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import Field, dataclass, field, fields
from numbers import Integral, Real
from typing import Any, TypeVar

LARGEST_POSE_M = 1e9
"""Largest coordinate of a pose that a user gives (m, rad): products of two of them are far from overflow."""

_KINDS = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}
# A relative, absolute or private name, whose parts may hold substitutions such as {node}.
_PART = r"(?:[A-Za-z_]|\{[A-Za-z_]\w*\})(?:\w|\{[A-Za-z_]\w*\})*"
_TOPIC_NAME = re.compile(rf"~|~?/?{_PART}(?:/{_PART})*", re.ASCII)


class BadParameter(ValueError):
    """A parameter is unknown or has a value that is not allowed; the message is one line."""


def setting(
    default: bool | int | float | str | tuple[float, ...] | tuple[str, ...],
    description: str,
    *,
    choices: tuple[str, ...] = (),
    minimum: float = -math.inf,
    maximum: float = math.inf,
    allowed: str = "",
    check: Callable[[Any], bool] | None = None,
    live: bool = False,
    alias: str = "",
) -> Any:
    """A field of a ``Settings`` class with its default, its description and its limits.

    minimum, maximum: limits of a number. choices: the texts that are allowed. check: any other condition, with
    ``allowed`` as its description. live: the value may change while a node runs. alias: a second name for users.
    """
    if not allowed:
        allowed = _choice(choices) if choices else _KINDS[type(default)]
        if math.isfinite(minimum) and math.isfinite(maximum):
            allowed += f" from {minimum:.15g} to {maximum:.15g}"
    limits = {"choices": choices, "minimum": minimum, "maximum": maximum, "allowed": allowed, "check": check}
    return field(default=default, metadata={"description": description, "live": live, "alias": alias, **limits})


def topic(default: str, description: str) -> Any:
    """A field that holds the name of a topic."""
    return setting(default, description, allowed="a topic name, as in image or /robot/image", check=is_topic_name)


def topics(default: tuple[str, ...], description: str) -> Any:
    """A field that holds names of topics."""
    return setting(
        default,
        description,
        allowed="a list of topic names",
        check=lambda value: all(isinstance(item, str) and is_topic_name(item) for item in value),
    )


def frame(default: str, description: str) -> Any:
    """A field that holds the name of a coordinate frame."""
    return setting(default, description, allowed="a frame name without / in front", check=_is_frame_name)


def optional_frame(default: str, description: str) -> Any:
    """A field that holds the name of a coordinate frame, or nothing."""
    allowed = "a frame name without / in front, or nothing"
    return setting(default, description, allowed=allowed, check=lambda value: value == "" or _is_frame_name(value))


def pose(default: tuple[float, float, float], description: str, live: bool = False) -> Any:
    """A field that holds a planar pose (x, y, yaw)."""
    allowed = f"three numbers up to {LARGEST_POSE_M:g}: x (m), y (m), yaw (rad)"
    return setting(default, description, allowed=allowed, check=_is_pose, live=live)


@dataclass(frozen=True)
class Settings:
    """Settings that check themselves; raises ``BadParameter`` for the first value that is not allowed."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not _is_allowed(entry, value):
                raise BadParameter(f"parameter '{entry.name}' is {value!r}; allowed: {entry.metadata['allowed']}")


@dataclass(frozen=True)
class FramedSettings(Settings):
    """Settings of a node whose frames may carry a prefix."""

    frame_prefix: str = setting(
        "",
        "Prefix of the names of all frames, for several robots on one /tf.",
        allowed="a text that a frame name may begin with, as in robot_1/, or nothing",
        check=lambda value: value == "" or _is_frame_name(value),
    )

    def framed(self, name: str) -> str:
        """The name of a frame with this robot's prefix."""
        return self.frame_prefix + name


SettingsType = TypeVar("SettingsType", bound=Settings)


def make_settings(
    settings_type: type[SettingsType], given: Mapping[str, Any], defaults: Mapping[str, Any] | None = None
) -> SettingsType:
    """Settings from the values that a user gave.

    An integer becomes a number where a number is expected, a list becomes a tuple. ``defaults`` replace those of the
    fields. Raises ``BadParameter`` for an unknown name, a value that is not allowed, and a field given under both its
    names.
    """
    refuse_unknown(given, (settings_type,))
    values = dict(defaults or {})
    for entry in fields(settings_type):
        alias = entry.metadata["alias"]
        if alias in given and entry.name in given:
            raise BadParameter(f"parameters '{alias}' and '{entry.name}' are the same; allowed: one of them")
        name = alias if alias in given else entry.name
        if name in given:
            values[entry.name] = converted(entry, given[name])
    try:
        return settings_type(**values)
    except BadParameter:
        raise
    except ValueError as error:  # of a condition between several fields
        raise BadParameter(str(error)) from None


def names_of(settings_type: type[Settings]) -> set[str]:
    """The names under which the fields may be given."""
    return {name for entry in fields(settings_type) for name in (entry.name, entry.metadata["alias"]) if name}


def refuse_unknown(given: Mapping[str, Any], settings_types: tuple[type[Settings], ...]) -> None:
    """Raise ``BadParameter`` for a name that no field of these types has."""
    known = set().union(*map(names_of, settings_types))
    for name in sorted(given.keys() - known):
        close = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {close[0]}?" if close else "allowed: " + ", ".join(sorted(known))
        raise BadParameter(f"parameter '{name}' is {given[name]!r}, but unknown; {hint}")


def converted(entry: "Field[Any]", value: Any) -> Any:
    """A value in the type of its field, where it can be that without loss; else as it is."""
    if isinstance(entry.default, float) and type(value) is int:
        return float(value)
    if isinstance(entry.default, tuple):
        if value is None:  # an empty list, as it comes from ROS
            return ()
        if hasattr(value, "__iter__") and not isinstance(value, str):
            return tuple(float(item) if type(item) is int else item for item in value)
    return value


def usage(package: str, name: str, summary: str, *settings_types: type[Settings], **defaults: Any) -> str:
    """The text of a node's ``--help``: how to start it, and its parameters with defaults, limits and descriptions."""
    lines = [
        f"usage: ros2 run {package} {name} [--ros-args [-p PARAMETER:=VALUE] [--params-file FILE] [-r FROM:=TO]]",
        "",
        summary,
        "",
        "parameters (name, default, allowed values):",
    ]
    entries = {entry.name: entry for settings_type in settings_types for entry in fields(settings_type)}
    for entry_name, entry in sorted(entries.items()):
        default = defaults.get(entry_name, entry.default)
        text = {True: "true", False: "false"}[default] if isinstance(default, bool) else default
        text = f"[{', '.join(map(str, text))}]" if isinstance(text, tuple) else text if text != "" else "''"
        live = "; at any time" if entry.metadata["live"] else ""
        lines += [f"  {entry_name}:={text}  ({entry.metadata['allowed']}{live})", f"      {described(entry)}"]
    return "\n".join(lines)


def described(entry: "Field[Any]") -> str:
    """The description of a field, with its second name."""
    alias = entry.metadata["alias"]
    return entry.metadata["description"] + (f" May be given as {alias}." if alias else "")


def is_topic_name(value: str) -> bool:
    """Whether ROS takes this as the name of a topic."""
    return _TOPIC_NAME.fullmatch(value) is not None


def _choice(choices: tuple[str, ...]) -> str:
    return " or ".join(choices) if len(choices) < 3 else "one of " + ", ".join(choices)


def _is_allowed(entry: "Field[Any]", value: object) -> bool:
    limits = entry.metadata
    kind: type = type(entry.default)
    numbers: dict[type, type] = {float: Real, int: Integral}
    if isinstance(value, bool) != (kind is bool) or not isinstance(value, numbers.get(kind, kind)):
        return False
    if isinstance(value, Real) and not limits["minimum"] <= value <= limits["maximum"]:
        return False  # a comparison that is false for NaN
    if limits["choices"] and value not in limits["choices"]:
        return False
    return limits["check"] is None or bool(limits["check"](value))


def _is_frame_name(value: str) -> bool:
    return value != "" and not value.startswith("/") and not any(character.isspace() for character in value)


def _is_pose(value: tuple[Any, ...]) -> bool:
    return len(value) == 3 and all(type(item) is float and abs(item) <= LARGEST_POSE_M for item in value)
