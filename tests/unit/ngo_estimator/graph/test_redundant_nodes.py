"""Old nodes leave a graph where newer ones show the same place, and none leaves a place alone."""

import math

import numpy as np

from ngo_estimator.graph.redundant_nodes import redundant_nodes

NONE = np.zeros(0, np.int64)


def circles(rounds: int) -> np.ndarray:
    turn = np.linspace(0.0, 2.0 * rounds * math.pi, 60 * rounds, endpoint=False)
    return np.column_stack((3.0 * np.sin(turn), -3.0 * np.cos(turn), turn))


def line(count: int) -> np.ndarray:
    return np.column_stack((10.0 + 0.3 * np.arange(count), np.zeros((count, 2))))


def newest(poses: np.ndarray, count: int) -> np.ndarray:
    return np.arange(len(poses)) >= len(poses) - count


def test_the_oldest_of_five_rounds_leave_and_every_place_stays() -> None:
    poses = np.concatenate((circles(5), line(60)))
    leaves = redundant_nodes(poses, NONE, np.zeros(len(poses)), newest(poses, 15), 180)
    assert 180 <= leaves.sum() < 180 + 30 and not leaves[240:].any()
    kept = poses[:300][~leaves[:300]]
    assert np.linalg.norm(poses[:300, None, :2] - kept[None, :, :2], axis=-1).min(1).max() < 1.0


def test_nothing_leaves_where_everything_was_seen_once() -> None:
    assert not redundant_nodes(line(200), NONE, np.zeros(200), newest(line(200), 30), 150).any()


def test_a_place_seen_in_another_direction_is_another_view() -> None:
    there, back = line(100), line(100)[::-1].copy()
    back[:, 2] = math.pi
    poses = np.concatenate((there, back))
    assert not redundant_nodes(poses, NONE, np.zeros(200), newest(poses, 0), 150).any()


def test_only_in_one_part_of_the_map_do_poses_say_what_is_near() -> None:
    poses, parts = circles(2), np.repeat((0, 1), 60)
    assert redundant_nodes(poses, NONE, np.zeros(120), newest(poses, 0), 60).any()
    assert not redundant_nodes(poses, np.array((60,)), parts, newest(poses, 0), 60).any()


def test_runs_do_not_reach_over_a_border() -> None:
    poses = circles(3)
    borders = np.array((70, 75, 120))
    leaves = redundant_nodes(poses, borders, np.zeros(180), newest(poses, 60), 10)
    first, last = np.flatnonzero(leaves)[[0, -1]]
    stretch = np.searchsorted(borders, (first, last), side="right")
    assert leaves[first : last + 1].all() and stretch[0] == stretch[1]
