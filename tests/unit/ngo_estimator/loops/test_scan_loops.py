"""Loops of key scans have one row in each array, and come back from their state."""

import numpy as np
import pytest

from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig


def some_loops(*pairs: tuple[int, int]) -> ScanLoops:
    count = len(pairs)
    return ScanLoops(
        np.array(pairs), np.ones((count, 3)), np.ones((count, 3, 3)), np.ones((count, len(EVIDENCE))),
        np.ones(count, bool),
    )  # fmt: skip


def test_loops_come_back_from_their_state() -> None:
    loops = ScanLoops.none().extended(some_loops((0, 4), (1, 5)))
    for name, rows in vars(restore(ScanLoops.none(), state_of(loops))).items():
        np.testing.assert_array_equal(rows, getattr(loops, name))


def test_a_state_with_loops_of_other_keys_is_refused() -> None:
    finder = ScanLoopFinder(ScanGraphConfig())
    finder.loops = some_loops((0, 5))
    with pytest.raises(StateError, match="not among the 0"):
        restore(ScanLoopFinder(ScanGraphConfig()), state_of(finder))


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        ScanLoops(np.zeros((2, 2)), np.zeros((1, 3)), np.zeros((2, 3, 3)), np.zeros((2, 6)), np.zeros(2, bool))
