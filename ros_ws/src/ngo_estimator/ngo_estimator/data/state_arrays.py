"""The state of an object as flat arrays with names: what is written to a file, and checked when it is read back."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import DTypeLike

Arrays = dict[str, np.ndarray]


class StateError(ValueError):
    """A saved state is missing, damaged, or not one that can be used here; the message is one line."""


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


def taken_indices(arrays: Mapping[str, np.ndarray], name: str, below: int) -> np.ndarray:
    """The indices ``name`` ``(n,)``; raises ``StateError`` unless they ascend from 0 or more to less than ``below``."""
    indices = taken(arrays, name, np.int64, -1)
    within = len(indices) == 0 or (indices[0] >= 0 and indices[-1] < below and (np.diff(indices) > 0).all())
    require(bool(within), f"'{name}' does not ascend from 0 or more to less than {below}")
    return indices


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
