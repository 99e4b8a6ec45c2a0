"""Messages as text: the YAML that `ros2 topic echo` prints."""

import array
import importlib
import sys
from typing import Any

import numpy as np
import yaml

from ros2_stand_in.errors import CommandError


def message_class(type_name: str) -> Any:
    """The class of `package/msg/Name`; CommandError where it cannot be found."""
    parts = type_name.split("/")
    if len(parts) != 3 or not all(parts):
        raise CommandError("The passed message type is invalid")
    try:
        return getattr(importlib.import_module(".".join(parts[:-1])), parts[-1])
    except (ImportError, AttributeError):
        raise CommandError(f"The message type '{type_name}' is invalid") from None


def is_message(value: Any) -> bool:
    """Whether a value is a ROS message, not a number, string or array."""
    return hasattr(value, "get_fields_and_field_types")


def plain(value: Any, truncate_length: int | None) -> Any:
    """A field's value in Python's own types, in the order of the .msg file.

    Strings, bytes and arrays longer than `truncate_length` end there with '...'; None keeps them whole.
    """
    if is_message(value):
        return {name: plain(getattr(value, name), truncate_length) for name in value.get_fields_and_field_types()}
    if isinstance(value, bytes):
        value = value.decode("latin-1")
    if isinstance(value, str):
        too_long = truncate_length is not None and len(value) > truncate_length
        return value[:truncate_length] + "..." if too_long else value
    if isinstance(value, (list, tuple, array.array, np.ndarray)):
        too_long = truncate_length is not None and len(value) > truncate_length
        items = [plain(item, truncate_length) for item in value[:truncate_length]]
        return [*items, "..."] if too_long else items
    if isinstance(value, np.generic):
        return value.item()
    return value


def message_to_yaml(message: Any, truncate_length: int | None = None) -> str:
    """A message as a YAML document in block style, ending with a line break."""
    fields = plain(message, truncate_length)
    text: str = yaml.dump(fields, sort_keys=False, allow_unicode=True, width=sys.maxsize, default_flow_style=False)
    return text


def select_field(message: Any, field: str) -> Any:
    """The part of a message that a dotted path such as `pose.pose.position` names."""
    value = message
    for name in field.split("."):
        try:
            value = getattr(value, name)
        except AttributeError as error:
            raise CommandError(f"Invalid field '{field}': {error}") from None
    return value


def echo_text(message: Any, field: str | None, truncate_length: int | None) -> str:
    """The output of `ros2 topic echo` for one message, with the separator."""
    value = message if field is None else select_field(message, field)
    if is_message(value):
        return message_to_yaml(value, truncate_length) + "---"
    return f"{value}\n---"
