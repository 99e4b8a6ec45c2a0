"""Wheel odometry is exact without errors, and each error does what its field says."""

import numpy as np
import pytest

from ngo_sim.building_drivers import arc_end
from ngo_sim.wheels import WheelOdometry, WheelsConfig, draw_wheels

PERIOD_S = 0.1


def driven(motions: np.ndarray, seed: int = 0, **errors: float) -> np.ndarray:
    config = WheelsConfig(**{"wheel_noise": 0.0, **errors})
    return WheelOdometry(config, PERIOD_S, np.random.default_rng(seed)).advance(motions)


def straight(metres: float, steps: int) -> np.ndarray:
    return np.tile((metres / steps, 0.0), (steps, 1))


def test_without_errors_it_is_the_true_motion() -> None:
    rng = np.random.default_rng(1)
    motions = np.stack((rng.uniform(-0.1, 0.1, 200), rng.uniform(-0.2, 0.2, 200)), axis=1)
    pose, expected = np.zeros(3), []
    for way, turn in motions:
        pose = arc_end(pose, way / PERIOD_S, turn / PERIOD_S, PERIOD_S)
        expected.append(pose)
    np.testing.assert_allclose(driven(motions), expected, atol=1e-12)


def test_equal_bias_stretches_the_way_and_unequal_bias_turns() -> None:
    x, y, yaw = driven(straight(10.0, 100), left_bias=0.02, right_bias=0.02)[-1]
    assert (x, y, yaw) == (pytest.approx(10.2), 0.0, 0.0)
    # The right wheel counts 10.05 m, the left one 10 m, half a metre apart: 0.1 rad to the left.
    _, y, yaw = driven(straight(10.0, 100), right_bias=0.005, track_m=0.5)[-1]
    assert yaw == pytest.approx(0.1) and y > 0.4


def test_noise_grows_with_the_root_of_the_way() -> None:
    ends = np.array([driven(straight(4.0, 40), seed, wheel_noise=0.02, track_m=2.0)[-1, 0] for seed in range(400)])
    # The mean of two wheels of 0.02 m a root metre each, after 4 m; a wide track keeps it straight.
    assert np.std(ends) == pytest.approx(0.02 * 2 / np.sqrt(2), rel=0.15)


def test_a_freeze_stands_still_for_about_a_second_and_then_catches_up() -> None:
    poses = driven(straight(100.0, 2000), freezes_per_hour=200.0)
    steps = np.diff(poses[:, 0])
    jumps = np.flatnonzero(steps > 0.06)
    assert len(jumps) > 3
    for jump in jumps:
        frozen = np.flatnonzero(steps[:jump] > 0.0)[-1]
        assert 0.6 <= (jump - frozen) * PERIOD_S <= 1.5
        assert steps[jump] == pytest.approx(0.05 * (jump - frozen), abs=1e-9)
    assert poses[-50:, 0].max() == pytest.approx(100.0, abs=2.6), "nothing is lost"


def test_slips_change_the_way_in_bursts_and_jumps_need_no_motion() -> None:
    slipped = driven(straight(500.0, 5000), slips_per_km=50.0)
    turns = np.abs(np.diff(np.unwrap(slipped[:, 2])))
    assert 0.02 < (turns > 1e-6).mean() < 0.5
    standing = driven(np.zeros((5000, 2)), jumps_per_hour=100.0, jump_m=0.3)
    moved = np.hypot(*np.diff(standing[:, :2], axis=0).T)
    assert 3 <= (moved > 0.0).sum() <= 40 and moved.max() > 0.1


def test_one_by_one_equals_all_at_once() -> None:
    config = draw_wheels(np.random.default_rng(3))
    motions = np.random.default_rng(4).uniform(0.0, 0.1, (300, 2))
    together = WheelOdometry(config, PERIOD_S, np.random.default_rng(5)).advance(motions)
    single = WheelOdometry(config, PERIOD_S, np.random.default_rng(5))
    np.testing.assert_array_equal(np.concatenate([single.advance(motion[None]) for motion in motions]), together)
    np.testing.assert_array_equal(single.pose_xyyaw, together[-1])
