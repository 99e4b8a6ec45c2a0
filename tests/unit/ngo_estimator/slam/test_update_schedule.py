"""Parts of an update are spread over the steps of a block, and work is repeated the more often the less it saw."""

import numpy as np
import pytest

from ngo_estimator.ngo.meta_poses import OptimizedMetaPoses
from ngo_estimator.slam.update_schedule import RunningOptimisation, is_due, parts_now


def done_in(parts: int, least: int, steps: int, light: bool) -> list[int]:
    """Parts that each of the steps of a block does."""
    done: list[int] = []
    for left in range(steps, 0, -1):
        done.append(parts_now(least, parts - sum(done), left, light))
    return done


@pytest.mark.parametrize("light", [False, True])
@pytest.mark.parametrize("least", [0, 1, 3])
@pytest.mark.parametrize("parts", range(20))
def test_all_parts_are_done_before_the_next_block(parts: int, least: int, light: bool) -> None:
    done = done_in(parts, least, 8, light)
    assert sum(done) == parts and max(done) <= max(least, -(-parts // 8))


def test_light_parts_come_last() -> None:
    assert done_in(10, 1, 8, light=False) == [2, 2, 1, 1, 1, 1, 1, 1]
    assert done_in(10, 1, 8, light=True) == [1, 1, 1, 1, 1, 1, 2, 2]


def test_a_short_trajectory_is_judged_anew_more_often() -> None:
    assert is_due(since=1, seen=4, every=32)
    assert not is_due(since=1, seen=8, every=32) and is_due(since=2, seen=8, every=32)
    assert not is_due(since=31, seen=1000, every=32) and is_due(since=32, seen=1000, every=32)


@pytest.mark.parametrize("runs_network", [False, True])
def test_a_network_costs_a_part_more(runs_network: bool) -> None:
    results = (OptimizedMetaPoses([], None, None, left=left) for left in (2, 1, 0))  # type: ignore[arg-type]
    running = RunningOptimisation(results, np.zeros(0, np.int64), runs_network, anneals=True)
    while not running.done:
        running.advance()
    assert running.parts == 3 + runs_network
