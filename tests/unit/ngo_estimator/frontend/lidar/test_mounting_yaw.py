"""How a scanner is mounted, by the ways that wheels and scans measure."""

import math

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.mounting_yaw import MountingYaw, MountingYawConfig
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry
from ngo_estimator.geometry.planar_motion import Array, compose

SECOND = 10**9


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


def estimate(by_scans: Array, by_wheels: Array, step_s: float = 0.2, config: MountingYawConfig | None = None) -> float:
    estimator = MountingYaw(config)
    for k, (scans, wheels) in enumerate(zip(by_scans, by_wheels, strict=True)):
        estimator.observe(step_s * k, scans, wheels)
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
    step: tuple[float, float, float], wheels_step: tuple[float, float, float]
) -> None:
    scans = seen_by_scans(driven(1500, step, 0.0), 0.05, noise_m=0.0)
    assert estimate(scans, driven(1500, wheels_step, 0.0), config=MountingYawConfig(fewest=1)) == 0.0


def test_slips_in_between_do_not_bend_it() -> None:
    poses = driven(1500)
    wheels, pose = [], np.zeros(3)
    for k in range(1500):
        wheels.append(pose)
        slip = 0.02 if k % 10 == 0 else 0.0
        pose = compose(pose, np.array((0.1, 0.0, 0.02 * math.sin(0.1 * k) + slip)))
    assert estimate(seen_by_scans(poses, 0.03), np.array(wheels)) == pytest.approx(0.03, abs=0.005)


def test_stretches_end_where_scans_or_wheels_are_not_sure() -> None:
    """Scans jump each tenth time, and are not sure of it; wheels freeze for a while."""
    wheels = WheelOdometry()
    poses = driven(1600)
    jump = np.zeros(3)
    for k, (pose, scans) in enumerate(zip(poses, seen_by_scans(poses, 0.03), strict=True)):
        frozen = 200 <= k < 240
        wheels.add(k * SECOND // 5, poses[200] if frozen else pose)
        if k % 10 == 0:
            jump = jump + (0.0, 0.2, 0.0)
            wheels.observe_pose(k * SECOND // 5, None)
        else:
            wheels.observe_pose(k * SECOND // 5, scans + jump)
    assert wheels.mounting_yaw.yaw_rad == pytest.approx(0.03, abs=0.003)


def test_memory_is_bounded_and_a_new_mounting_is_learned() -> None:
    config = MountingYawConfig(kept=120)
    estimator = MountingYaw(config)
    poses = driven(3000)
    scans = np.concatenate((seen_by_scans(poses, 0.05)[:1500], seen_by_scans(poses, -0.05)[1500:]))
    for k in range(3000):
        estimator.observe(0.2 * k, scans[k], poses[k])
        assert len(estimator._found) <= 120
    assert estimator.yaw_rad == pytest.approx(-0.05, abs=0.003)


@pytest.mark.parametrize("wrong", [{"stretch_m": 0.0}, {"agree_rad": math.inf}, {"fewest": 0}, {"kept": 99}])
def test_wrong_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="fewest"):
        MountingYawConfig(**wrong)  # type: ignore[arg-type]
