"""Blocks of the odometry: chained steps, unfamiliar ones among them, and joins to another odometry."""

import numpy as np
import pytest

from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.graph.key_frames import KeyFrames
from ngo_estimator.graph.pose_graph import PoseGraph
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
