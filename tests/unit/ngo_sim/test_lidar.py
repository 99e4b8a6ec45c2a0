"""The lidar's ranges have known answers, and those of a whole building equal brute force."""

import math

import numpy as np
import pytest

from ngo_sim.floor_plans import FloorPlanConfig, draw_floor_plan
from ngo_sim.lidar import RayWorld, ScannerConfig, cast_scans, draw_scanner, ray_world

EXACT = {"noise_m": 0.0, "noise_per_m": 0.0, "dropout": 0.0, "glass_seen": 0.0, "glass_lost": 0.0}
WALL = np.array(((3.0, -50.0, 3.0, 50.0),))


def world(segments: np.ndarray = WALL, circles: object = (), glass: object = None, doors: object = ()) -> RayWorld:
    is_glass = np.zeros(len(segments), np.bool_) if glass is None else np.asarray(glass)
    return ray_world(segments, is_glass, np.reshape(circles, (-1, 3)), np.reshape(doors, (-1, 3)))


def scan(
    world: RayWorld,
    scanner: ScannerConfig,
    pose: object = (0.0, 0.0, 0.0),
    twist: object = (0.0, 0.0),
    leaves: object = (),
    moving: object = (),
    seed: int = 0,
) -> np.ndarray:
    return cast_scans(
        world,
        scanner,
        np.reshape(pose, (1, 3)).astype(float),
        np.reshape(twist, (1, 2)).astype(float),
        np.reshape(leaves, (1, -1, 4)).astype(float),
        np.reshape(moving, (1, -1, 3)).astype(float),
        np.random.default_rng(seed),
    )[0]


def test_a_wall_ahead() -> None:
    scanner = ScannerConfig(rays=61, field_of_view_deg=120.0, range_max_m=50.0, **EXACT)
    np.testing.assert_allclose(scan(world(), scanner), 3.0 / np.cos(scanner.angles_rad), rtol=1e-6)
    np.testing.assert_allclose(
        scan(world(), scanner, (1.0, 2.0, 0.1)), 2.0 / np.cos(scanner.angles_rad + 0.1), rtol=1e-6
    )


def test_a_circle_ahead_and_nothing_beside_it() -> None:
    scanner = ScannerConfig(rays=3, field_of_view_deg=90.0, **EXACT)
    for still, moving in (((5.0, 0.0, 0.5), ()), ((-5.0, 0.0, 0.1), (5.0, 0.0, 0.5))):
        ranges = scan(world(np.zeros((0, 4)), still), scanner, moving=moving)
        assert ranges.tolist() == [math.inf, pytest.approx(4.5), math.inf]


@pytest.mark.parametrize(("no_return", "expected"), [("inf", math.inf), ("max", 2.1), ("zero", 0.0)])
def test_beyond_the_limit_and_too_near_is_no_return(no_return: str, expected: float) -> None:
    scanner = ScannerConfig(rays=1, range_min_m=0.5, range_max_m=2.0, no_return=no_return, **EXACT)
    for x, seen in ((0.0, expected), (1.5, 1.5), (2.8, expected)):
        assert scan(world(), scanner, (x, 0.0, scanner.field_of_view_deg * math.pi / 360))[0] == pytest.approx(seen)


def test_mounting() -> None:
    """Off centre, turned by 90 degrees to the left, and upside down."""
    scanner = ScannerConfig(rays=3, field_of_view_deg=60.0, laser_x_m=0.2, laser_y_m=0.1, range_max_m=100.0, **EXACT)
    np.testing.assert_allclose(scan(world(), scanner), 2.8 / np.cos(scanner.angles_rad), rtol=1e-6)
    turned = ScannerConfig(rays=3, field_of_view_deg=60.0, laser_yaw_deg=90.0, **EXACT)
    assert scan(world(), turned, (0.0, 0.0, -math.pi / 2))[1] == pytest.approx(3.0)
    oblique = (0.0, 0.0, 0.4)
    upright = ScannerConfig(rays=5, field_of_view_deg=60.0, **EXACT)
    hanging = ScannerConfig(rays=5, field_of_view_deg=60.0, upside_down=True, **EXACT)
    backwards = ScannerConfig(rays=5, field_of_view_deg=60.0, clockwise=True, **EXACT)
    np.testing.assert_array_equal(scan(world(), hanging, oblique), scan(world(), upright, oblique)[::-1])
    np.testing.assert_allclose(scan(world(), backwards, oblique), scan(world(), upright, oblique)[::-1], rtol=1e-6)
    assert backwards.increment_rad < 0 < hanging.increment_rad


def test_a_sweeping_scanner_sees_from_where_the_robot_is_at_each_ray() -> None:
    scanner = ScannerConfig(rays=5, field_of_view_deg=1.0, scan_period_s=1.0, sweep=1.0, **EXACT)
    assert scanner.time_increment_s == pytest.approx(0.2)
    driving = scan(world(), scanner, twist=(1.0, 0.0))
    np.testing.assert_allclose(driving, (3.0 - 0.2 * np.arange(5)) / np.cos(scanner.angles_rad), rtol=1e-6)
    turning = scan(world(), scanner, twist=(0.0, 0.5))
    np.testing.assert_allclose(turning, 3.0 / np.cos(scanner.angles_rad + 0.1 * np.arange(5)), rtol=1e-6)


def test_noise_grows_with_the_range_and_dropouts_have_their_share() -> None:
    for x in (0.0, -17.0):
        scanner = ScannerConfig(rays=4000, field_of_view_deg=1.0, noise_m=0.01, noise_per_m=0.005, dropout=0.1)
        ranges = scan(world(), scanner, (x, 0.0, 0.0))
        lost = np.isinf(ranges)
        assert lost.mean() == pytest.approx(0.1, abs=0.02)
        assert np.std(ranges[~lost]) == pytest.approx(0.01 + 0.005 * (3.0 - x), rel=0.06)


def test_glass_is_seen_lost_or_seen_through_and_shines_at_its_normal() -> None:
    both = np.array(((3.0, -50.0, 3.0, 50.0), (5.0, -50.0, 5.0, 50.0)))
    scanner = ScannerConfig(
        rays=6000, field_of_view_deg=1.0, noise_m=0.0, noise_per_m=0.0, dropout=0.0, glass_seen=0.2, glass_lost=0.3
    )
    through = scan(world(both, glass=(True, False)), scanner, (0.0, 0.0, 0.5)) * math.cos(0.5)
    assert np.isclose(through, 3.0, atol=0.1).mean() == pytest.approx(0.2, abs=0.03)
    assert np.isinf(through).mean() == pytest.approx(0.3, abs=0.03)
    assert np.isclose(through, 5.0, atol=0.1).mean() == pytest.approx(0.5, abs=0.03)
    np.testing.assert_allclose(scan(world(both, glass=(True, False)), scanner), 3.0, rtol=1e-3)


def test_a_door_leaf_is_where_it_is_now() -> None:
    scanner = ScannerConfig(rays=1, field_of_view_deg=1.0, **EXACT)
    pose, doors = (0.0, 0.0, math.radians(0.5)), (1.0, -0.5, 1.2)
    for leaf, seen in (((1.0, -0.5, 1.0, 0.5), 1.0), ((1.0, -0.5, 2.0, -0.5), 3.0)):
        assert scan(world(doors=doors), scanner, pose, leaves=leaf)[0] == pytest.approx(seen)


def brute_force(segments: np.ndarray, circles: np.ndarray, x: float, y: float, yaws: np.ndarray) -> np.ndarray:
    """Nearest hit of each ray, every ray against every segment and circle."""
    u = np.stack((np.cos(yaws), np.sin(yaws)), axis=1)[:, None]
    d, off = segments[:, 2:] - segments[:, :2], segments[:, :2] - (x, y)
    cross = u[..., 0] * d[:, 1] - u[..., 1] * d[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        far = (off[:, 0] * d[:, 1] - off[:, 1] * d[:, 0]) / cross
        share = (off[:, 0] * u[..., 1] - off[:, 1] * u[..., 0]) / cross
    hit = np.where((far >= 0) & (share >= 0) & (share <= 1), far, np.inf).min(axis=1)
    off = circles[:, :2] - (x, y)
    along, aside = (off * u).sum(axis=-1), off[:, 0] * u[..., 1] - off[:, 1] * u[..., 0]
    inside = circles[:, 2] ** 2 - aside**2
    near = along - np.sqrt(np.maximum(inside, 0.0))
    return np.minimum(hit, np.where((inside >= 0) & (near >= 0), near, np.inf).min(axis=1))


@pytest.mark.parametrize("seed", range(3))
def test_a_whole_building_equals_brute_force(seed: int) -> None:
    plan = draw_floor_plan(seed, FloorPlanConfig(scale=0.6))
    no_glass = np.zeros(len(plan.glass), np.bool_)
    built = ray_world(plan.segments_m, no_glass, plan.circles_m, np.zeros((0, 3)))
    scanner = ScannerConfig(rays=500, field_of_view_deg=360.0, range_min_m=0.0, range_max_m=200.0, **EXACT)
    for x, y in plan.goals_m[:8]:
        expected = brute_force(plan.segments_m, plan.circles_m, x, y, scanner.base_angles_rad() + 0.3)
        np.testing.assert_allclose(scan(built, scanner, (x, y, 0.3)), expected, rtol=1e-5, atol=1e-6)


def test_scans_one_by_one_draw_the_same_as_all_at_once() -> None:
    scanner = ScannerConfig(rays=50, dropout=0.2)
    poses, rng = np.zeros((3, 3)), np.random.default_rng(5)
    none = np.zeros((3, 0, 4)), np.zeros((3, 0, 3))
    together = cast_scans(world(), scanner, poses, poses[:, :2], *none, np.random.default_rng(5))
    for index in range(3):
        alone = cast_scans(world(), scanner, poses[:1], poses[:1, :2], none[0][:1], none[1][:1], rng)
        np.testing.assert_array_equal(alone[0], together[index])


def test_drawn_scanners_are_varied() -> None:
    drawn = [draw_scanner(np.random.default_rng(seed)) for seed in range(200)]
    assert {90, 3000} <= {scanner.rays for scanner in drawn}
    assert {90.0, 360.0} <= {scanner.field_of_view_deg for scanner in drawn}
    assert {4.0, 100.0} <= {scanner.range_max_m for scanner in drawn}
    assert {"inf", "max", "zero"} == {scanner.no_return for scanner in drawn}
