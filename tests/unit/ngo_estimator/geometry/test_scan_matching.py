"""Scans of known poses are registered to each other."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.line_map import LineMap, line_map_of_points
from ngo_estimator.geometry.planar_motion import Array, between, rotated, transformed
from ngo_estimator.geometry.scan_matching import icp
from tests.unit.ngo_estimator.ray_casting import HALLWAY, ROOM, fan, scan_at

A, B = np.array((2.0, 1.5, 0.4)), np.array((2.3, 1.4, 0.55))
IDENTITY = np.zeros(3)


def line_map(scans: Sequence[KeyScan], poses: Sequence[Array]) -> LineMap:
    """The lines of scans whose base frames have the given poses."""
    placed = list(zip(scans, poses, strict=True))
    return line_map_of_points(
        np.concatenate([transformed(pose, scan.points) for scan, pose in placed]),
        np.concatenate([rotated(pose[2], scan.normals) for scan, pose in placed]),
    )


@pytest.mark.parametrize("rays", [90, 181, 361, 1080])
@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.1, -0.1, 0.08), (-0.12, 0.05, -0.1)])
def test_the_pose_is_found(rays: int, off: tuple[float, float, float]) -> None:
    first, second = (scan_at(ROOM, pose, angles=fan(rays, 270.0)) for pose in (A, B))
    truth = between(A, B)
    found = icp(line_map([first], [IDENTITY]), second.points, second.normals, truth + np.array(off))
    assert found.pose == pytest.approx(truth, abs=2e-3)
    assert found.share > 0.8
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0


def test_a_corridor_leaves_the_way_along_it_open() -> None:
    """The walls hold position across and heading; the prior holds the way along, with its deviation."""
    start, truth = np.array((0.0, 0.2, 0.1)), np.array((0.4, 0.25, 0.15))
    lines = line_map([scan_at(HALLWAY, start, angles=fan(361, 360.0))], [start])
    scan = scan_at(HALLWAY, truth, angles=fan(361, 360.0))
    mean = np.array((0.33, 0.2, 0.1))
    prior = (mean, np.diag((0.08**-2, 0.08**-2, 0.1**-2)))
    found = icp(lines, scan.points, scan.normals, mean, prior)
    deviations = np.sqrt(found.covariance.diagonal())
    assert found.pose[1:] == pytest.approx(truth[1:], abs=2e-3)
    assert found.pose[0] == pytest.approx(mean[0], abs=0.02)
    assert 0.07 < deviations[0] <= 0.081
    assert deviations[1] < 0.01 and deviations[2] < 0.01


def test_noisy_normals_tell_no_motion_along_a_corridor() -> None:
    """Normals that scatter by 10 degrees slope against the corridor. The walls hold nothing along it all the same."""
    generator, truth = np.random.default_rng(1), np.array((0.2, 0.0, 0.0))

    def noisy(scan: KeyScan) -> KeyScan:
        turns = np.radians(10.0) * generator.standard_normal(len(scan.points))
        turned = [rotated(turn, normal[None])[0] for turn, normal in zip(turns, scan.normals, strict=True)]
        return replace(scan, normals=np.stack(turned))

    for _ in range(5):
        walls, seen = (noisy(scan_at(HALLWAY, pose, angles=fan(361, 360.0))) for pose in (IDENTITY, truth))
        prior = (IDENTITY, np.diag((0.15**-2, 0.15**-2, 0.1**-2)))
        found = icp(line_map([walls], [IDENTITY]), seen.points, seen.normals, IDENTITY, prior, open_share=0.01)
        assert math.sqrt(found.covariance[0, 0]) > 0.1
        assert abs(found.pose[1]) < 0.02


def test_a_turned_corridor_has_a_whole_covariance() -> None:
    """A corridor at 45 degrees of the frame: x and y are known by their difference, and not one by one."""
    turn = np.array((0.0, 0.0, math.pi / 4))
    scan = scan_at(HALLWAY, IDENTITY, angles=fan(361, 360.0))
    covariance = icp(
        line_map([scan], [turn]), scan.points, scan.normals, turn, (turn, np.diag((100.0, 100.0, 100.0)))
    ).covariance
    along, across = (np.array(v) / math.sqrt(2.0) for v in ((1.0, 1.0, 0.0), (1.0, -1.0, 0.0)))
    assert along @ covariance @ along > 200.0 * (across @ covariance @ across)
    assert covariance[0, 1] / covariance[0, 0] > 0.9


def test_surfaces_that_face_away_are_not_matched() -> None:
    """Both sides of a thin wall: a scan from behind it does not lie on its front."""
    wall = np.array((((0.0, 0.0), (6.0, 0.0)),))
    front, behind = (scan_at(wall, np.array((3.0, y, -math.copysign(math.pi / 2, y)))) for y in (2.0, -2.0))
    lines = line_map([front], [np.array((3.0, 2.0, -math.pi / 2))])
    found = icp(lines, behind.points, behind.normals, np.array((3.0, -2.0, math.pi / 2)))
    assert found.fitted == 0 and found.share == 0.0


def test_covariances_are_honest() -> None:
    """Over many noisy scans errors are as large as their deviations say, and at most a little smaller."""
    generator = np.random.default_rng(3)
    noise = (0.02, generator)
    lines = line_map([scan_at(ROOM, A, angles=fan(361, 270.0), noise=noise) for _ in range(6)], [A] * 6)
    squares = []
    for _ in range(60):
        scan = scan_at(ROOM, B, angles=fan(361, 270.0), noise=noise)
        found = icp(lines, scan.points, scan.normals, B)
        off = found.pose - B
        squares.append(off @ np.linalg.solve(found.covariance, off))
    assert 0.2 < np.mean(squares) / 3.0 < 2.0


def test_outliers_hardly_pull() -> None:
    """People who stand in a fifth of the view."""
    first, second = (scan_at(ROOM, pose, angles=fan(361, 270.0)) for pose in (A, B))
    points = second.points.copy()
    points[: len(points) // 5] *= 0.6
    found = icp(line_map([first], [IDENTITY]), points, second.normals, between(A, B) + 0.03)
    assert found.pose == pytest.approx(between(A, B), abs=5e-3)
    assert found.share < 0.9


def test_nothing_to_register_leaves_the_prior() -> None:
    empty = np.empty((0, 2))
    lines = line_map([scan_at(ROOM, A)], [A])
    prior = (A + 0.1, np.eye(3) * 25.0)
    found = icp(lines, empty, empty, A, prior)
    assert found.pose == pytest.approx(prior[0]) and found.covariance == pytest.approx(np.eye(3) / 25.0)
    assert found.share == 0.0
