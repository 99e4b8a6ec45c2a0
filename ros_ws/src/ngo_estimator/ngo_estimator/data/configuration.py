"""Configuration dataclasses: from the values of a JSON file, and how they check their values."""

import dataclasses
import math
import types
import typing
from collections.abc import Callable
from typing import Any, TypeVar

Config = TypeVar("Config")

_LARGEST_INTEGER = 10**6  # of a network's sizes: a layer of a larger one may take all memory before it fails


def check(config: object, names: str, expected: str, holds: Callable[[Any], bool]) -> None:
    """Raise ``ValueError`` about the first of the named fields that does not hold what is expected.

    Of a tuple each value must, and there must be one.
    """
    for name in names.split():
        value = getattr(config, name)
        if not (value != () and all(map(holds, value)) if isinstance(value, tuple) else holds(value)):
            raise ValueError(f"{name} is {value!r}; expected {expected}")


def check_positive(config: object, names: str) -> None:
    """The same of fields that hold positive, finite numbers."""
    check(config, names, "positive, finite", lambda x: 0.0 < x < math.inf)


def config_from_dict(kind: type[Config], values: Any) -> Config:
    """Build a (nested) configuration dataclass from JSON values; unknown and missing keys are errors."""
    if not isinstance(values, dict):
        raise ValueError(f"{kind.__name__} is {values!r}; expected an object")
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if unknown := sorted(set(values) - set(fields)):
        raise ValueError(f"{kind.__name__} has unknown keys {unknown}; expected among {sorted(fields)}")
    hints = typing.get_type_hints(kind)
    arguments = {}
    for name, value in values.items():
        try:
            arguments[name] = _from_json(hints[name], value)
        except ValueError as error:
            raise ValueError(f"{kind.__name__}.{name}: {error}") from error
    try:
        return kind(**arguments)
    except TypeError as error:
        raise ValueError(f"{kind.__name__}: {error}") from error


def _from_json(hint: Any, value: Any) -> Any:
    if dataclasses.is_dataclass(hint):
        return config_from_dict(typing.cast("type[Any]", hint), value)
    if typing.get_origin(hint) is types.UnionType:  # a value or None
        (hint,) = (one for one in typing.get_args(hint) if one is not type(None))
        return None if value is None else _from_json(hint, value)
    if typing.get_origin(hint) is tuple:
        items = typing.get_args(hint)
        if not isinstance(value, list) or (items[-1] is not Ellipsis and len(value) != len(items)):
            raise ValueError(f"{value!r} is given where {hint} is expected")
        return tuple(_from_json(items[0], item) for item in value)
    # JSON has one kind of number, and true is no number.
    allowed = (int, float) if hint is float else hint
    if not isinstance(value, allowed) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{value!r} is given where {hint.__name__} is expected")
    if hint is int and abs(value) > _LARGEST_INTEGER:
        raise ValueError(f"{str(value)[:20]} is given where an integer up to {_LARGEST_INTEGER} is expected")
    if hint is not float:
        return value
    try:
        number = float(value)
    except OverflowError:  # an integer of hundreds of digits
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{value!r} is given where a finite number is expected")
    return number
