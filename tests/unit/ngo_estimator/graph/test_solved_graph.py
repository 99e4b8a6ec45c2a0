"""The last optimisation limits how far a loop from a key frame may be off."""

from typing import Any

import numpy as np

from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.solved_graph import SolvedGraph


class Independent:
    """Poses with the variance 1, but node 1 with the variance 2, that know nothing of each other."""

    def covariance(self, nodes: list[int]) -> np.ndarray:
        return np.diag(np.repeat([2.0 if node == 1 else 1.0 for node in nodes], 3))


def solved(information: Any = None) -> SolvedGraph:
    """Of the frames 0 and 3 as key frames, and a window from frame 4 to frame 6."""
    return SolvedGraph(np.array([0, 3, 4, 5, 6]), information)


def chain(last_m: float = 0.0) -> PoseGraph:
    """The frames 0, 2, 3, 4, 5, 6 and 7 as nodes, all at the origin, but the last two."""
    nodes = PoseGraph()
    for frame in range(1, 8):
        nodes.append(np.array((last_m if frame == 6 else 0.0, 0.0, 0.0)), np.zeros((3, 3)))
        if frame > 1:
            nodes.add_node()
    nodes.restate(0, nodes.relative.copy(), np.full((6, 3), 0.25))
    return nodes


WINDOW = 3
"""Node where the window begins: frame 4."""


def test_before_the_first_optimisation_there_is_no_limit() -> None:
    for graph in (SolvedGraph.none(), solved()):
        assert np.isinf(graph.most_drift(np.array([0, 2]), WINDOW, chain(), 1.0)).all()


def test_the_limit_is_four_times_the_variance_between_the_two_poses() -> None:
    limits = solved(Independent()).most_drift(np.array([0, 2, 1, 4]), WINDOW, chain(), 10.0)
    # The origin is known; the last step's own variance comes on top, which is scaled already.
    np.testing.assert_allclose(limits[0], 4.0 * (10.0 * 1.0 + 0.25))
    np.testing.assert_allclose(limits[1], 4.0 * (10.0 * (1.0 + 2.0) + 0.25))
    assert np.isinf(limits[2:]).all()  # no key frame, and a node of the window


def test_heading_counts_by_the_distance() -> None:
    limits = solved(Independent()).most_drift(np.array([2]), WINDOW, chain(2.0), 1.0)
    np.testing.assert_allclose(limits[0], 4.0 * (np.array([3.0, 3.0 + 2.0 * 2.0**2, 3.0]) + 0.25))


def test_where_the_window_has_left_all_of_it_behind_there_is_no_limit() -> None:
    assert np.isinf(solved(Independent()).most_drift(np.array([2]), 6, chain(), 1.0)).all()
