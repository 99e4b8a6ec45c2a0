"""Localisation in the maps that the online systems keep: by place codes, and by a lidar's key scans."""

import dataclasses
import math

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RejectedStep
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.slam.map_localisation import LocalisedStep
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.golden.drives import WEIGHTS, GoldenDrive, estimates
from tests.unit.ngo_estimator.lidar_steps import HOUSE, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import fan, scan_at

ORIGIN = MapOrigin.of_first_pose(np.array((1.0, -2.0, 0.5)))


def last_pose(found: LocalisedStep) -> np.ndarray:
    assert found.found.pose_xyyaw is not None
    return found.found.pose_xyyaw


def test_a_map_has_the_frames_of_the_window_and_of_the_key_frames_once() -> None:
    poses = np.arange(30.0).reshape(10, 3)
    codes = np.arange(6.0).reshape(6, 1)
    places = PlaceMap.of_steps(np.array((1, 0, 2, 1, 6, 7)), codes, poses)
    assert places.poses[:, 0].tolist() == [3.0, 6.0, 9.0, 21.0, 24.0]
    assert places.codes[:, 0].tolist() == [1.0, 0.0, 2.0, 4.0, 5.0]
    assert places.runs[0] == places.runs[2] != places.runs[3] == places.runs[4]
    with pytest.raises(ValueError, match="at least one frame"):
        PlaceMap(np.zeros((0, 3)), np.zeros((0, 1)), np.zeros(0, np.int64))


def test_a_robot_that_starts_within_a_mapped_maze_finds_its_pose() -> None:
    drive = GoldenDrive.load("maze2d")
    steps = estimates(drive, LocalOdometry.load(WEIGHTS / "maze2d"))
    mapped = OnlineTrajectory.load(WEIGHTS / "maze2d", 40, key_frames=60)
    for step in steps:
        mapped.update(step)
    whole = mapped.trajectory()
    assert whole is not None
    localisation, first = mapped.localisation(ORIGIN), len(steps) // 3
    # From another start: the odometry has its own origin there.
    begin = steps[first].odom_xyyaw
    found: list[LocalisedStep] = []
    for step in steps[first + 1 :]:
        own = dataclasses.replace(step, odom_xyyaw=between(begin, step.odom_xyyaw), origin_stamp_ns=5)
        found.append(localisation.update(own))
    assert found[0].found.pose_xyyaw is None and found[0].map_from_odom_xyyaw is None
    assert any(one.found.claimed for one in found[:50]) and not any(one.found.lost for one in found)
    expected = ORIGIN.poses(whole.poses_xyyaw[-1])
    assert last_pose(found[-1]) == pytest.approx(expected, abs=0.02)
    map_from_odom = found[-1].map_from_odom_xyyaw
    assert map_from_odom is not None
    assert compose(map_from_odom, between(begin, steps[-1].odom_xyyaw)) == pytest.approx(last_pose(found[-1]))
    # The map is as it was, and an odometry that begins anew says nothing of where the robot is.
    np.testing.assert_array_equal(mapped.trajectory().poses_xyyaw, whole.poses_xyyaw)  # type: ignore[union-attr]
    again = localisation.update(dataclasses.replace(steps[first + 1], origin_stamp_ns=6))
    assert again.restarted and again.found.pose_xyyaw is None
    with pytest.raises(RejectedStep):
        localisation.update(dataclasses.replace(steps[first + 2], relative_xyyaw=np.full(3, np.nan)))


def test_a_lidar_finds_its_pose_in_the_key_scans_of_a_house() -> None:
    way, angles = loop_way(1.1), fan(181, 270.0)
    mapped = ScanTrajectory()
    for step in lidar_steps(way, lambda k, stamp_ns: scan_at(HOUSE, way[k], stamp_ns, angles)):
        mapped.update(step)
    # Another robot goes the other way round, somewhere beside the first way.
    start = len(way) // 2
    other = way[start::-1][:70] + (0.1, 0.15, 0.0)
    other[:, 2] += math.pi

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return scan_at(HOUSE, other[k], stamp_ns, angles)

    localisation = mapped.localisation(ORIGIN)
    seen = [between(other[0], pose) for pose in other]
    found = [localisation.update(step) for step in lidar_steps(np.array(seen), scan)]
    assert found[0].found.pose_xyyaw is None and sum(one.found.claimed for one in found) == 1
    expected = ORIGIN.poses(other[-1])
    off = between(expected, last_pose(found[-1]))
    assert np.hypot(*off[:2]) < 0.05 and abs(off[2]) < 0.02


def test_a_scanner_that_sees_no_more_than_what_is_ahead_is_found_on_the_way_back() -> None:
    """The scans from the same place show what is behind it; those from farther on show what it sees."""
    way, angles = loop_way(1.0), fan(181)
    mapped = ScanTrajectory()
    for step in lidar_steps(way, lambda k, stamp_ns: scan_at(HOUSE, way[k], stamp_ns, angles)):
        mapped.update(step)
    back = way[40::-1] + (0.0, 0.0, math.pi)
    matcher, seen, asked = mapped.back_end.matcher(MapOrigin.of_first_pose(np.zeros(3))), 0, 0
    odometry = np.array([between(back[0], pose) for pose in back])
    for step in lidar_steps(odometry, lambda k, stamp_ns: scan_at(HOUSE, back[k], stamp_ns, angles)):
        if matcher.append(step, step.odom_xyyaw):
            pose = compose(back[0], step.odom_xyyaw)
            poses = matcher.around(pose).poses
            asked, seen = asked + 1, seen + len(poses)
            assert all(np.hypot(*between(pose, found)[:2]) < 0.1 for found in poses)
    assert asked > 10 and seen >= 0.8 * asked
