"""Loops of pictures: how far they may be off, and that those which were taken out stay away."""

import numpy as np
import pytest
import torch

from ngo_estimator.data.state_arrays import restore, state_of
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.loops.pair_measurement import PairMeasurement
from ngo_estimator.loops.place_loop_finder import PlaceLoopFinder
from ngo_estimator.loops.place_loops import PlaceLoops
from tests.unit.ngo_estimator.samples import small_pair_head


def loop(start: int, end: int) -> PlaceLoops:
    """A loop along a line of nodes that are a metre apart."""
    relative, nothing = torch.tensor([[float(end - start), 0.0, 0.0]]), torch.zeros(1, 2)
    measured = PairMeasurement(relative, nothing, nothing)
    return PlaceLoops.found(np.array([start]), end, np.array([start - 1]), measured, np.ones(1), np.ones(1), False)


@pytest.mark.parametrize("closed", [True, False])
def test_a_loop_from_a_key_frame_is_as_sure_as_the_loops_that_were_closed_before(closed: bool) -> None:
    graph, keys, nothing = PoseGraph(), KeyFrames(2), np.zeros((1, 0), np.float32)
    for _ in range(5):
        graph.append(np.array((1.0, 0.0, 0.0)), np.diag((0.1, 0.1, 1e-9)))
        graph.add_node()
    for _ in range(2):
        keys.add(KeyFrame(nothing, nothing, np.zeros((1, 3))))
    finder = PlaceLoopFinder(small_pair_head(), LoopSearch(), 1, 8, graph, keys, scale=2.0)
    finder.loops = loop(0, 4).extended(loop(1, 5))
    if closed:
        finder.weigh(np.array([0]), np.ones(1), np.array([[100.0, 100.0, 1e9]]))
    finder._limit_drift(np.array([1]))
    # Back by a step, over the loop, and on by a step; the variance is four times as large as the graph says.
    expected = 4.0 * 2.0 * (0.1 + 0.01 + 0.1) if closed else np.inf
    np.testing.assert_allclose(finder.loops.most_drift[1, :2], expected, rtol=1e-3)
    assert np.isinf(finder.loops.most_drift[0]).all()


def test_a_loop_that_was_taken_out_stays_away_when_the_state_is_loaded() -> None:
    head, graph = small_pair_head(), PoseGraph()
    original, loaded = (PlaceLoopFinder(head, LoopSearch(), 1, 8, graph, KeyFrames(2), scale=1.0) for _ in range(2))
    for _ in range(5):
        graph.append(np.array((1.0, 0.0, 0.0)), np.eye(3))
        graph.add_node()
        original.append(np.zeros(head.config.code_length, np.float32))
    original.loops = loop(0, 4).extended(loop(1, 5))
    assert original.drop(np.array([False, True])) == 1
    restore(loaded, state_of(original))
    np.testing.assert_array_equal(loaded.loops.pairs, ((0, 4),))
    np.testing.assert_array_equal(loaded._dropped, ((1, 5),))
