"""`ros2 param list`, `get` and `set`."""

import datetime
import sys

import yaml
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParameters
from rclpy.parameter import get_parameter_value

from ros2_stand_in.errors import CommandError
from ros2_stand_in.graph import call, command_node, node_names, require_node, settle

# A parameter's type: the real command's label, and the field of ParameterValue that holds the value.
FIELDS = {
    ParameterType.PARAMETER_BOOL: ("Boolean value is:", "bool_value"),
    ParameterType.PARAMETER_INTEGER: ("Integer value is:", "integer_value"),
    ParameterType.PARAMETER_DOUBLE: ("Double value is:", "double_value"),
    ParameterType.PARAMETER_STRING: ("String value is:", "string_value"),
    ParameterType.PARAMETER_BYTE_ARRAY: ("Byte values are:", "byte_array_value"),
    ParameterType.PARAMETER_BOOL_ARRAY: ("Boolean values are:", "bool_array_value"),
    ParameterType.PARAMETER_INTEGER_ARRAY: ("Integer values are:", "integer_array_value"),
    ParameterType.PARAMETER_DOUBLE_ARRAY: ("Double values are:", "double_array_value"),
    ParameterType.PARAMETER_STRING_ARRAY: ("String values are:", "string_array_value"),
}


def value_text(value: ParameterValue, hide_type: bool = False) -> str:
    """The output of `ros2 param get` for a value."""
    if value.type == ParameterType.PARAMETER_NOT_SET:
        return "None" if hide_type else "Parameter not set."
    if value.type not in FIELDS:
        raise CommandError(f"Unknown parameter type '{value.type}'")
    label, field = FIELDS[value.type]
    content = getattr(value, field)
    return str(content) if hide_type else f"{label} {content}"


def parse_value(text: str) -> ParameterValue:
    """A value as the command line gives it: of the type that YAML takes it for, else a string."""
    try:
        if not isinstance(yaml.safe_load(text), (dict, datetime.date)):
            return get_parameter_value(text)
    except yaml.YAMLError:
        pass
    # No YAML, or something that no parameter can hold.
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)


def print_list(node_name: str | None) -> int:
    """`ros2 param list [NODE]`."""
    with command_node() as node:
        names, services = (
            ([require_node(node, node_name)], {})
            if node_name
            else settle(node, lambda: (node_names(node), dict(node.get_service_names_and_types())))
        )
        for name in names:
            service = f"{name}/list_parameters"
            # A node may do without parameter services; one that was asked for by name is waited for.
            if not node_name and service not in services:
                continue
            response = call(node, ListParameters, service, ListParameters.Request())
            if not node_name:
                print(f"{name}:")
            for parameter in sorted(response.result.names):
                print(f"  {parameter}")
    return 0


def print_value(node_name: str, parameter_name: str, hide_type: bool) -> int:
    """`ros2 param get NODE PARAMETER`."""
    with command_node() as node:
        service = f"{require_node(node, node_name)}/get_parameters"
        response = call(node, GetParameters, service, GetParameters.Request(names=[parameter_name]))
        if not response.values:
            raise CommandError("Parameter not set")
        print(value_text(response.values[0], hide_type))
    return 0


def set_value(node_name: str, parameter_name: str, value: str) -> int:
    """`ros2 param set NODE PARAMETER VALUE`; the exit code is 0 also where the node refuses, as the real command's."""
    with command_node() as node:
        service = f"{require_node(node, node_name)}/set_parameters"
        parameter = Parameter(name=parameter_name, value=parse_value(value))
        response = call(node, SetParameters, service, SetParameters.Request(parameters=[parameter]))
        result = response.results[0]
        reason = f": {result.reason}" if result.reason else ""
        if result.successful:
            print(f"Set parameter successful{reason}")
        else:
            print(f"Setting parameter failed{reason}", file=sys.stderr)
    return 0
