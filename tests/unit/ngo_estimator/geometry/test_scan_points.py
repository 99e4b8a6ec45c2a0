"""Raw scans become points of the base frame, with normals of the walls."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import Array, compose, transformed
from ngo_estimator.geometry.scan_points import Mounting, Sweep, key_scan, range_noise
from tests.unit.ngo_estimator.ray_casting import MAX_RANGE, ROOM, cast, fan, scan_at

AHEAD = Mounting(np.zeros(3))
LIMITS = (0.05, MAX_RANGE)
BASE = np.array((2.0, 1.5, 0.4))


def off_walls(points: Array) -> Array:
    """Distances of points ``(n, 2)`` of the room's frame from the nearest wall."""
    start, along = ROOM[:, 0], ROOM[:, 1] - ROOM[:, 0]
    share = ((points[:, None] - start) * along).sum(-1) / (along**2).sum(-1)
    foot = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.hypot(*np.moveaxis(points[:, None] - foot, -1, 0)).min(axis=1)


def test_noise_does_not_turn_the_normals_of_a_wall() -> None:
    """A narrow scanner with dense rays beside one wall: normals ahead and behind are the wall's in the mean."""
    rng, angles = np.random.default_rng(0), fan(1440, 90.0)
    true = 1.2 / np.cos(angles)  # a wall across the middle ray
    turned: dict[str, list[float]] = {"ahead": [], "behind": []}
    for _ in range(20):
        scan = key_scan(0, angles, true + rng.normal(0.0, 0.02, len(angles)), LIMITS, AHEAD)
        known, y = np.abs(scan.normals).sum(axis=1) > 0.0, scan.points[:, 1]
        for where, there in (("ahead", y > 0.6), ("behind", y < -0.6)):
            turned[where].extend(np.degrees(np.arctan2(-scan.normals[:, 1], -scan.normals[:, 0]))[known & there])
    assert all(len(angles_deg) > 100 and abs(np.mean(angles_deg)) < 1.0 for angles_deg in turned.values())


@pytest.mark.parametrize("rays", [90, 361, 1080, 3000])
@pytest.mark.parametrize(
    "mounting", [AHEAD, Mounting(np.array((0.2, -0.1, 1.2))), Mounting(np.array((0.2, 0.1, -0.5)), upside_down=True)]
)
def test_points_lie_on_walls_and_normals_are_theirs(rays: int, mounting: Mounting) -> None:
    scan = scan_at(ROOM, BASE, angles=fan(rays, 270.0), mounting=mounting)
    points = transformed(BASE, scan.points)
    assert 40 <= len(points) <= 400
    # Means of rays on both sides of a corner are a little off it.
    # Key scans hold what messages carry, float32.
    assert np.quantile(off_walls(points), 0.95) < 1e-6 and off_walls(points).max() < 0.03
    known = np.abs(scan.normals).sum(axis=1) > 0.0
    assert known.mean() > 0.8
    normals = transformed(np.array((0.0, 0.0, BASE[2])), scan.normals[known])
    # All walls are along x or y.
    assert (np.abs(normals).max(axis=1) > math.cos(0.02)).mean() > 0.9
    towards = mounting.sensor_xyyaw[:2] - scan.points[known]
    assert ((scan.normals[known] * towards).sum(axis=1) > 0.0).all()
    assert np.hypot(*scan.normals[known].T) == pytest.approx(1.0)


def test_negative_increments_give_the_same_scan() -> None:
    angles = fan(181, 180.0)
    forward = scan_at(ROOM, BASE, angles=angles)
    backward = scan_at(ROOM, BASE, angles=angles[::-1])
    assert np.array_equal(forward.points, backward.points) and np.array_equal(forward.normals, backward.normals)


def test_rays_without_return_are_free_space_and_holes_are_unknown() -> None:
    angles = fan(181, 180.0)
    ranges = cast(ROOM, BASE, angles)
    whole = key_scan(0, angles, ranges, LIMITS, AHEAD)
    broken = ranges.copy()
    broken[10], broken[50], broken[90], broken[130], broken[170] = math.nan, math.inf, 0.0, MAX_RANGE + 1.0, -1.0
    scan = key_scan(0, angles, broken, LIMITS, AHEAD)
    assert np.isnan(scan.ranges[[10, 90, 170]]).all() and np.isposinf(scan.ranges[[50, 130]]).all()
    assert len(whole.points) - 5 <= len(scan.points) <= len(whole.points)
    assert off_walls(transformed(BASE, scan.points)).max() < 0.03


def test_points_of_a_surface_are_spaced() -> None:
    scan = scan_at(ROOM, BASE, angles=fan(3000, 180.0))
    gaps = np.hypot(*np.diff(scan.points, axis=0).T)
    assert np.quantile(gaps, 0.05) > 0.03


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.03, 0.05])
@pytest.mark.parametrize("rays", [181, 720])
def test_noise_is_estimated_and_does_not_cost_the_normals(rays: int, noise_m: float) -> None:
    """Objects in front of a third of the walls do not count as noise."""
    rng, angles = np.random.default_rng(0), fan(rays, 240.0)
    estimates, errors_deg, shares = [], [], []
    for _ in range(20):
        ranges = cast(ROOM, BASE, angles) + rng.normal(0.0, noise_m, rays)
        scan = key_scan(0, angles, ranges, LIMITS, AHEAD)
        known = np.abs(scan.normals).sum(axis=1) > 0.0
        shares.append(known.mean())
        turned = np.degrees(np.arctan2(scan.normals[known, 1], scan.normals[known, 0]) + BASE[2])
        errors_deg.append(np.abs((turned + 45.0) % 90.0 - 45.0).mean())  # the room has right angles
        estimates.append(range_noise(angles, np.where(np.arange(rays) % 30 < 10, 0.7 * ranges, ranges)))
    assert np.mean(estimates) == pytest.approx(noise_m, rel=0.35, abs=1e-3)
    assert np.mean(shares) > 0.85 and np.mean(errors_deg) < 15.0


def test_no_line_joins_two_surfaces() -> None:
    """A wall at 2 m beside one at 5 m: no normal points between them."""
    angles = fan(181, 90.0)
    ranges = np.where(angles > 0.0, 2.0, 5.0) / np.cos(angles)
    scan = key_scan(0, angles, ranges, LIMITS, AHEAD)
    known = np.abs(scan.normals).sum(axis=1) > 0.0
    assert known.mean() > 0.95
    assert np.abs(scan.normals[known] - (-1.0, 0.0)).max() < 1e-6


def test_the_sweep_is_removed() -> None:
    """Rays that are measured one after the other, while the robot drives and turns, as if it had stood still."""
    angles, twist = fan(361, 270.0), np.array((0.8, 0.0, 1.5))
    offsets = np.linspace(-0.05, 0.05, 361)
    ranges = np.empty(361)
    for i, offset in enumerate(offsets):
        turn = twist[2] * offset
        arc = np.array((twist[0] * math.sin(turn) / twist[2], twist[0] * (1.0 - math.cos(turn)) / twist[2], turn))
        ranges[i] = cast(ROOM, compose(BASE, arc), angles[i : i + 1])[0]
    smeared = key_scan(0, angles, ranges, LIMITS, AHEAD)
    scan = key_scan(0, angles, ranges, LIMITS, AHEAD, Sweep(offsets, twist))
    assert np.quantile(off_walls(transformed(BASE, smeared.points)), 0.9) > 0.05
    assert np.quantile(off_walls(transformed(BASE, scan.points)), 0.9) < 0.002
    assert (np.diff(scan.angles) >= 0.0).all()
