"""How a scanner is mounted, by the ways that wheels and scans measure."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.intake import mounting_yaw
from ngo_estimator.frontend.intake.mounting_yaw import MountingYaw
from ngo_estimator.geometry.planar_motion import Array, between, compose


def driven(steps: int, step: tuple[float, float, float] = (0.1, 0.0, 0.0), wander: float = 0.02) -> Array:
    """Poses ``(steps, 3)`` of a robot that moves by one step each time and wanders a little."""
    pose, poses = np.zeros(3), []
    for k in range(steps):
        poses.append(pose)
        pose = compose(pose, np.array(step) + (0.0, 0.0, wander * math.sin(0.1 * k)))
    return np.array(poses)


def seen_by_scans(poses: Array, yaw: float, noise_m: float = 0.005) -> Array:
    """What scans of a scanner measure that looks ``yaw`` further to the left than is known."""
    cosine, sine = math.cos(yaw), math.sin(yaw)
    x, y, heading = poses.T
    noise = noise_m * np.random.default_rng(1).standard_normal((2, len(poses)))
    return np.stack((cosine * x + sine * y + noise[0], cosine * y - sine * x + noise[1], heading), axis=-1)


def observe(estimator: MountingYaw, by_scans: Array, by_wheels: Array) -> None:
    for k in range(1, len(by_scans)):
        estimator.observe(between(by_scans[k - 1], by_scans[k]), between(by_wheels[k - 1], by_wheels[k]), 0.2)


def estimate(by_scans: Array, by_wheels: Array) -> float:
    estimator = MountingYaw()
    observe(estimator, by_scans, by_wheels)
    return estimator.yaw_rad


@pytest.mark.parametrize("yaw", [-0.05, -0.02, 0.02, 0.08])
def test_the_yaw_is_found_by_wheels_that_nobody_calibrated(yaw: float) -> None:
    """Their ways are 8 % too long, and they turn by 0.01 rad a metre where the robot drives straight ahead."""
    poses = driven(1000)
    wheels = driven(1000, (0.108, 0.0, 0.001))
    assert estimate(seen_by_scans(poses, yaw), wheels) == pytest.approx(yaw, abs=0.003)


def test_no_yaw_is_claimed_of_a_right_mounting_nor_of_a_short_way() -> None:
    assert estimate(seen_by_scans(driven(1000), 0.0), driven(1000)) == 0.0
    assert estimate(seen_by_scans(driven(1000), 0.006), driven(1000)) == 0.0
    assert estimate(seen_by_scans(driven(400), 0.05), driven(400)) == 0.0
    assert estimate(seen_by_scans(driven(1000), 0.012, noise_m=0.2), driven(1000)) == 0.0


@pytest.mark.parametrize(
    ("step", "wheels_step"),
    [
        ((0.0, 0.0, 0.2), (0.0, 0.0, 0.2)),  # turns on the spot
        ((-0.1, 0.0, 0.0), (-0.1, 0.0, 0.0)),  # drives backwards
        ((0.1, 0.0, 0.08), (0.1, 0.0, 0.08)),  # turns while it drives
        ((0.1, 0.0, 0.0), (0.0, 0.0, 0.0)),  # the wheels stand
        ((0.1, 0.0, 0.0), (0.25, 0.0, 0.0)),  # the wheels slip
        ((0.1, 0.0, 0.0), (0.1, 0.0, 0.03)),  # one wheel slips
        ((0.01, 0.0, 0.0), (0.01, 0.0, 0.0)),  # creeps
    ],
)
def test_what_is_no_drive_ahead_does_not_count(
    step: tuple[float, float, float], wheels_step: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mounting_yaw, "FEWEST", 1)
    scans = seen_by_scans(driven(500, step, 0.0), 0.05, noise_m=0.0)
    assert estimate(scans, driven(500, wheels_step, 0.0)) == 0.0


def test_slips_in_between_do_not_bend_it() -> None:
    poses = driven(1500)
    wheels, pose = [], np.zeros(3)
    for k in range(1500):
        wheels.append(pose)
        slip = 0.02 if k % 10 == 0 else 0.0
        pose = compose(pose, np.array((0.1, 0.0, 0.02 * math.sin(0.1 * k) + slip)))
    assert estimate(seen_by_scans(poses, 0.03), np.array(wheels)) == pytest.approx(0.03, abs=0.005)


def test_a_stretch_ends_where_scans_or_wheels_are_not_sure() -> None:
    estimator, ahead = MountingYaw(), np.array((0.1, 0.0, 0.0))
    for k in range(1000):
        if k % 8 == 0:
            estimator.observe(ahead, np.array((0.1, 0.2, 0.0)), 0.2)
            estimator.interrupt()
        else:
            estimator.observe(ahead, np.array((0.1, 0.003, 0.0)), 0.2)
    assert estimator.yaw_rad == pytest.approx(0.03, abs=0.001)
