"""A robot that brakes and tilts does not take the floor for a wall, where an IMU says how it is tilted."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.frontend.intake.floor_rays import FloorRays
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import Array, between, compose
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRecord, LidarRun
from ngo_estimator.offline.recorded import RecordedRun
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import ImuReading, LidarScan, WheelPose
from tests.unit.ngo_estimator.ray_casting import ROOM, cast

HEIGHT_M = 0.2
MOUNTING = Mounting(np.array((0.1, 0.0, 0.5)), height_m=HEIGHT_M)


def up_of(pitch_rad: float, roll_rad: float = 0.0) -> Array:
    """The world's up in the axes of a robot whose nose and left side are lower by so much."""
    return np.array((-math.sin(pitch_rad), -math.sin(roll_rad), math.cos(pitch_rad) * math.cos(roll_rad)))


def scan(base: Array, up: Array, stamp_ns: int, mounting: Mounting = MOUNTING) -> tuple[LidarScan, Array]:
    """The scan of a tilted robot, and which rays met the floor."""
    angles = np.linspace(-math.pi, math.pi, 360, endpoint=False)
    seen = cast(ROOM, compose(base, mounting.sensor_xyyaw), angles)
    in_base = angles + mounting.sensor_xyyaw[2]
    down = -(up[0] * np.cos(in_base) + up[1] * np.sin(in_base))
    floor = np.where(down > 0.0, mounting.height_m / np.maximum(down, 1e-9), math.inf)
    ranges = np.minimum(seen, floor).astype(np.float32)
    return LidarScan(stamp_ns, -math.pi, math.tau / 360, ranges, 0.05, 30.0, 0.0, "laser"), floor < seen


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(4.0, 0.0), (0.0, -5.0), (-3.0, 3.0)])
def test_rays_on_the_floor_are_left_out_and_walls_stay(pitch_deg: float, roll_deg: float) -> None:
    floor_rays, up = FloorRays(), up_of(math.radians(pitch_deg), math.radians(roll_deg))
    floor_rays.add(10**9, up_of(0.0))
    floor_rays.add(2 * 10**9, up)
    tilted, floor = scan(np.array((2.0, 2.0, 0.2)), up, 2 * 10**9)
    found = floor_rays.without(tilted, MOUNTING).ranges
    assert floor.sum() > 20 and np.isnan(found[floor]).all()
    high = tilted.ranges < 1.9  # of the others, some walls are met just above the floor
    assert np.array_equal(found[high & ~floor], tilted.ranges[high & ~floor]) and (~np.isnan(found)).sum() > 200


def test_a_ray_that_goes_on_below_the_floor_met_none() -> None:
    """On a ramp the floor is tilted as well; nor is an IMU whose mounting is tilted a tilted robot."""
    ramp, tilted_imu, up = FloorRays(), FloorRays(), up_of(math.radians(10.0))
    level, _ = scan(np.array((2.0, 2.0, 0.2)), up_of(0.0), 2 * 10**9)
    far = replace(level, ranges=level.ranges + 2.0)
    ramp.add(10**9, up_of(0.0))
    ramp.add(2 * 10**9, up)
    ahead = np.abs(far.angles + MOUNTING.sensor_xyyaw[2]) < 0.5
    assert np.array_equal(ramp.without(far, MOUNTING).ranges[ahead], far.ranges[ahead])
    for stamp_ns in (10**9, 2 * 10**9):
        tilted_imu.add(stamp_ns, up)
    assert tilted_imu.without(level, MOUNTING) is level
    assert ramp.without(replace(far, stamp_ns=3 * 10**9), MOUNTING).ranges is far.ranges, "its tilt is not known"
    assert ramp.without(far, Mounting(np.zeros(3))) is far, "its height is not known"


@pytest.mark.filterwarnings("error")
def test_rays_without_a_return_stay_so() -> None:
    floor_rays = FloorRays()
    for stamp_ns in (10**9, 2 * 10**9):
        floor_rays.add(stamp_ns, up_of(0.0))
    level, _ = scan(np.array((2.0, 2.0, 0.2)), up_of(0.0), 2 * 10**9)
    level.ranges[::3], level.ranges[1::3] = np.inf, np.nan
    assert floor_rays.without(level, MOUNTING) is level


def test_a_doubled_stamp_of_an_imu_loses_nothing() -> None:
    floor_rays, up = FloorRays(), up_of(math.radians(4.0))
    for stamp_ns, at in ((10**9, up_of(0.0)), (2 * 10**9, up), (21 * 10**8, up), (21 * 10**8, up)):
        floor_rays.add(stamp_ns, at)
    tilted, _ = scan(np.array((2.0, 2.0, 0.2)), up, 2 * 10**9)
    assert np.isnan(floor_rays.without(tilted, MOUNTING).ranges).any()


def test_a_robot_that_brakes_and_tilts_knows_its_way_by_an_imu() -> None:
    noise, pose, poses, records = np.random.default_rng(0), np.array((1.0, 1.0, 0.2)), [], list[LidarRecord]()
    for k in range(60):
        stamp_ns, up = 10**12 + k * 10**8, up_of(math.radians(9.0) * math.sin(0.4 * k))
        records.append(WheelPose(stamp_ns, between(np.array((1.0, 1.0, 0.2)), pose) * (1.05, 1.05, 1.0)))
        records.append(ImuReading(stamp_ns, 0.3 + 0.01 * noise.standard_normal(), up))
        seen, _ = scan(pose, up, stamp_ns)
        records.append(replace(seen, ranges=seen.ranges + 0.005 * noise.standard_normal(360).astype(np.float32)))
        poses.append(pose)
        pose = compose(pose, np.array((0.06, 0.0, 0.03)))
    expected = np.array([between(poses[0], each) for each in poses])
    off_m = []
    for imu in (False, True):
        run = LidarRun(MixtureLidar(), ScanTrajectory(iterations_per_step=1), MOUNTING)
        taken = [each for each in records if imu or not isinstance(each, ImuReading)]
        whole = next(event for event in run.run(taken) if isinstance(event, RecordedRun)).trajectory
        off_m.append(float(np.linalg.norm((whole.poses_xyyaw - expected)[:, :2], axis=1).max()))
    assert off_m[1] < 0.02 and off_m[1] < 0.5 * off_m[0]
    assert any("rays met the floor while the robot was tilted" in line for line in run.remarks())
