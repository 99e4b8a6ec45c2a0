"""Which scans a robot can have reached by accelerating; arcs are followed to 3 mm."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.trusted_motion import TrustedMotion
from ngo_estimator.geometry.planar_motion import Array, compose

PERIOD_NS = 100_000_000
VELOCITY = np.array((0.5, 0.0, 0.4))


def arc(elapsed_s: float, velocity: Array = VELOCITY) -> Array:
    """Where a robot is that began at (1, -2) with a heading of 2 rad."""
    turn = velocity[2] * elapsed_s
    radius = velocity[0] / velocity[2]
    return compose(
        np.array((1.0, -2.0, 2.0)), np.array((radius * math.sin(turn), radius * (1.0 - math.cos(turn)), turn))
    )


def driven(scans: int = 10) -> TrustedMotion:
    """A robot on an arc, until ``scans`` periods after its start."""
    motion = TrustedMotion(0.03, math.radians(1.5), 2.0, 4.0, 1.5)
    for k in range(scans + 1):
        motion.observe(k * PERIOD_NS, arc(0.1 * k), VELOCITY, unsure=False)
    return motion


def test_the_velocity_leads_along_an_arc() -> None:
    assert driven().carried(20 * PERIOD_NS) == pytest.approx(arc(2.0), abs=3e-3)


def test_nothing_is_known_after_a_while() -> None:
    motion = driven()
    assert motion.carried(25 * PERIOD_NS) is not None
    assert motion.carried(26 * PERIOD_NS) is None


@pytest.mark.parametrize("off", [(0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.06), (0.0, 0.0, -0.06)])
def test_a_scan_out_of_reach_is_left_out(off: tuple[float, float, float]) -> None:
    motion = driven()
    motion.observe(11 * PERIOD_NS, compose(arc(1.1), np.array(off)), np.array((9.0, 9.0, 9.0)), unsure=False)
    assert motion.carried(12 * PERIOD_NS) == pytest.approx(arc(1.2), abs=3e-3)


def test_an_unsure_scan_is_left_out() -> None:
    motion = driven()
    motion.observe(11 * PERIOD_NS, arc(1.1), np.zeros(3), unsure=True)
    assert motion.carried(12 * PERIOD_NS) == pytest.approx(arc(1.2), abs=3e-3)


def test_a_robot_that_accelerates_is_trusted() -> None:
    motion, faster = driven(), np.array((0.5, 0.0, 0.7))
    motion.observe(11 * PERIOD_NS, compose(arc(1.0), np.array((0.05, 0.0, 0.07))), faster, unsure=False)
    carried = motion.carried(12 * PERIOD_NS)
    assert carried is not None and carried[2] == pytest.approx(arc(1.0)[2] + 0.14)


def test_a_robot_that_speeds_up_is_trusted_as_far_as_it_can() -> None:
    """By 2 m/s² it comes 0.16 m farther within 0.4 s, and a pose is off by up to 0.03 m."""
    for farther, trusted in ((0.18, True), (0.2, False)):
        motion = driven()
        for k in (11, 12, 13):
            motion.observe(k * PERIOD_NS, arc(0.1 * k), VELOCITY, unsure=True)
        straight = compose(arc(1.4), np.array((farther, 0.0, 0.0)))
        motion.observe(14 * PERIOD_NS, straight, np.zeros(3), unsure=False)
        carried = motion.carried(14 * PERIOD_NS)
        assert carried is not None and (math.hypot(*(carried - straight)[:2]) < 1e-9) == trusted


def test_an_unsure_scan_begins_nothing() -> None:
    motion = TrustedMotion(0.03, math.radians(1.5), 2.0, 4.0, 1.5)
    for k, unsure in enumerate((True, False, False)):
        motion.observe(k * PERIOD_NS, arc(0.1 * k), VELOCITY, unsure)
        assert (motion.carried((k + 1) * PERIOD_NS) is not None) == (k == 2)


def test_the_way_back_from_a_slip_is_no_velocity() -> None:
    """Two scans followed a slip. The third is right again, and its step leads back."""
    motion = driven()
    for k in (11, 12):
        turned = compose(arc(0.1 * k), np.array((0.0, 0.0, 0.15 * k - 1.5)))
        motion.observe(k * PERIOD_NS, turned, VELOCITY, unsure=False)
    motion.observe(13 * PERIOD_NS, arc(1.3), np.array((0.5, 0.0, -2.6)), unsure=False)
    assert motion.carried(20 * PERIOD_NS) == pytest.approx(arc(2.0), abs=3e-3)


def test_a_motion_that_goes_on_is_trusted_in_the_end() -> None:
    """It began at once: the robot was pushed."""
    motion, pushed = driven(), np.array((2.0, 0.0, 0.0))
    for k in range(11, 31):
        motion.observe(k * PERIOD_NS, compose(arc(1.0), 0.1 * (k - 10) * pushed), pushed, unsure=False)
    assert motion.carried(31 * PERIOD_NS) == pytest.approx(compose(arc(1.0), 2.1 * pushed), abs=3e-3)


def test_a_velocity_counts_once_it_led_to_a_scan() -> None:
    """At first a robot that drives already is measured to stand."""
    motion = TrustedMotion(0.03, math.radians(1.5), 2.0, 4.0, 1.5)
    measured = (0.0, 0.0, 0.5, 0.5)
    known = []
    for k, speed in enumerate(measured):
        motion.observe(k * PERIOD_NS, arc(0.1 * k), np.array((speed, 0.0, 0.4)), unsure=False)
        known.append(motion.carried((k + 1) * PERIOD_NS) is not None)
    assert known == [False, False, False, True]
    motion.forget()
    assert motion.carried(4 * PERIOD_NS) is None
