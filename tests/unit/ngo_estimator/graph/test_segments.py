"""Segments of a chain are joined by loops, over other segments as well."""

import numpy as np
import pytest

from ngo_estimator.graph.segments import anchors, joined_parts, segment_of

SEGMENTS = np.array((0, 10, 20, 30))


def test_a_node_is_of_the_segment_that_began_last() -> None:
    np.testing.assert_array_equal(segment_of(SEGMENTS, np.array(((0, 9), (10, 35)))), ((0, 0), (1, 3)))


@pytest.mark.parametrize(
    ("pairs", "parts"),
    [
        ([], (0, 1, 2, 3)),
        ([(1, 8)], (0, 1, 2, 3)),
        ([(5, 25)], (0, 1, 0, 3)),
        ([(12, 35), (5, 25)], (0, 1, 0, 1)),
        ([(22, 35), (12, 25), (5, 15)], (0, 0, 0, 0)),
    ],
)
def test_loops_join_segments(pairs: list[tuple[int, int]], parts: tuple[int, ...]) -> None:
    np.testing.assert_array_equal(joined_parts(SEGMENTS, np.array(pairs, np.int64).reshape(-1, 2)), parts)


def test_a_part_of_the_map_begins_with_its_segment_of_the_lowest_rank() -> None:
    found = anchors(SEGMENTS, np.array((0, 1, 0, 1)), np.array((7, 3, 2, 3)))
    np.testing.assert_array_equal(found, (20, 10, 20, 10))
