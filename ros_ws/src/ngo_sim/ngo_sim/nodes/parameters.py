"""Config dataclasses as ROS parameters: one parameter a field, and one clear line for what a person got wrong."""

from __future__ import annotations

import dataclasses
import difflib
from typing import Any, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from ngo_sim.simulator_config import field_descriptions, field_limits

# Every rclpy node declares these two by itself.
_OWN_TO_ROS = ("use_sim_time", "start_type_description_service")
_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a string", tuple: "a list of strings"}

Config = TypeVar("Config")


class BadParameter(ValueError):
    """A parameter is unknown or has a value that is not allowed; the text says which, and what is allowed."""


class ConfigParameters:
    """The parameters of a node, declared from config dataclasses, with every parameter that was given accounted for."""

    def __init__(self, node: Node) -> None:
        self._node = node
        # What was given in arguments and files, declared or not: rclpy shows this nowhere else.
        given = {name: parameter.value for name, parameter in node.handle.get_parameters(Parameter).items()}
        self._given = {name: value for name, value in given.items() if name not in _OWN_TO_ROS}
        self._known: set[str] = set()

    def declare(self, config_type: type[Config], **defaults: Any) -> Config:
        """Declare a parameter for each field, and return the config of the values given, else of the defaults.

        defaults: values that replace those of the fields. A field may be given by the alias in its metadata instead of
        its name, not by both. Raises BadParameter.
        """
        descriptions, limits = field_descriptions(config_type), field_limits(config_type)
        values = {}
        fields = dataclasses.fields(config_type)  # type: ignore[arg-type]
        for field in fields:
            default = defaults.get(field.name, field.default)
            name = self._name_given(field)
            values[field.name] = _converted(name, self._given.get(name, default), default)
            self._known |= {field.name, name}
        try:
            config = config_type(**values)
        except ValueError as error:
            raise BadParameter(str(error)) from None
        for field in fields:
            value = list(values[field.name]) if isinstance(values[field.name], tuple) else values[field.name]
            # ROS has no empty list: neither in files nor in values, where it would take it for a list of bytes.
            self._node.declare_parameter(
                field.name,
                Parameter.Type.STRING_ARRAY if value == [] else value,
                _descriptor(field, descriptions[field.name], limits.get(field.name, "")),
                ignore_override=True,
            )
        return config

    def _name_given(self, field: dataclasses.Field[Any]) -> str:
        """The name under which a field was given, its own where it was not."""
        alias = field.metadata.get("alias", "")
        if alias not in self._given:
            return field.name
        if field.name in self._given:
            raise BadParameter(
                f"{alias} is {self._given[alias]!r} and {field.name} is {self._given[field.name]!r}; allowed: one of "
                "them, for both are names of the same"
            )
        return str(alias)

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
    """The value as the type of the default: `10` is a float, too, and an empty list comes from ROS as None."""
    kind = type(default)
    if kind is tuple and value is None:
        return ()
    if kind is float and type(value) is int:
        return float(value)
    if kind is tuple and isinstance(value, (list, tuple)) and all(isinstance(item, str) for item in value):
        return tuple(value)
    if type(value) is not kind:
        raise BadParameter(f"{name} is {value!r}; allowed: {_WORDS[kind]}")
    return value


def _descriptor(field: dataclasses.Field[Any], description: str, limits: str) -> ParameterDescriptor:
    low, high = field.metadata.get("low"), field.metadata.get("high")
    changeable = field.metadata.get("changeable", False)
    descriptor = ParameterDescriptor(description=description, read_only=not changeable)
    descriptor.additional_constraints = limits + ("; at any time" if changeable else "")
    if low is None or high is None:
        return descriptor
    if isinstance(field.default, float):
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    else:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    return descriptor
