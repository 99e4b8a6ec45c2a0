"""Where a loop is looked for: distances go through the graph, and windows grow with them."""

import math

import numpy as np

from ngo_estimator.loops.scan_loop_candidates import distance_windows, graph_distances
from ngo_estimator.loops.scan_settings import WindowConfig


def test_the_graphs_distance_goes_over_loops() -> None:
    poses = np.array([(float(k), 0.0, 0.0) for k in range(6)])
    none, loops = np.zeros((0, 2), np.int64), np.array(((0, 4), (0, 4)))
    np.testing.assert_allclose(graph_distances(poses, none, 5), [5, 4, 3, 2, 1, 0], atol=0.01)
    poses[4] = (0.0, 0.5, 0.0)
    np.testing.assert_allclose(
        graph_distances(poses, loops, 4), [0.5, 1.5, 2.5, math.hypot(3.0, 0.5), 0.0, math.hypot(5.0, 0.5)], atol=0.01
    )


def test_windows_grow_with_distance_up_to_their_limit() -> None:
    config = WindowConfig(least_m=0.3, share=0.04, most_m=8.0, least_deg=8.0, deg_per_m=0.25, most_deg=45.0)
    windows = distance_windows(config, np.array((0.0, 100.0, 1000.0)))
    np.testing.assert_allclose(windows[:, 0], (0.3, 4.3, 8.0))
    np.testing.assert_allclose(np.degrees(windows[:, 2]), (8.0, 33.0, 45.0))
