"""Nodes that are not optimised move with the key frames around them."""

import numpy as np
import pytest

from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.graph import key_frames
from ngo_estimator.graph.key_frames import KeyFrame
from ngo_estimator.graph.meta_nodes import MetaNodes

NO_CODES = (8, 0)


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> MetaNodes:
    """Nodes 1 m apart; the window begins at node 5, and of the key frames 0 and 4 are left."""
    monkeypatch.setattr(key_frames, "SLACK", 3)
    nodes, nothing = MetaNodes(2), np.zeros(NO_CODES, np.float32)
    for _ in range(7):
        nodes.append(np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)))
        nodes.add_node()
    for node in range(5):
        nodes.leave(KeyFrame(node, nodes.step(), np.full(3, 0.01), nothing, nothing, np.zeros((8, 3))))
    assert nodes.keys.crowded
    before, stay, poses, variance = nodes.thin()
    np.testing.assert_array_equal(before, np.arange(5))
    np.testing.assert_array_equal(stay, [True, False, False, False, True])
    np.testing.assert_array_equal(poses[:, 0], np.arange(5.0))
    assert variance.shape == (5, 3)
    return nodes


def test_key_frames_and_the_window_are_optimised(nodes: MetaNodes) -> None:
    np.testing.assert_array_equal(nodes.active, [0, 4, 5, 6, 7])
    np.testing.assert_array_equal(nodes.relative[:, 0], [4.0, 1.0, 1.0, 1.0])


def test_a_correction_is_spread_over_the_nodes_between_two_key_frames(nodes: MetaNodes) -> None:
    before = nodes.node_poses()
    moved = before[nodes.active] + np.where(nodes.active > 0, 0.4, 0.0)[:, None] * [0.0, 1.0, 0.0]
    nodes.move(nodes.active, moved, np.eye(3))
    assert nodes.largest_move_m == pytest.approx(0.4)
    np.testing.assert_allclose(nodes.node_poses()[:, 1], [0.0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4])
    np.testing.assert_allclose(nodes.node_poses()[:, 0], before[:, 0])
    np.testing.assert_array_equal(nodes.node_poses(before=True), before)


def test_nodes_are_restored_as_they_were(nodes: MetaNodes) -> None:
    nodes.move(nodes.active[1:], nodes.poses[nodes.active[1:]] + [0.0, 0.4, 0.0], np.eye(3))
    restored = restore(MetaNodes(2), state_of(nodes))
    assert restored.first == 5 and restored.largest_move_m == nodes.largest_move_m
    np.testing.assert_array_equal(restored.node_poses(), nodes.node_poses())
    np.testing.assert_array_equal(restored.node_poses(before=True), nodes.node_poses(before=True))
    with pytest.raises(StateError, match="key frames do not end where the window begins"):
        restore(MetaNodes(2), state_of(nodes) | {"first": np.array(4)})
