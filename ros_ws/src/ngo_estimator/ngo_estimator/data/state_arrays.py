"""The state of an object as flat arrays with names: what is written to a file, and checked when it is read back.

An object saves the attributes that its class names in ``SAVED``, a dataclass all of its fields: arrays, numbers, and
objects that save something themselves. A new object says what is expected of a saved one: types, shapes (an axis of
length 0 may have any), and, in ``check_state``, what belongs together. A class with ``state`` and ``restore`` of
its own is asked instead.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

Arrays = dict[str, np.ndarray]
Saved = TypeVar("Saved")


class StateError(ValueError):
    """A saved state is missing, damaged, or not one that can be used here; the message is one line."""


def state_of(owner: Any) -> Arrays:
    """Copies of all that an object saves, for ``restore``."""
    own: Arrays = owner.state() if hasattr(owner, "state") else attributes_of(owner)
    return own


def attributes_of(owner: Any) -> Arrays:
    """Copies of the attributes that an object saves, by name; those that are None are left out."""
    arrays: Arrays = {}
    for name in _saved(owner):
        value = getattr(owner, name)
        if isinstance(value, np.ndarray | int):
            arrays[name] = np.array(value, order="C")  # as files hold them
        elif value is not None:
            arrays |= under(name, state_of(value))
    return arrays


def restore(owner: Saved, arrays: Mapping[str, np.ndarray]) -> Saved:
    """Take a ``state_of`` an object of this kind into a new one; returns it, or another one where it is frozen.

    Raises:
        StateError: an array is missing, of another type or shape, or does not belong to the others.
    """
    if hasattr(owner, "restore"):
        owner.restore(arrays)
        return owner
    return with_attributes(owner, arrays)


def with_attributes(owner: Saved, arrays: Mapping[str, np.ndarray]) -> Saved:
    """The object with the attributes of ``attributes_of``, checked; raises as ``restore``."""
    values = {}
    for name in _saved(owner):
        value = getattr(owner, name)
        if isinstance(value, np.ndarray | int):
            like = np.asarray(value)
            array = taken(arrays, name, like.dtype, *(length or -1 for length in like.shape))
            values[name] = array if isinstance(value, np.ndarray) else array.item()
        elif value is not None:
            values[name] = restore(value, part(arrays, name))
    if dataclasses.is_dataclass(owner) and not isinstance(owner, type):
        try:
            owner = dataclasses.replace(owner, **values)
        except ValueError as error:
            raise StateError(str(error)) from error
    else:
        for name, value in values.items():
            setattr(owner, name, value)
    if check := getattr(owner, "check_state", None):
        check()
    return owner


def _saved(owner: Any) -> tuple[str, ...]:
    if dataclasses.is_dataclass(owner):
        return tuple(field.name for field in dataclasses.fields(owner))
    names: tuple[str, ...] = owner.SAVED
    return names


def under(prefix: str, arrays: Mapping[str, np.ndarray]) -> Arrays:
    """The arrays of a part, with ``prefix.`` in front of their names."""
    return {f"{prefix}.{name}": array for name, array in arrays.items()}


def part(arrays: Mapping[str, np.ndarray], prefix: str) -> Arrays:
    """The arrays whose names begin with ``prefix.``, without it."""
    start = prefix + "."
    return {name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)}


def taken(arrays: Mapping[str, np.ndarray], name: str, dtype: DTypeLike, *shape: int) -> np.ndarray:
    """A copy of the array ``name``, which may be written to; -1 in ``shape`` stands for any length.

    Raises:
        StateError: there is none, or it is of another type or shape.
    """
    if name not in arrays:
        raise StateError(f"there is no array '{name}'")
    array = arrays[name]
    fits = len(array.shape) == len(shape) and all(
        want in (-1, got) for got, want in zip(array.shape, shape, strict=True)
    )
    if array.dtype != dtype or not fits:
        raise StateError(
            f"array '{name}' is {array.dtype} of shape {array.shape}; expected {np.dtype(dtype)} of shape {shape}"
        )
    return np.array(array)


def taken_integer(arrays: Mapping[str, np.ndarray], name: str, least: int = 0) -> int:
    """The integer ``name``; raises ``StateError`` where there is none, or a smaller one than ``least``."""
    value = int(taken(arrays, name, np.int64))
    if value < least:
        raise StateError(f"'{name}' is {value}; expected at least {least}")
    return value


def require_ascending(indices: np.ndarray, name: str, below: int) -> None:
    """Raise ``StateError`` unless indices ``(n,)`` ascend from 0 or more to less than ``below``."""
    within = len(indices) == 0 or (indices[0] >= 0 and indices[-1] < below and (np.diff(indices) > 0).all())
    require(bool(within), f"'{name}' does not ascend from 0 or more to less than {below}")


def require(holds: bool, problem: str) -> None:
    """Raise ``StateError`` about arrays that do not belong together."""
    if not holds:
        raise StateError(problem)


def flat(rows: list[np.ndarray], empty: np.ndarray) -> Arrays:
    """Arrays ``(n_i, ...)`` one behind the other, and their lengths; ``empty`` ``(0, ...)`` says their type."""
    return {
        "rows": np.concatenate([empty, *rows]),
        "lengths": np.array([len(array) for array in rows], np.int64),
    }


def split(arrays: Mapping[str, np.ndarray], dtype: DTypeLike, *shape: int) -> list[np.ndarray]:
    """The arrays ``(n_i, *shape)`` of ``flat``; raises ``StateError`` where lengths and rows differ."""
    lengths = taken(arrays, "lengths", np.int64, -1)
    rows = taken(arrays, "rows", dtype, -1, *shape)
    require(
        bool((lengths >= 0).all()) and lengths.sum() == len(rows), f"{len(rows)} rows do not have the lengths listed"
    )
    ends = np.cumsum(lengths).tolist()
    return [rows[end - length : end] for end, length in zip(ends, lengths.tolist(), strict=True)]
