"""Neighbouring loops that say the same count for each other; one that says something else counts for none."""

import numpy as np

from ngo_estimator.loops.scan_loop_agreement import with_agreement
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanLoopConfig

# Along a straight line and back over the same places.
POSES = np.array([(float(min(k, 19 - k)), 0.0, 0.0 if k < 10 else np.pi) for k in range(20)])


def loop(earlier: int, later: int, off_m: float = 0.0) -> ScanLoops:
    """A loop of two keys in one place, which look in opposite directions."""
    return ScanLoops(
        np.array(((earlier, later),)), np.array(((off_m, 0.0, np.pi),)), np.eye(3)[None], np.zeros((1, len(EVIDENCE))),
        np.zeros(1, bool),
    )  # fmt: skip


def test_neighbours_that_agree_count_for_each_other() -> None:
    loops = loop(3, 16).extended(loop(2, 17, off_m=1.0)).extended(loop(1, 18))
    counted = with_agreement(ScanLoopConfig(), loops, 2, POSES)
    np.testing.assert_array_equal(counted.agreeing, (1, 0, 1))
    np.testing.assert_array_equal(counted.accepted, (True, False, True))
    assert not loops.agreeing.any()


def test_loops_of_one_key_are_no_neighbours() -> None:
    counted = with_agreement(ScanLoopConfig(), loop(3, 16).extended(loop(3, 16)), 1, POSES)
    assert not counted.agreeing.any() and not counted.accepted.any()
