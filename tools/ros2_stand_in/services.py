"""`ros2 service call`, `ros2 param` and `ros2 lifecycle`."""

import datetime
import sys
from typing import Any

import yaml
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import get_parameter_value

from ros2_stand_in.cli import CommandError
from ros2_stand_in.graph import (
    call,
    command_node,
    interface,
    is_hidden,
    node_names,
    poll,
    settle,
    spin_while,
)

_LABELS = {
    1: ("Boolean value is", "bool"),
    2: ("Integer value is", "integer"),
    3: ("Double value is", "double"),
    4: ("String value is", "string"),
    5: ("Byte values are", "byte_array"),
    6: ("Boolean values are", "bool_array"),
    7: ("Integer values are", "integer_array"),
    8: ("Double values are", "double_array"),
    9: ("String values are", "string_array"),
}
"""Of each type of a parameter: the real command's label, and the field of its value."""


def fill(message: Any, values: Any) -> None:
    """Set the fields of a message from the mapping that YAML gives; CommandError for a field that it does not have."""
    if not isinstance(values, dict):
        raise CommandError(f"Failed to populate field: expected a mapping of names to values, got {values!r}")
    for name, value in values.items():
        if name not in message.get_fields_and_field_types():
            raise CommandError(f"Failed to populate field: '{type(message).__name__}' object has no attribute '{name}'")
        field = getattr(message, name)
        if hasattr(field, "get_fields_and_field_types"):
            fill(field, value)
            continue
        try:
            setattr(message, name, type(field)(value) if isinstance(field, (bool, int, float, str)) else value)
        except (AssertionError, TypeError, ValueError) as error:
            raise CommandError(f"Failed to populate field: {error}") from None


def call_service(service: str, type_name: str, values: str) -> int:
    """`ros2 service call SERVICE TYPE [VALUES]`."""
    service_type = interface(type_name, "srv")
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


def parse_value(text: str) -> ParameterValue:
    """A value as the command line gives it: of the type that YAML takes it for, else a string."""
    try:
        if not isinstance(yaml.safe_load(text), (dict, datetime.date)):
            return get_parameter_value(text)
    except yaml.YAMLError:
        pass
    # No YAML, or something that no parameter can hold.
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)


def _absolute(node_name: str) -> str:
    return node_name if node_name.startswith("/") else f"/{node_name}"


def set_parameter(node_name: str, parameter_name: str, value: str) -> int:
    """`ros2 param set NODE PARAMETER VALUE`; the exit code is 0 also where the node refuses, as the real command's."""
    request = SetParameters.Request(parameters=[Parameter(name=parameter_name, value=parse_value(value))])
    with command_node() as node:
        (result,) = call(node, SetParameters, f"{_absolute(node_name)}/set_parameters", request).results
    reason = f": {result.reason}" if result.reason else ""
    if result.successful:
        print(f"Set parameter successful{reason}")
    else:
        print(f"Setting parameter failed{reason}", file=sys.stderr)
    return 0


def print_parameters(node_name: str | None) -> int:
    """`ros2 param list [NODE]`."""
    with command_node() as node:
        names = [_absolute(node_name)] if node_name else []
        if not node_name:
            settle(node)
            offered = dict(node.get_service_names_and_types())  # a node may do without parameter services
            found = [name for name in node_names(node) if not is_hidden(name)]
            names = [name for name in found if f"{name}/list_parameters" in offered]
        for name in names:
            response = call(node, ListParameters, f"{name}/list_parameters", ListParameters.Request())
            print(
                *([] if node_name else [f"{name}:"]), *(f"  {one}" for one in sorted(response.result.names)), sep="\n"
            )
    return 0


def print_parameter(node_name: str, parameter_name: str, hide_type: bool) -> int:
    """`ros2 param get NODE PARAMETER`."""
    request = GetParameters.Request(names=[parameter_name])
    with command_node() as node:
        response = call(node, GetParameters, f"{_absolute(node_name)}/get_parameters", request)
    if not response.values or response.values[0].type == ParameterType.PARAMETER_NOT_SET:
        raise CommandError("Parameter not set")
    print(value_text(response.values[0], hide_type))
    return 0


def value_text(value: ParameterValue, hide_type: bool = False) -> str:
    """A parameter's value as `ros2 param get` prints it."""
    label, field = _LABELS[value.type]
    content = getattr(value, f"{field}_value")
    return str(content) if hide_type else f"{label}: {content}"


def print_state(node_name: str) -> int:
    """`ros2 lifecycle get NODE`."""
    with command_node() as node:
        state = call(node, GetState, f"{_absolute(node_name)}/get_state", GetState.Request()).current_state
    print(f"{state.label} [{state.id}]")
    return 0


def change_state(node_name: str, transition: str) -> int:
    """`ros2 lifecycle set NODE TRANSITION`, which is a label or a number."""
    name, ask = _absolute(node_name), GetAvailableTransitions.Request()
    with command_node() as node:
        found = call(node, GetAvailableTransitions, f"{name}/get_available_transitions", ask).available_transitions
        available = [entry.transition for entry in found]
        chosen = [one for one in available if transition in (one.label, str(one.id))]
        if not chosen:
            known = "\n".join(f"- {one.label} [{one.id}]" for one in available)
            raise CommandError(f"Unknown transition requested, available ones are:\n{known}")
        request = ChangeState.Request(transition=chosen[0])
        # A node may load networks before it answers.
        response = call(node, ChangeState, f"{name}/change_state", request, timeout_s=60.0)
    if not response.success:
        raise CommandError("Transitioning failed")
    print("Transitioning successful")
    return 0
