"""Growing arrays of equal rows: of all that ever came, or of the newest alone."""

import numpy as np

from ngo_estimator.data.state_arrays import Arrays, require, taken, taken_integer


class GrowingRows:
    """All rows that were appended; their owner may write into ``values``."""

    def __init__(self, shape: tuple[int, ...], dtype: type) -> None:
        self._buffer: np.ndarray = np.zeros((256, *shape), dtype)
        self._used = 0

    def __len__(self) -> int:
        return self._used

    @property
    def values(self) -> np.ndarray:
        """All rows, without a copy."""
        return self._buffer[: self._used]

    def append(self, row: object) -> None:
        """Add one row."""
        if self._used == len(self._buffer):
            self._buffer = np.concatenate((self._buffer, np.zeros_like(self._buffer)))
        self._buffer[self._used] = row
        self._used += 1

    def set(self, rows: np.ndarray) -> None:
        """Have these rows instead."""
        self._buffer = np.concatenate((rows, np.zeros((max(256, len(rows)), *rows.shape[1:]), self._buffer.dtype)))
        self._used = len(rows)

    def state(self) -> Arrays:
        """All rows."""
        return {"rows": self.values.copy()}

    def restore(self, arrays: Arrays) -> None:
        """Take the rows of a ``state()``, in place of those here; raises ``StateError``."""
        rows = taken(arrays, "rows", self._buffer.dtype, -1, *self._buffer.shape[1:])
        self._used = len(rows)
        self._buffer = rows if len(rows) else self._buffer


class SlidingRows:
    """The newest rows of many: at least the last ``keep``, in memory that does not grow.

    Rows are numbered from the first that was ever appended.
    """

    def __init__(self, shape: tuple[int, ...], dtype: type, keep: int) -> None:
        self._buffer: np.ndarray = np.zeros((2 * keep, *shape), dtype)
        self._keep = keep
        self._dropped = 0
        self._used = 0

    def __len__(self) -> int:
        return self._dropped + self._used

    def append(self, row: object) -> None:
        """Add one row, and forget the oldest ones where there is no room left."""
        if self._used == len(self._buffer):
            self._buffer[: self._keep] = self._buffer[-self._keep :]
            self._dropped += self._used - self._keep
            self._used = self._keep
        self._buffer[self._used] = row
        self._used += 1

    def replace(self, start: int, rows: np.ndarray) -> None:
        """Overwrite the rows from number ``start`` on, and append those that go beyond the last."""
        here = max(len(self) - start, 0)
        first = start - self._dropped
        self._buffer[first : first + len(rows[:here])] = rows[:here]
        for row in rows[here:]:
            self.append(row)

    def slice(self, start: int, stop: int | None = None) -> np.ndarray:
        """Rows ``start`` to ``stop`` (not included; None: to the last), without a copy."""
        self._check(start)
        return self._buffer[start - self._dropped : self._used if stop is None else stop - self._dropped]

    def at(self, numbers: np.ndarray) -> np.ndarray:
        """The rows of these numbers, an array of any shape."""
        self._check(int(numbers.min(initial=self._dropped)))
        return self._buffer[numbers - self._dropped]

    def state(self) -> Arrays:
        """The rows that are kept, and how many are not."""
        return {"rows": self._buffer[: self._used].copy(), "dropped": np.array(self._dropped)}

    def restore(self, arrays: Arrays) -> None:
        """Take the rows of a ``state()``, in place of those here; raises ``StateError``."""
        rows = taken(arrays, "rows", self._buffer.dtype, -1, *self._buffer.shape[1:])
        most = len(self._buffer)
        require(len(rows) <= most, f"{len(rows)} rows are given where {most} have room")
        self._buffer[: len(rows)] = rows
        self._used, self._dropped = len(rows), taken_integer(arrays, "dropped")

    def _check(self, number: int) -> None:
        if number < self._dropped:
            raise IndexError(f"row {number} is asked for; only those from {self._dropped} on are kept")
