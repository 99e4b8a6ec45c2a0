"""Stamps of bunches, and the wheels' pose among them."""

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.stamped_wheels import StampedWheels

MS = 1_000_000


def driven(stamps_ms: list[float]) -> StampedWheels:
    """Wheels that went 10 cm between two readings, stamped as given."""
    wheels = StampedWheels()
    for k, stamp_ms in enumerate(stamps_ms):
        wheels.add(int(stamp_ms * MS), np.array((0.1 * k, 0.0, 0.0)))
    return wheels


def test_a_bunch_is_spread_evenly_back_to_the_reading_before() -> None:
    """Four readings within 3 ms, half a second after the one before: one comes each 125 ms."""
    wheels = driven([*(100.0 * k for k in range(20)), 2397.0, 2398.0, 2399.0, 2400.0])
    for number, stamp_s in ((20, 2.025), (21, 2.15), (22, 2.275), (23, 2.4)):
        pose = wheels.pose_at(stamp_s)
        assert pose is not None and pose[0] == pytest.approx(0.1 * number, abs=1e-9)
    assert wheels.newest_ns == 2400 * MS


def test_a_reading_that_is_missing_leaves_its_gap() -> None:
    wheels = driven([100.0 * k for k in range(20)] + [2500.0])
    pose = wheels.pose_at(2.2)
    assert pose is not None and pose[0] == pytest.approx(1.9 + 0.1 * 0.5, abs=1e-9)


def test_wheels_that_fell_silent_tell_nothing() -> None:
    wheels = driven([100.0 * k for k in range(20)])
    assert wheels.pose_at(1.9) is not None and wheels.pose_at(2.5) is None
    assert wheels.motion(1.0, 2.6, np.eye(3)) is None and wheels.gaps(1.0, 4.0, 1.5)[1] == pytest.approx(2.1)


def test_gaps_that_reach_into_a_time_are_told_with_their_share_of_it() -> None:
    wheels = StampedWheels()
    for stamp_s in (0.0, 0.1, 2.1, 2.2, 3.2):
        wheels.add(round(stamp_s * 1e9), np.zeros(3))
    lengths_s, inside_s = wheels.gaps(1.1, 2.7, 0.5)
    np.testing.assert_allclose(lengths_s, (2.0, 1.0))
    np.testing.assert_allclose(inside_s, (1.0, 0.5))
    assert len(wheels.gaps(0.0, 0.1, 0.5)[0]) == 0 and wheels.gaps(3.2, 4.0, 0.5)[0] == pytest.approx(0.8)


def test_the_lag_is_learned_from_turns() -> None:
    """Scans that are 0.1 s older than their stamps turned when the wheels had turned 0.1 s before."""
    wheels = StampedWheels()
    yaw = lambda at_s: 0.8 * np.sin(1.3 * at_s)  # noqa: E731
    for k in range(3000):
        wheels.add(k * 20 * MS, np.array((0.0, 0.0, yaw(0.02 * k))))
        if k % 10 == 0 and k > 10:
            at_s = 0.02 * k
            wheels.observe_turn(at_s - 0.2, at_s, float(yaw(at_s - 0.1) - yaw(at_s - 0.3)))
    assert wheels.lag_s == pytest.approx(0.1, abs=0.01)


@pytest.mark.parametrize("apart_ms", [0, 30])
def test_noise_of_the_wheels_makes_no_lag(apart_ms: int) -> None:
    """Between two readings their noise averages out; a lag of half a period must seem no better for it."""
    noise, wheels = np.random.default_rng(apart_ms), StampedWheels()
    yaw = lambda at_s: 0.8 * np.sin(1.3 * at_s)  # noqa: E731
    drift = np.cumsum(noise.normal(0.0, 0.03, 1000))
    for k in range(1000):
        at_s = 0.1 * k + 1e-3 * apart_ms
        wheels.add(round(at_s * 1e9), np.array((0.0, 0.0, yaw(at_s) + drift[k])))
        if k > 10:
            wheels.observe_turn(0.1 * k - 0.1, 0.1 * k, float(yaw(0.1 * k) - yaw(0.1 * k - 0.1)))
    assert wheels.lag_s == 0.0


@pytest.mark.parametrize("seed", range(6))
def test_a_robot_that_hardly_turns_shows_no_lag(seed: int) -> None:
    noise, wheels = np.random.default_rng(seed), StampedWheels()
    drift = np.cumsum(noise.normal(0.0, 0.02, 600))
    for k in range(600):
        wheels.add(round(0.1e9 * k), np.array((0.0, 0.0, drift[k])))
        if k > 0:
            wheels.observe_turn(0.1 * k - 0.1, 0.1 * k, float(noise.normal(0.0, 0.002)))
        assert wheels.lag_s == 0.0
