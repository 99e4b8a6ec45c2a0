"""Robots in buildings: their drives, and their wheels with errors."""

import numpy as np
import pytest

from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.building_drivers import BuildingDriverConfig, arc_end
from ngo_sim.floor_plans import FloorPlan, FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.wheels import WheelOdometry, WheelsConfig, draw_wheels

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
