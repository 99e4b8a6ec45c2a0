"""The record of a graph's loops: a row a loop in each of its arrays, whoever found them."""

import dataclasses
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike

AnyRecord = TypeVar("AnyRecord", bound="LoopRecord")


def rows(dtype: DTypeLike, *shape: int) -> Any:
    """A column of a record: an array of this type whose rows have this shape."""
    return dataclasses.field(metadata={"dtype": np.dtype(dtype), "shape": shape})


@dataclass(frozen=True)
class LoopRecord:
    """Loops between two nodes of a graph; a finder adds columns for how sure a loop is, and why.

    ``pairs`` ``(n, 2)`` are the nodes, the earlier first; ``relative`` ``(n, 3)`` the later one as it was seen from the
    earlier (m, m, rad).
    """

    pairs: np.ndarray = rows(np.int64, 2)
    relative: np.ndarray = rows(np.float64, 3)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            expected, found = (len(self.pairs), *field.metadata["shape"]), getattr(self, field.name).shape
            if found != expected:
                raise ValueError(f"{field.name} of loops has the shape {found}; expected {expected}")

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self: AnyRecord, which: np.ndarray) -> AnyRecord:
        """The loops of a boolean mask or of indices."""
        index = np.flatnonzero(which) if which.dtype == np.bool_ else which
        return type(self)(*(column.take(index, axis=0) for column in self._columns()))

    @classmethod
    def none(cls: type[AnyRecord]) -> AnyRecord:
        """No loops."""
        columns = (field.metadata for field in dataclasses.fields(cls))
        return cls(*(np.zeros((0, *column["shape"]), column["dtype"]) for column in columns))

    def extended(self: AnyRecord, others: AnyRecord) -> AnyRecord:
        """These loops, then the others."""
        return type(self)(*map(np.concatenate, zip(self._columns(), others._columns(), strict=True)))

    def frames(self, nodes: np.ndarray) -> np.ndarray:
        """The frames that the loops join ``(n, 2)``, of nodes that are the frames ``nodes`` ``(nodes,)``."""
        joined: np.ndarray = nodes[self.pairs]
        return joined

    def _columns(self) -> list[np.ndarray]:
        return [getattr(self, field.name) for field in dataclasses.fields(self)]
