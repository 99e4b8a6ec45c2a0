"""Frames follow the nodes of the chain, and a saved chain is one piece."""

from collections.abc import Callable

import numpy as np
import pytest

from ngo_estimator.data.relative_step import KeyScanStep
from ngo_estimator.data.state_arrays import Arrays, StateError, restore, state_of
from ngo_estimator.geometry.key_scan import no_scan
from ngo_estimator.graph.key_scan_chain import KeyScanChain
from ngo_estimator.graph.marginalisation import NeighbourTree

STEP, COVARIANCE = np.array((1.0, 0.0, 0.0)), np.diag((0.1, 0.2, 0.3))
FLOOR = np.diag((1e-4, 1e-4, 1e-6))


def straight(joins: bool = False) -> KeyScanChain:
    """Five frames on a line, of which the first, the third and the last but one are nodes."""
    chain = KeyScanChain(FLOOR)
    chain.begin_at(0)
    for frame in range(1, 5):
        joined = joins and frame == 2
        chain.append(STEP, COVARIANCE, joined)
        if frame in (2, 3):
            key = KeyScanStep(no_scan(frame), (0, 2)[frame - 2], STEP, COVARIANCE)
            chain.add_key(key, joined)
    return chain


def test_frames_between_two_nodes_share_what_an_optimisation_moved() -> None:
    chain = straight()
    chain.move(np.arange(3), np.array(((0.0, 0.0, 0.0), (2.4, 0.0, 0.0), (3.4, 0.2, 0.0))), FLOOR)
    np.testing.assert_allclose(chain.frame_poses()[:, 0], (0.0, 1.2, 2.4, 3.4, 4.4))
    np.testing.assert_allclose(chain.frame_poses(before=True)[:, 0], (0.0, 1.0, 2.0, 3.0, 4.0))
    assert chain.largest_move_m == pytest.approx(np.hypot(0.4, 0.2))


def test_where_another_odometry_goes_on_the_frames_before_stay() -> None:
    chain = straight(joins=True)
    chain.move(np.arange(3), np.array(((0.0, 0.0, 0.0), (2.4, 0.0, 0.0), (3.4, 0.0, 0.0))), FLOOR)
    np.testing.assert_allclose(chain.frame_poses()[:, 0], (0.0, 1.0, 2.4, 3.4, 4.4))


def test_a_step_in_the_same_key_scans_is_as_sure_as_its_registration() -> None:
    np.testing.assert_allclose(straight().step_covariance, np.tile(COVARIANCE + FLOOR, (2, 1, 1)))
    # The motion where another odometry goes on is that of the frames: nothing was registered.
    unknown = straight(joins=True).step_covariance[0]
    np.testing.assert_allclose(np.diagonal(unknown), np.array((0.2, 0.4 + 0.3, 0.6)) + np.diagonal(FLOOR))


def test_no_frame_moves_when_nodes_go_and_those_in_the_gap_stay_as_they_were_corrected() -> None:
    chain, corrected = straight(), np.array(((0.0, 0.0, 0.0), (2.4, 0.3, 0.1), (3.4, 0.2, 0.0)))
    chain.move(np.arange(3), corrected, FLOOR)
    frames, end = chain.frame_poses(), chain.newest()
    bridge = NeighbourTree(np.array(((0, 2),)), corrected[None, 2], COVARIANCE[None])
    chain.bridge(np.array((True, False, True)), bridge)
    assert chain.frames.nodes.tolist() == [0, 3] and chain.borders.tolist() == [0, 1]
    np.testing.assert_allclose(chain.frame_poses(), frames, atol=1e-12)
    np.testing.assert_allclose(chain.newest()[0], end[0], atol=1e-12)
    np.testing.assert_allclose(chain.newest()[1], end[1])
    np.testing.assert_allclose(chain.step_covariance[0], COVARIANCE + FLOOR)
    # Both ends move together: what was corrected in the gap moves along.
    chain.move(np.arange(2), np.array(((1.0, 0.0, 0.0), (4.4, 0.2, 0.0))), FLOOR)
    np.testing.assert_allclose(chain.frame_poses(), frames + (1.0, 0.0, 0.0), atol=1e-12)


def test_a_chain_comes_back_from_its_state() -> None:
    expected = state_of(straight(joins=True))
    found = state_of(restore(KeyScanChain(FLOOR), expected))
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
        lambda state: {"_moved": np.arange(9), "_before": np.zeros((9, 3))},
    ],
)
def test_parts_that_do_not_belong_together_are_refused(damage: Callable[[Arrays], Arrays]) -> None:
    state = state_of(straight())
    with pytest.raises(StateError, match=r"there are not|not there|moved"):
        restore(KeyScanChain(FLOOR), {**state, **damage(state)})
