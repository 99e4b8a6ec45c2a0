"""A drive through a building: the same for the same seed, without collisions, and true to its parts."""

import numpy as np
import pytest

from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.building_drivers import BuildingDriverConfig, arc_end
from ngo_sim.floor_plans import FloorPlan, FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelsConfig

PLAN = FloorPlanConfig(scale=0.6)
SCANNER = ScannerConfig(rays=60)


def gap_to_walls(plan: FloorPlan, points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """(n,) exact distance from points to the nearest of the segments and of the plan's circles."""
    start, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    off = points[:, None] - start
    share = np.clip((off * along).sum(-1) / np.maximum((along**2).sum(-1), 1e-12), 0.0, 1.0)
    to_segments = np.linalg.norm(off - share[..., None] * along, axis=-1).min(axis=1)
    to_circles = np.linalg.norm(points[:, None] - plan.circles_m[:, :2], axis=-1) - plan.circles_m[:, 2]
    return np.minimum(to_segments, to_circles.min(axis=1))


@pytest.fixture(scope="module")
def drive() -> BuildingDrive:
    return Building2d(PLAN, SCANNER, WheelsConfig(wheel_noise=0.0)).record(1, 120.0)


def test_the_same_seed_gives_the_same_drive_to_the_byte() -> None:
    world = Building2d(PLAN)  # scanner and wheels are drawn as well
    first, other, again = (world.record(seed, 15.0) for seed in (2, 3, 2))
    assert first.scanner == again.scanner != other.scanner
    for name in ("stamps_s", "ranges_m", "wheel_stamps_s", "wheel_poses_xyyaw", "true_poses_xyyaw", "twists"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))


def test_another_drive_through_a_building_is_later_and_another_way() -> None:
    first, second, again = (Building2d(PLAN).record(2, 5.0, drive=drive) for drive in (0, 1, 1))
    np.testing.assert_array_equal(first.plan.segments_m, second.plan.segments_m)
    assert (first.scanner, first.wheels) == (second.scanner, second.wheels)
    assert second.stamps_s[0] > first.stamps_s[-1]
    assert np.hypot(*(second.true_poses_xyyaw - first.true_poses_xyyaw[0])[:, :2].T).min() > 0.1
    np.testing.assert_array_equal(second.ranges_m, again.ranges_m)


def test_steps_equal_the_recording(drive: BuildingDrive) -> None:
    world = Building2d(PLAN, SCANNER, WheelsConfig(wheel_noise=0.0))
    world.reset(1)
    for index in range(600):
        frame = world.step()
        assert (frame.index, frame.stamp_s) == (index, drive.stamps_s[index])
        np.testing.assert_array_equal(frame.ranges_m, drive.ranges_m[index])
        np.testing.assert_array_equal(frame.true_pose_xyyaw, drive.true_poses_xyyaw[index])
        np.testing.assert_array_equal(frame.wheel_pose_xyyaw, drive.wheel_poses_xyyaw[index])


@pytest.mark.parametrize("seed", range(4))
def test_no_collision_over_a_long_drive(seed: int) -> None:
    driver = BuildingDriverConfig(speed_mps=1.0)
    drive = Building2d(PLAN, ScannerConfig(rays=1), driver=driver).record(seed, 200.0, most_scans=30_000)
    assert np.sum(drive.twists[:, 0]) * 0.1 >= 200.0, "the robot is not stuck"
    for begin in range(0, len(drive.stamps_s), 500):
        part = slice(begin, begin + 500, 2)
        doors = drive.plan.doors.leaves(drive.stamps_s[begin : begin + 1])[0]
        gaps = gap_to_walls(
            drive.plan, drive.true_poses_xyyaw[part, :2], np.concatenate((drive.plan.segments_m, doors))
        )
        assert gaps.min() >= driver.radius_m


def test_motion_is_smooth_and_has_stops_and_turns(drive: BuildingDrive) -> None:
    speed, rate = drive.twists.T
    assert speed.min() >= 0.0 and speed.max() <= 0.7 + 1e-9 and np.abs(rate).max() <= 1.2 + 1e-9
    change = np.diff(speed) / 0.1
    assert change.max() <= 1.01 and (change < -0.71).mean() < 0.01
    assert ((speed == 0.0) & (rate == 0.0)).any() and ((speed == 0.0) & (np.abs(rate) > 0.2)).any()


def test_each_pose_follows_from_the_one_before_and_wheels_without_errors_agree(drive: BuildingDrive) -> None:
    poses = drive.true_poses_xyyaw
    for index in range(0, len(poses) - 1, 7):
        expected = arc_end(poses[index], *drive.twists[index], 0.1)
        np.testing.assert_allclose(poses[index + 1], expected, atol=1e-12)
    x, y, yaw = poses[0]
    turn = np.array(((np.cos(yaw), -np.sin(yaw)), (np.sin(yaw), np.cos(yaw))))
    np.testing.assert_allclose(drive.wheel_poses_xyyaw[:, :2] @ turn.T + (x, y), poses[:, :2], atol=1e-8)


def test_a_lag_shifts_the_wheels_stamps() -> None:
    drive = Building2d(PLAN, SCANNER, WheelsConfig(lag_s=0.15)).record(1, 3.0)
    np.testing.assert_allclose(drive.stamps_s - drive.wheel_stamps_s, 0.15)
    assert np.diff(drive.stamps_s) == pytest.approx(0.1)


def test_a_patrol_comes_back_to_the_same_rooms() -> None:
    driver = BuildingDriverConfig(driver="patrol", stand=0.0, spin=0.0)
    drive = Building2d(PLAN, ScannerConfig(rays=1), driver=driver).record(5, 400.0)
    cells = np.unique(np.round(drive.true_poses_xyyaw[:, :2]), axis=0)
    assert len(cells) < 200.0, "a way of 400 m covers less than half as many square metres"


def test_people_are_seen_and_keep_off_the_robot() -> None:
    with_people = Building2d(FloorPlanConfig(scale=0.6, people=20), ScannerConfig(rays=200, dropout=0.0, noise_m=0.0))
    without = Building2d(FloorPlanConfig(scale=0.6, people=0), ScannerConfig(rays=200, dropout=0.0, noise_m=0.0))
    seen, empty = with_people.record(4, 40.0), without.record(4, 40.0)
    np.testing.assert_array_equal(seen.true_poses_xyyaw, empty.true_poses_xyyaw)
    assert (seen.ranges_m < empty.ranges_m - 0.3).any()
    people = with_people._people.circles(seen.stamps_s, seen.true_poses_xyyaw[:, :2])
    gaps = np.linalg.norm(people[..., :2] - seen.true_poses_xyyaw[:, None, :2], axis=-1)
    assert gaps.min() > 0.22
