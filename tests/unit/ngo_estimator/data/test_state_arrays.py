"""A new object says what is expected of a saved one; it comes back as it was, or is refused in a line."""

from dataclasses import dataclass

import numpy as np
import pytest

from ngo_estimator.data.row_buffers import GrowingRows, SlidingRows
from ngo_estimator.data.state_arrays import Arrays, StateError, require, restore, state_of


@dataclass(frozen=True)
class Pairs:
    """A record of any length."""

    nodes: np.ndarray
    weight: np.ndarray


def no_pairs() -> Pairs:
    return Pairs(np.zeros((0, 2), np.int64), np.zeros(0))


class Part:
    """Saves rows, of which it has one more than it counts."""

    SAVED = ("_rows", "count")

    def __init__(self) -> None:
        self._rows = GrowingRows((2,), np.float32)
        self.count, self.setting = -1, "not saved"

    def append(self, row: tuple[float, float]) -> None:
        self._rows.append(row)
        self.count += 1

    def check_state(self) -> None:
        require(len(self._rows) == self.count + 1, "rows are missing")


class Whole:
    """Saves a part, a record, and what it may do without."""

    SAVED = ("part", "pairs", "pose", "ready", "newest", "without")

    def __init__(self) -> None:
        self.part, self.pairs, self.pose, self.ready = Part(), no_pairs(), np.zeros(3), False
        self.newest, self.without = SlidingRows((), np.int64, 2), None


@pytest.fixture
def state() -> Arrays:
    whole = Whole()
    whole.part.append((1.0, 2.0))
    whole.pairs = Pairs(np.array([[0, 1], [1, 2]]), np.array([0.5, 1.0]))
    whole.pose[:], whole.ready = (1.0, 2.0, 3.0), True
    for row in range(9):
        whole.newest.append(row)
    return state_of(whole)


def test_names_lead_through_the_parts(state: Arrays) -> None:
    assert set(state) == {
        "part._rows.rows", "part.count", "pairs.nodes", "pairs.weight", "pose", "ready", "newest.rows",
        "newest.dropped",
    }  # fmt: skip


def test_an_object_comes_back_as_it_was(state: Arrays) -> None:
    whole = restore(Whole(), state)
    assert (
        whole.ready is True and whole.part.count == 0 and whole.part.setting == "not saved" and len(whole.newest) == 9
    )
    again = state_of(whole)
    for name, array in state.items():
        np.testing.assert_array_equal(again[name], array)
        assert again[name].dtype == array.dtype


def test_a_state_stays_as_it_is_when_the_object_goes_on(state: Arrays) -> None:
    whole = restore(Whole(), state)
    before = state_of(whole)
    whole.pose += 1.0
    whole.pairs.weight[:] = 0.0
    whole.part._rows.values[:] = 0.0
    for name, array in state.items():
        np.testing.assert_array_equal(before[name], array)


@pytest.mark.parametrize(
    ("name", "array", "complaint"),
    [
        ("pose", np.zeros(4), r"array 'pose' is float64 of shape \(4,\); expected float64 of shape \(3,\)"),
        ("pose", np.zeros(3, np.float32), "array 'pose' is float32"),
        ("ready", np.array(1), "array 'ready' is int64"),
        ("pairs.nodes", np.zeros((5, 3), np.int64), "array 'nodes' is int64"),
        ("part._rows.rows", np.zeros((2, 2), np.float32), "rows are missing"),
    ],
)
def test_what_does_not_fit_is_refused(state: Arrays, name: str, array: np.ndarray, complaint: str) -> None:
    with pytest.raises(StateError, match=complaint):
        restore(Whole(), {**state, name: array})
    with pytest.raises(StateError, match="there is no array"):
        restore(Whole(), {key: value for key, value in state.items() if key != name})
