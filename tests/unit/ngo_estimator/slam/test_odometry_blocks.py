"""What the graph of pictures keeps beside its poses: blocks of odometry, and corrections of the network."""

import numpy as np
import pytest
import torch

from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.graph.key_frames import KeyFrames
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.ngo.meta_poses import Correction
from ngo_estimator.slam.network_corrections import NetworkCorrections
from ngo_estimator.slam.odometry_blocks import OdometryBlocks
from ngo_estimator.slam.step_log import StepLog
from tests.unit.ngo_estimator.samples import small_optimizer

STEP, VARIANCE = np.array([0.1, 0.0, 0.0], np.float32), np.full(3, 0.01)


def make(graph: PoseGraph | None = None) -> OdometryBlocks:
    optimizer = small_optimizer("gauss_newton")
    return OdometryBlocks(optimizer, None, 10, StepLog, PoseGraph() if graph is None else graph, KeyFrames(2))


def drive(blocks: int, unfamiliar: tuple[int, ...] = ()) -> OdometryBlocks:
    """A drive straight on; ``unfamiliar`` are steps."""
    odometry = make()
    for step in range(8 * blocks):
        odometry._graph.append(STEP, np.diag(VARIANCE))
        odometry.append(STEP, VARIANCE, np.zeros(6, np.float32), step not in unfamiliar)
        if odometry.steps % 8 == 0:
            odometry.complete()
    return odometry


def test_a_block_is_the_chain_of_its_steps() -> None:
    odometry = drive(3)
    assert (odometry.steps, odometry.blocks) == (24, 3)
    np.testing.assert_allclose(odometry._graph.relative, np.tile([0.8, 0.0, 0.0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(odometry._graph.step_covariance[:, 2, 2], 0.08, rtol=1e-5)


def test_unfamiliar_steps_make_a_block_blind() -> None:
    odometry = drive(3, unfamiliar=(8, 9))
    np.testing.assert_allclose(odometry.blind[:, 0] / (0.02 * small_optimizer().config.covariance_scale), [0, 1, 0])


def test_a_recall_takes_sixteen_steps_back() -> None:
    odometry = drive(4)
    assert odometry.is_familiar and odometry.recall() == 16 and not odometry.is_familiar
    np.testing.assert_array_equal(odometry.blind.any(axis=1), [False, False, True, True])


def test_blocks_that_do_not_belong_to_the_steps_are_refused() -> None:
    state = state_of(drive(3))
    restored = restore(make(drive(3)._graph), state)
    np.testing.assert_array_equal(restored.optimized_std.slice(0), drive(3).optimized_std.slice(0))
    with pytest.raises(StateError, match="do not belong together"):
        restore(make(drive(3)._graph), state | {"_blind.rows": state["_blind.rows"][:-1]})
    with pytest.raises(StateError, match="do not belong together"):
        restore(make(drive(2)._graph), state)


def known() -> NetworkCorrections:
    """Of two iterations, for the blocks 5, 6 and 7."""
    adjustment = torch.arange(18, dtype=torch.float32).reshape(2, 1, 3, 3)
    return NetworkCorrections.of(5, [Correction(each, each + 100.0) for each in adjustment])


def test_old_blocks_are_left_out_and_new_ones_are_stiff_and_not_adjusted() -> None:
    given = known()
    assert given.last == 8
    for iteration, correction in enumerate(given.for_blocks(6, 10)):
        assert correction.adjustment.shape == correction.stiffness.shape == (1, 4, 3)
        np.testing.assert_array_equal(correction.adjustment[0, :2], given.adjustment[iteration, 1:])
        np.testing.assert_array_equal(correction.stiffness[0, :2], given.stiffness[iteration, 1:])
        assert not correction.adjustment[0, 2:].any()
        for new in correction.stiffness[0, 2:]:
            np.testing.assert_array_equal(new, given.stiffness[iteration, -1])
    adjustments, stiffness = zip(*given.for_blocks(6, 10), strict=True)
    summed = given.summed(6, 10)
    np.testing.assert_array_equal(summed[0], sum(adjustments)[0])
    np.testing.assert_array_equal(summed[1], stiffness[-1][0])


def test_they_are_restored_as_they_were() -> None:
    given = known()
    restored = restore(NetworkCorrections.none(), state_of(given))
    assert restored.first == given.first
    np.testing.assert_array_equal(restored.adjustment, given.adjustment)
    np.testing.assert_array_equal(restored.stiffness, given.stiffness)
