"""Blocks of the odometry: chained steps, unfamiliar ones among them, and joins to another odometry."""

import numpy as np
import pytest

from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.graph.frames import Frames
from ngo_estimator.slam.odometry_blocks import OdometryBlocks
from ngo_estimator.slam.step_log import StepLog
from tests.unit.ngo_estimator.samples import small_optimizer

STEP, VARIANCE = np.array([0.1, 0.0, 0.0], np.float32), np.full(3, 0.01)


def make(frames: Frames | None = None) -> OdometryBlocks:
    return OdometryBlocks(small_optimizer("gauss_newton"), None, 10, StepLog, Frames() if frames is None else frames)


def straight(blocks: int) -> Frames:
    """The frames of a drive straight on."""
    frames = Frames()
    for step in range(8 * blocks):
        frames.append(STEP, joins=False)
        if step % 8 == 7:
            frames.add_node()
    return frames


def drive(blocks: int, unfamiliar: tuple[int, ...] = ()) -> OdometryBlocks:
    """A drive straight on; ``unfamiliar`` are steps."""
    odometry = make(straight(blocks))
    for step in range(8 * blocks):
        odometry.append(STEP, VARIANCE, np.zeros(6, np.float32), step not in unfamiliar)
        if odometry.steps % 8 == 0:
            odometry.complete()
    return odometry


def test_a_block_is_the_chain_of_its_steps() -> None:
    odometry = drive(3)
    assert (odometry.steps, odometry.blocks) == (24, 3)
    np.testing.assert_allclose(odometry.relative.slice(0), np.tile([0.8, 0.0, 0.0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(odometry.std.slice(0)[:, 2] ** 2, 0.08, rtol=1e-5)


def test_unfamiliar_steps_make_a_block_blind() -> None:
    odometry = drive(3, unfamiliar=(8, 9))
    np.testing.assert_allclose(odometry.blind[:, 0] / (0.02 * small_optimizer().config.covariance_scale), [0, 1, 0])


def test_a_recall_takes_sixteen_steps_back() -> None:
    odometry = drive(4)
    assert odometry.is_familiar and odometry.recall() == 16 and not odometry.is_familiar
    np.testing.assert_array_equal(odometry.blind.any(axis=1), [False, False, True, True])


def test_blocks_that_do_not_belong_to_the_steps_are_refused() -> None:
    state = state_of(drive(3))
    restored = restore(make(straight(3)), state)
    np.testing.assert_array_equal(restored.std.slice(0), drive(3).std.slice(0))
    with pytest.raises(StateError, match="do not belong together"):
        restore(make(straight(3)), state | {"_blind.rows": state["_blind.rows"][:-1]})
    with pytest.raises(StateError, match="do not belong together"):
        restore(make(straight(2)), state)
