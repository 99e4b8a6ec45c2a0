"""Corrections across unfamiliar stretches are worth what is known of the motion within."""

import numpy as np

from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.slam.blind_stretches import shrunk_corrections, summed_variances

NODES = 12
ODOMETRY = np.stack((np.arange(NODES, dtype=float), np.zeros(NODES), np.zeros(NODES)), axis=1)
CORRECTED = ODOMETRY + [0.0, 1.0, 0.0]
NO_LOOPS = np.zeros((0, 2), np.int64), np.zeros(0)


def blind(variance: float, steps: slice = slice(4, 8)) -> np.ndarray:
    of_steps = np.zeros((NODES - 1, 3))
    of_steps[steps, :2] = variance
    return of_steps


def test_where_all_is_familiar_nothing_changes() -> None:
    assert shrunk_corrections(CORRECTED, ODOMETRY, blind(0.0), *NO_LOOPS) is CORRECTED


def test_a_correction_smaller_than_the_unknown_motion_gives_way_to_the_odometry() -> None:
    poses = shrunk_corrections(CORRECTED, ODOMETRY, blind(2.0), *NO_LOOPS)
    np.testing.assert_allclose(poses[:5], CORRECTED[:5])
    np.testing.assert_allclose(poses[5:], ODOMETRY[5:], atol=1e-12)


def test_it_is_shrunk_by_the_rule_of_james_and_stein() -> None:
    poses = shrunk_corrections(CORRECTED, ODOMETRY, blind(0.1), *NO_LOOPS)
    # After two blind steps the correction of 1 m is of squared size 1 / 0.2 in their deviations.
    np.testing.assert_allclose(poses[6], [6.0, 1.0 - 0.2, 0.0])
    np.testing.assert_allclose(poses[8:, 1], 1.0 - 0.4)


def test_a_correction_of_many_deviations_stays() -> None:
    far = ODOMETRY + [0.0, 100.0, 0.0]
    np.testing.assert_allclose(shrunk_corrections(far, ODOMETRY, blind(1.0), *NO_LOOPS), far, atol=0.1)


def test_a_believed_loop_across_the_stretch_keeps_the_correction() -> None:
    loop = np.array([[2, 10]])
    np.testing.assert_array_equal(shrunk_corrections(CORRECTED, ODOMETRY, blind(2.0), loop, np.ones(1)), CORRECTED)
    doubted = shrunk_corrections(CORRECTED, ODOMETRY, blind(2.0), loop, np.full(1, 0.1))
    np.testing.assert_allclose(doubted[8:], ODOMETRY[8:], atol=1e-12)


def test_what_is_corrected_behind_a_stretch_moves_as_a_whole() -> None:
    bent = CORRECTED.copy()
    bent[9:] += [0.3, -0.2, 0.1]
    poses = shrunk_corrections(bent, ODOMETRY, blind(2.0), *NO_LOOPS)
    for k in range(8, NODES):
        np.testing.assert_allclose(between(poses[8], poses[k]), between(bent[8], bent[k]), atol=1e-12)


def test_headings_are_compared_the_short_way_round() -> None:
    turned = CORRECTED.copy()
    turned[:, 2] += 2.0 * np.pi
    poses = shrunk_corrections(turned, ODOMETRY, blind(2.0), *NO_LOOPS)
    np.testing.assert_allclose(np.cos(poses[8:, 2]), 1.0)
    np.testing.assert_allclose(poses[8:, :2], ODOMETRY[8:, :2], atol=1e-12)


def test_variances_add_up_between_key_frames() -> None:
    variance = np.arange(12.0).reshape(4, 3)
    summed = summed_variances(variance, np.array([0, 3, 4]))
    np.testing.assert_array_equal(summed, [variance[:3].sum(0), variance[3]])
