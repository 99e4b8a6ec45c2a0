"""An IMU's turns stand in for those of slipping wheels, and a bad one does no harm."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.intake.imu_turns import ImuTurns
from ngo_estimator.frontend.intake.wheel_clock import CorrectedWheels, WheelTruth
from ngo_estimator.geometry.planar_motion import compose

PERIOD_NS = 100_000_000
BIAS_RPS = 0.03


def yaw(time_s: float) -> float:
    return math.sin(0.9 * time_s) + 0.5 * math.sin(2.3 * time_s)


def rate(time_s: float) -> float:
    return 0.9 * math.cos(0.9 * time_s) + 1.15 * math.cos(2.3 * time_s)


def heard(imu: ImuTurns, late_s: float, factor: float, slip_rad: float, steps: int = 150) -> None:
    """Readings of 100 Hz and steps between scans, of which one in ten slips."""
    noise = np.random.default_rng(0)
    for k in range(steps):
        for reading in range(10):
            time_s = 0.1 * k + 0.01 * reading
            said = factor * rate(time_s) + max(factor, 1.0) * (BIAS_RPS + float(noise.normal(0.0, 0.01)))
            imu.add(10**9 + round((time_s + late_s) * 1e9), said)
        turn = yaw(0.1 * k) - yaw(0.1 * (k - 1))
        by_scans, slip = turn + float(noise.normal(0.0, 0.002)), slip_rad * (k % 10 == 0)
        imu.observe(10**9 + (k - 1) * PERIOD_NS, 10**9 + k * PERIOD_NS, by_scans, turn + slip)


@pytest.mark.parametrize("factor", [1.0, math.degrees(1.0)])
@pytest.mark.parametrize("late_s", [0.0, 0.1, -0.3])
def test_its_turns_are_used_where_wheels_slip_with_its_bias_and_delay_taken_out(late_s: float, factor: float) -> None:
    imu = ImuTurns()
    heard(imu, late_s, factor, slip_rad=0.1)
    assert ("degrees/s" in imu.remark()) == (factor != 1.0)
    assert imu.used and "stand in for the wheels'" in imu.remark()
    assert imu.late_ns == pytest.approx(late_s * 1e9) and imu.bias_rps == pytest.approx(BIAS_RPS, abs=0.005)
    turn = imu.turn(10**9 + 120 * PERIOD_NS, 10**9 + 130 * PERIOD_NS)
    assert turn == pytest.approx(yaw(13.0) - yaw(12.0), abs=0.01)


@pytest.mark.parametrize(
    ("late_s", "factor", "slip_rad"),
    [(0.0, 1.0, 0.0), (0.0, -1.0, 0.1), (0.0, 0.0, 0.1), (0.3, 1.0, 0.1), (0.0, 5.0, 0.1)],
)
def test_it_is_not_used_where_wheels_are_good_or_it_is_wrong(late_s: float, factor: float, slip_rad: float) -> None:
    imu = ImuTurns()
    heard(imu, late_s, factor, slip_rad)
    assert not imu.used and "is not used" in imu.remark()


def test_wheels_that_slip_or_freeze_go_on_as_the_imu_says() -> None:
    """A robot drives straight at 1 m/s. Its odometry freezes for 0.2 s, and then a wheel slips."""
    imu = ImuTurns()
    heard(imu, 0.0, 1.0, slip_rad=0.1)
    imu.interrupt()
    for k in range(0, 1001, 10):
        imu.add(10**12 + k * 10**6, imu.bias_rps)
    wheels, said = CorrectedWheels(imu), np.zeros(3)
    for k, step in enumerate([(0.0, 0.0), (0.1, 0.0), (0.0, 0.0), (0.0, 0.0), (0.3, 0.0), *[(0.15, 0.1)] * 6]):
        said = compose(said, np.array((step[0], 0.0, step[1])))
        at = 10**12 + k * PERIOD_NS
        _, pose = wheels.add(at, said, WheelTruth())
    np.testing.assert_allclose(pose, [1.0, 0.0, 0.0], atol=0.01)
    np.testing.assert_allclose(wheels.said(at), said)
