"""The parameters of a node, declared from ``Settings``."""

import math
from collections.abc import Callable, Mapping
from dataclasses import Field, fields, replace
from typing import Any, Generic

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from ngo_common.settings import (
    BadParameter,
    Settings,
    SettingsType,
    converted,
    described,
    make_settings,
    names_of,
    refuse_unknown,
)

# rclpy itself declares these on every node.
_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides.")


class LiveSettings(Generic[SettingsType]):
    """The parameters of a node as its ``Settings``, of which some may change while it runs.

    A change that is not allowed is refused with one line. Raises ``BadParameter`` for unknown names and values that are
    not allowed. A node may have several ``LiveSettings``: each is told the types of the others as ``beside``.
    """

    def __init__(
        self,
        node: Node,
        settings_type: type[SettingsType],
        *,
        defaults: Mapping[str, Any] | None = None,
        beside: tuple[type[Settings], ...] = (),
    ) -> None:
        """Declare every field of ``settings_type`` on ``node``; ``defaults`` replace those of the fields."""
        self._entries = {entry.name: entry for entry in fields(settings_type)}
        self._locked = False
        # The only place where rclpy shows parameters that were given and never declared.
        given = {
            name: parameter.value
            for name, parameter in node.handle.get_parameters(Parameter).items()
            if not name.startswith(_OF_RCLPY)
        }
        refuse_unknown(given, (settings_type, *beside))
        own = {name: value for name, value in given.items() if name in names_of(settings_type)}
        self.values = make_settings(settings_type, own, defaults)
        """The settings now."""
        for name, entry in self._entries.items():
            value = _for_ros(getattr(self.values, name))
            node.declare_parameter(name, value, _descriptor(entry), ignore_override=True)
            if isinstance(value, Parameter.Type):  # else nobody could ask the node for its parameters
                node.set_parameters([Parameter(name, value, [])])
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._take)
        self._listeners: list[Callable[[SettingsType], None]] = []

    def lock(self, locked: bool = True) -> None:
        """From now on only live settings may change; unlocked, all may."""
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
        return replace(self.values, **{name: converted(self._entries[name], value) for name, value in own.items()})


def _for_ros(value: Any) -> Any:
    if value == ():  # ROS would take an empty list for one of bytes
        return Parameter.Type.STRING_ARRAY
    return list(value) if isinstance(value, tuple) else value


def _descriptor(entry: "Field[Any]") -> ParameterDescriptor:
    limits = entry.metadata
    allowed = limits["allowed"] + ("; at any time" if limits["live"] else "")
    descriptor = ParameterDescriptor(description=described(entry), additional_constraints=allowed)
    if math.isfinite(limits["minimum"]) and math.isfinite(limits["maximum"]):
        if isinstance(entry.default, float):
            span = FloatingPointRange(from_value=float(limits["minimum"]), to_value=float(limits["maximum"]))
            descriptor.floating_point_range = [span]
        else:
            span = IntegerRange(from_value=int(limits["minimum"]), to_value=int(limits["maximum"]), step=1)
            descriptor.integer_range = [span]
    return descriptor
