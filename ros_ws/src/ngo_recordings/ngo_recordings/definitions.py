"""Names and texts of message types: those of the ROS packages on this machine, and what ROS 1 called them."""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from ngo_recordings.errors import RecordingError

ROS1_ENCODING = "ros1msg"
_RENAMED = {"tf/msg/tfMessage": "tf2_msgs/msg/TFMessage", "roslib/msg/Header": "std_msgs/msg/Header"}


def plain_definition(text: str) -> str:
    """A definition of ROS 1 with the names that the types have since."""
    return text.replace("roslib/Header", "std_msgs/Header")


def ros2_type(name: str) -> str:
    """What ROS 2 calls a type of ROS 1."""
    package, _, short = name.partition("/")
    made = f"{package}/msg/{short.removeprefix('msg/')}"
    return _RENAMED.get(made, made)


@cache
def message_definition(type_name: str) -> str:
    """Text of a message type and of all it is made of, as MCAP wants it for schema encoding ros2msg.

    type_name: as in sensor_msgs/msg/Image. Raises RecordingError where no package on AMENT_PREFIX_PATH has it.
    """
    texts: dict[str, str] = {}
    waiting = deque([type_name])
    while waiting:
        package, name = _split(waiting.popleft())
        if f"{package}/{name}" in texts:
            continue
        text = _installed_text(package, name)
        texts[f"{package}/{name}"] = text
        waiting += [f"{owner or package}/msg/{part}" for owner, part in _compound_fields(text)]
    (_, first), *others = texts.items()
    return first + "".join(f"\n{'=' * 80}\nMSG: {name}\n{text}" for name, text in others)


def _split(type_name: str) -> tuple[str, str]:
    parts = type_name.split("/")
    if len(parts) != 3 or parts[1] != "msg" or not all(parts):
        raise RecordingError(f"message type is {type_name!r}; expected a name such as sensor_msgs/msg/Image")
    return parts[0], parts[2]


def _installed_text(package: str, name: str) -> str:
    for prefix in filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)):
        path = Path(prefix, "share", package, "msg", f"{name}.msg")
        if path.is_file():
            return path.read_text()
    raise RecordingError(
        f"message type {package}/msg/{name} is in no package on AMENT_PREFIX_PATH: open the ROS environment that has it"
    )


def _compound_fields(text: str) -> Iterator[tuple[str, str]]:
    """Package (empty: the message's own) and name of every field type that begins with a capital: a message."""
    for match in re.finditer(r"^\s*(?:(\w+)/)?([A-Z]\w*)[^\s=]*\s+\w+", text, re.MULTILINE):
        yield match.group(1) or "", match.group(2)
