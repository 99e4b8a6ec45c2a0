"""Corrections of the network fit a window that has moved since."""

import numpy as np
import torch

from ngo_estimator.data.state_arrays import restore, state_of
from ngo_estimator.ngo.meta_poses import Correction
from ngo_estimator.slam.network_corrections import NetworkCorrections


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


def test_they_are_restored_as_they_were() -> None:
    given = known()
    restored = restore(NetworkCorrections.none(), state_of(given))
    assert restored.first == given.first
    np.testing.assert_array_equal(restored.adjustment, given.adjustment)
    np.testing.assert_array_equal(restored.stiffness, given.stiffness)
