"""Frames follow the nodes of the graph, and a saved graph is one piece."""

from collections.abc import Callable

import numpy as np
import pytest

from ngo_estimator.data.state_arrays import Arrays, StateError, restore, state_of
from ngo_estimator.graph.marginalisation import NeighbourTree
from ngo_estimator.graph.pose_graph import PoseGraph

STEP, COVARIANCE = np.array((1.0, 0.0, 0.0)), np.diag((0.1, 0.2, 0.3))
FLOOR = np.diag((1e-4, 1e-4, 1e-6))


def straight(joins: bool = False) -> PoseGraph:
    """Five frames on a line, of which the first, the third and the last but one are nodes."""
    chain = PoseGraph(FLOOR)
    for frame in range(1, 5):
        joined = joins and frame == 2
        chain.append(STEP, COVARIANCE, joined)
        if frame in (2, 3):
            chain.add_node(COVARIANCE)
    return chain


def test_frames_between_two_nodes_share_what_an_optimisation_moved() -> None:
    chain = straight()
    chain.move(np.array(((0.0, 0.0, 0.0), (2.4, 0.0, 0.0), (3.4, 0.2, 0.0))), FLOOR)
    np.testing.assert_allclose(chain.frame_poses()[:, 0], (0.0, 1.2, 2.4, 3.4, 4.4))
    np.testing.assert_allclose(chain.frame_poses(before=True)[:, 0], (0.0, 1.0, 2.0, 3.0, 4.0))
    assert chain.largest_move_m == pytest.approx(np.hypot(0.4, 0.2))


def test_where_another_odometry_goes_on_the_frames_before_stay() -> None:
    chain = straight(joins=True)
    chain.move(np.array(((0.0, 0.0, 0.0), (2.4, 0.0, 0.0), (3.4, 0.0, 0.0))), FLOOR)
    np.testing.assert_allclose(chain.frame_poses()[:, 0], (0.0, 1.0, 2.4, 3.4, 4.4))


def test_no_frame_moves_when_nodes_go_and_those_in_the_gap_stay_as_they_were_corrected() -> None:
    chain, corrected = straight(), np.array(((0.0, 0.0, 0.0), (2.4, 0.3, 0.1), (3.4, 0.2, 0.0)))
    chain.move(corrected, FLOOR)
    frames, end = chain.frame_poses(), chain.newest()
    bridge = NeighbourTree(np.array(((0, 2),)), corrected[None, 2], COVARIANCE[None])
    chain.let_go(np.array((True, False, True)), bridge)
    assert chain.frames.nodes.tolist() == [0, 3] and chain.borders.tolist() == [0, 1]
    np.testing.assert_allclose(chain.frame_poses(), frames, atol=1e-12)
    np.testing.assert_allclose(chain.newest()[0], end[0], atol=1e-12)
    np.testing.assert_allclose(chain.newest()[1], end[1])
    np.testing.assert_allclose(chain.step_covariance[0], COVARIANCE + FLOOR)
    # Both ends move together: what was corrected in the gap moves along.
    chain.move(np.array(((1.0, 0.0, 0.0), (4.4, 0.2, 0.0))), FLOOR)
    np.testing.assert_allclose(chain.frame_poses(), frames + (1.0, 0.0, 0.0), atol=1e-12)


def test_errors_add_up_over_a_gap_and_one_of_the_heading_swings_all_behind() -> None:
    """A step ahead, one to the left after a turn by a right angle: an error of the first turn moves the end along y."""
    graph, turned = PoseGraph(), np.array((1.0, 0.0, np.pi / 2))
    for relative in (turned, STEP, STEP):
        graph.append(relative, COVARIANCE)
        graph.add_node()
    graph.restate(0, np.stack((turned, STEP, STEP)), np.tile((0.1, 0.2, 0.3), (3, 1)))
    graph.let_go(np.array((True, False, True, True)))
    np.testing.assert_allclose(graph.relative, ((1.0, 1.0, np.pi / 2), STEP), atol=1e-12)
    expected = (0.1 + 0.2 + 0.3 * 1.0**2, 0.2 + 0.1, 0.6)
    np.testing.assert_allclose(np.diagonal(graph.step_covariance[0]), expected)
    np.testing.assert_allclose(graph.step_covariance[1], COVARIANCE)


def test_a_chain_comes_back_from_its_state() -> None:
    expected = state_of(straight(joins=True))
    found = state_of(restore(PoseGraph(FLOOR), expected))
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array)


@pytest.mark.parametrize(
    "damage",
    [
        lambda state: {"frames._nodes.rows": state["frames._nodes.rows"][:-1]},
        lambda state: {"frames._nodes.rows": state["frames._nodes.rows"][::-1].copy()},
        lambda state: {"frames._joins.rows": np.array((9,))},
        lambda state: {"_before": np.zeros((4, 3))},
        lambda state: {"_steps.rows": state["_steps.rows"][:-1]},
    ],
)
def test_parts_that_do_not_belong_together_are_refused(damage: Callable[[Arrays], Arrays]) -> None:
    state = state_of(straight())
    with pytest.raises(StateError, match=r"there are not|not there|moved"):
        restore(PoseGraph(FLOOR), {**state, **damage(state)})


def test_a_stream_that_goes_on_finds_all_frames_where_they_were() -> None:
    """Two odometries in turn give each stream what it would have alone, and no frame of the other moves."""
    alone, both = straight(), straight()
    both.begin_stream(5)
    both.open_segment()
    both.append(np.array((0.0, 3.0, 1.0)), COVARIANCE, joins=True)
    both.add_node()
    both.append(STEP, COVARIANCE)
    assert both.segments.tolist() == both.streams.tolist() == [0, 3] and both.stream_ends.tolist() == [2, 3]
    frames, newest = both.frame_poses(), both.newest()
    nodes, order = both.go_on_with(0)
    assert nodes.tolist() == [3, 0, 1, 2] and order.tolist() == [5, 6, 0, 1, 2, 3, 4]
    assert both.ranks.tolist() == [5, 0] and both.rank_of_frames.tolist() == [5, 5, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(both.frame_poses(), frames[order], atol=1e-12)
    for graph in (alone, both):
        graph.append(STEP, COVARIANCE)
        graph.add_node()
    for found, expected in zip((*both.newest(), both.newest_of(5)[1]), (*alone.newest(), newest[1]), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(both.step_covariance[1:], alone.step_covariance)
    both.go_on_with(5)
    np.testing.assert_allclose(both.newest()[0], newest[0], atol=1e-12)
    assert both.segments.tolist() == both.streams.tolist() == [0, 4]


def test_each_stream_has_the_covariance_of_its_end() -> None:
    both = straight()
    both.begin_stream(1)
    both.open_segment()
    both.append(STEP, COVARIANCE, joins=True)
    both.add_node()
    both.move(both.poses.copy(), 2.0 * FLOOR, FLOOR)
    np.testing.assert_array_equal(both.newest()[1], FLOOR)
    both.go_on_with(0)
    np.testing.assert_array_equal(both.end, 2.0 * FLOOR)
