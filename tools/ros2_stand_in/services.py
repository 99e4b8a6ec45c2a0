"""`ros2 service list` and `call`, `ros2 lifecycle get` and `set`."""

import importlib
import sys
from typing import Any

import yaml
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState

from ros2_stand_in.errors import CommandError
from ros2_stand_in.graph import call, command_node, is_hidden, poll, require_node, settle, spin_while
from ros2_stand_in.message_text import is_message


def service_class(type_name: str) -> Any:
    """The class of `package/srv/Name`; CommandError where it cannot be found."""
    parts = type_name.split("/")
    if len(parts) == 2:
        parts.insert(1, "srv")
    if len(parts) != 3 or not all(parts):
        raise CommandError("The passed service type is invalid")
    try:
        return getattr(importlib.import_module(".".join(parts[:-1])), parts[-1])
    except (ImportError, AttributeError):
        raise CommandError("The passed service type is invalid") from None


def fill(message: Any, values: Any) -> None:
    """Set the fields of a message from the mapping that YAML gives; CommandError for a field that it does not have."""
    if not isinstance(values, dict):
        raise CommandError(f"Failed to populate field: expected a mapping of names to values, got {values!r}")
    for name, value in values.items():
        if name not in message.get_fields_and_field_types():
            raise CommandError(f"Failed to populate field: '{type(message).__name__}' object has no attribute '{name}'")
        field = getattr(message, name)
        if is_message(field):
            fill(field, value)
            continue
        try:
            setattr(message, name, type(field)(value) if isinstance(field, (bool, int, float, str)) else value)
        except (AssertionError, TypeError, ValueError) as error:
            raise CommandError(f"Failed to populate field: {error}") from None


def print_services() -> int:
    """`ros2 service list`."""
    with command_node() as node:
        found = settle(node, lambda: sorted(name for name, _ in node.get_service_names_and_types()))
    for name in found:
        if not is_hidden(name):
            print(name)
    return 0


def call_service(service: str, type_name: str, values: str) -> int:
    """`ros2 service call SERVICE TYPE [VALUES]`."""
    service_type = service_class(type_name)
    request = service_type.Request()
    try:
        fill(request, yaml.safe_load(values) or {})
    except yaml.YAMLError as error:
        raise CommandError(f"The values are no YAML: {' '.join(str(error).split())}") from None
    with command_node() as node:
        client = node.create_client(service_type, service)
        if not client.service_is_ready():
            print("waiting for service to become available...", flush=True)
            poll(lambda: client.service_is_ready() or None, timeout_s=float("inf"))
        print(f"requester: making request: {request!r}\n", flush=True)
        future = client.call_async(request)
        spin_while(node, lambda: not future.done())
        if future.done():
            print(f"response:\n{future.result()!r}\n")
    return 0


def print_state(node_name: str) -> int:
    """`ros2 lifecycle get NODE`."""
    with command_node() as node:
        state = call(node, GetState, f"{require_node(node, node_name)}/get_state", GetState.Request()).current_state
        print(f"{state.label} [{state.id}]")
    return 0


def change_state(node_name: str, transition: str) -> int:
    """`ros2 lifecycle set NODE TRANSITION`, which is a label or a number."""
    with command_node() as node:
        name = require_node(node, node_name)
        available = call(
            node, GetAvailableTransitions, f"{name}/get_available_transitions", GetAvailableTransitions.Request()
        ).available_transitions
        chosen = [
            entry.transition for entry in available if transition in (entry.transition.label, str(entry.transition.id))
        ]
        if not chosen:
            known = "\n".join(f"- {entry.transition.label} [{entry.transition.id}]" for entry in available)
            raise CommandError(f"Unknown transition requested, available ones are:\n{known}")
        request = ChangeState.Request(transition=chosen[0])
        # A node may load networks before it answers.
        response = call(node, ChangeState, f"{name}/change_state", request, timeout_s=60.0)
        if not response.success:
            print("Transitioning failed", file=sys.stderr)
            return 1
        print("Transitioning successful")
    return 0
