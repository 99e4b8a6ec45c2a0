"""Config dataclasses as ROS parameters: one parameter a field, and one clear line for what a person got wrong."""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any, TypeVar

from ngo_sim.simulator_config import field_descriptions
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

# Every rclpy node declares these two by itself.
_OWN_TO_ROS = ("use_sim_time", "start_type_description_service")
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a string", tuple: "a list of strings"}

Config = TypeVar("Config")


class BadParameter(ValueError):
    """A parameter is unknown or has a value that is not allowed; the text says which, and what is allowed."""


class ConfigParameters:
    """The parameters of a node that was made with automatically_declare_parameters_from_overrides=True.

    That way the node holds exactly what was given in arguments and files, known or not.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        names = [name for name in node.list_parameters([], 0).names if name not in _OWN_TO_ROS]
        self._given = {name: node.get_parameter(name).value for name in names}
        for name in names:
            node.undeclare_parameter(name)
        self._known: list[str] = []

    def declare(self, config_type: type[Config], **defaults: Any) -> Config:
        """Declare a parameter for each field, and return the config of the values given, else of the defaults.

        defaults: values that replace those of the fields. Raises BadParameter.
        """
        descriptions = field_descriptions(config_type)
        values = {}
        fields = dataclasses.fields(config_type)  # type: ignore[arg-type]
        for field in fields:
            default = defaults.get(field.name, field.default)
            given = self._given.get(field.name, default)
            values[field.name] = _converted(field.name, given, default)
        self._known += values
        try:
            config = config_type(**values)
        except ValueError as error:
            raise BadParameter(str(error)) from None
        for field in fields:
            value = values[field.name]
            self._node.declare_parameter(field.name, list(value) if isinstance(value, tuple) else value,
                                         _descriptor(field, descriptions[field.name]), ignore_override=True)
        return config

    def finish(self) -> None:
        """Raise BadParameter for a parameter that was given and never declared."""
        for name in sorted(self._given.keys() - set(self._known)):
            close = difflib.get_close_matches(name, self._known, n=1)
            allowed = f"did you mean {close[0]}?" if close else "allowed: " + ", ".join(sorted(self._known))
            raise BadParameter(f"{name} is {self._given[name]!r}, but there is no parameter of this name; {allowed}")


def changed(config: Config, parameters: list[Parameter]) -> tuple[Config, SetParametersResult]:
    """The config after ROS changed parameters, and the answer to ROS; where the answer is no, the config as it was."""
    known = {field.name: field for field in dataclasses.fields(config)}  # type: ignore[arg-type]
    try:
        values = {p.name: _converted(p.name, p.value, known[p.name].default) for p in parameters if p.name in known}
        return dataclasses.replace(config, **values), SetParametersResult(successful=True)  # type: ignore[type-var]
    except ValueError as error:
        return config, SetParametersResult(successful=False, reason=str(error))


def _converted(name: str, value: Any, default: Any) -> Any:
    """The value as the type of the default; `10` for a float and `[]` for a list of strings lose nothing."""
    kind = type(default)
    if kind is float and type(value) is int:
        return float(value)
    if kind is tuple and isinstance(value, (list, tuple)) and all(isinstance(item, str) for item in value):
        return tuple(value)
    if type(value) is not kind:
        raise BadParameter(f"{name} is {value!r}; allowed: {_WORDS[kind]}")
    return value


def _descriptor(field: dataclasses.Field[Any], description: str) -> ParameterDescriptor:
    low, high = field.metadata.get("low"), field.metadata.get("high")
    descriptor = ParameterDescriptor(description=description, read_only=not field.metadata.get("changeable", False))
    if choices := field.metadata.get("choices"):
        descriptor.additional_constraints = "one of " + ", ".join(choices)
    if low is not None and isinstance(field.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif low is not None:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor
