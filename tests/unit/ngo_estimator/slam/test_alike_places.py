"""A way is clear at its place alone, and a place is shown by the key scans around it, whichever drive they are of."""

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.geometry.se2 import between as between_all
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.slam.scan_matcher import REACH_M, ScanMatcher
from tests.unit.ngo_estimator.lidar_steps import lidar_steps
from tests.unit.ngo_estimator.loops.buildings import HALLWAY, ROUND, outline, scan_at, way


def matcher_of(
    walls: np.ndarray, poses: np.ndarray, reach_m: float = REACH_M, parts: np.ndarray | None = None
) -> ScanMatcher:
    random = np.random.default_rng(0)
    scans = [scan_at(walls, pose, random) for pose in poses]
    return ScanMatcher(scans, poses, KeyScanViews().of_map(scans), ScanLoopConfig(), reach_m, parts)


def test_a_way_is_clear_at_its_place_by_the_walls_that_it_has_in_common_with_the_map() -> None:
    matcher, again = matcher_of(HALLWAY, way(*ROUND, ROUND[0])), way(*ROUND)[:40]
    random = np.random.default_rng(1)
    odometry = np.array([between(again[0], pose) for pose in again])
    for step in lidar_steps(odometry, lambda k, stamp_ns: scan_at(HALLWAY, again[k], random)):
        matcher.append(step, step.odom_xyyaw)
    place, aside, turned = again[-1], again[-1] + (2.0, 0.0, 0.0), again[-1] + (0.0, 0.0, np.pi)
    assert matcher.is_clear(place)
    assert not any(matcher.is_clear(pose) or matcher.allows(pose) for pose in (aside, turned))


def test_a_place_is_shown_by_key_scans_of_all_drives_in_whatever_order_they_were_left() -> None:
    ring, random = way(*ROUND, ROUND[0]), np.random.default_rng(2)
    aside = range(0, 400, 40)
    walls = np.concatenate([HALLWAY + (x, 0, x, 0) for x in aside])
    left = np.concatenate([ring[::3] + (x, 0, 0) for x in aside])
    matcher = matcher_of(walls, random.permutation(left), np.inf, np.zeros(len(left), np.int64))
    again = ring[20:24]
    for step in lidar_steps(between_all(again[0], again), lambda k, stamp_ns: scan_at(HALLWAY, again[k], random)):
        matcher.append(step, step.odom_xyyaw)
    (found,) = matcher.around(again[-1] + (0.3, -0.3, 0.1)).poses
    assert np.hypot(*between(again[-1], found)[:2]) < 0.03


@pytest.mark.parametrize(("crooked", "part"), [(slice(0, 68, 2), 0), (slice(100, 124, 2), 1)])
def test_a_place_is_shown_neither_by_key_scans_far_from_it_nor_by_those_of_drives_that_no_loop_ties_to_it(
    crooked: slice, part: int
) -> None:
    pillars = [outline((x, 0), (x + 0.5, 0), (x + 0.5, 0.4), (x, 0.4)) for x in (2, 5, 7, 11, 16, 18, 23, 29, 34)]
    corridor, random = np.concatenate((outline((0, 0), (40, 0), (40, 2), (0, 2)), *pillars)), np.random.default_rng(0)
    there, back = way((1, 1.2), (39, 1.2)), way((39, 1.2), (1, 1.2))[crooked]
    straight = there[5:25:2]
    scans = [scan_at(corridor, pose, random) for pose in (*straight, *back)]
    poses, parts = np.concatenate((straight, back + (0, 0.3, 0.05))), np.repeat((0, part), (len(straight), len(back)))
    matcher = ScanMatcher(scans, poses, KeyScanViews().of_map(scans), ScanLoopConfig(), np.inf, parts)
    again = there[12:16]
    for step in lidar_steps(between_all(again[0], again), lambda k, stamp_ns: scan_at(corridor, again[k], random)):
        matcher.append(step, step.odom_xyyaw)
    (found,) = matcher.around(again[-1] + (0.1, -0.1, 0.03)).poses
    assert np.hypot(*between(again[-1], found)[:2]) < 0.03
