"""A drive as MRPT takes it, and where MRPT is installed its programs on a drive whose truth is known."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.baselines import mrpt_slam
from training.baselines.mrpt_slam import MrptConfig
from training.data.lidar_drives import LidarDrive, TruePoses

ROOM = ((-6.0, -3.0), (6.0, 5.0))


def in_a_room(pose: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Ranges from a pose to the walls of a rectangular room."""
    direction = pose[2] + angles
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(direction) > 0, ROOM[1][0] - pose[0], ROOM[0][0] - pose[0]) / np.cos(direction)
        y = np.where(np.sin(direction) > 0, ROOM[1][1] - pose[1], ROOM[0][1] - pose[1]) / np.sin(direction)
    return np.minimum(x, y)


def drive(upside_down: bool = False) -> LidarDrive:
    """A curve through the room, seen by a laser ahead of the robot's middle, with wheels that turn too much."""
    steps = 60
    yaw = 0.012 * np.arange(steps)
    truth = np.stack((0.05 * np.cumsum(np.cos(yaw)), 0.05 * np.cumsum(np.sin(yaw)), yaw), axis=-1)
    truth[:, :2] -= truth[0, :2]
    counted = 1.3 * yaw
    wheels = np.stack((0.05 * np.cumsum(np.cos(counted)), 0.05 * np.cumsum(np.sin(counted)), counted), axis=-1)
    angles = np.linspace(-2.0, 2.0, 241)
    mounting = Mounting(np.array((0.2, 0.0, 0.1)), upside_down)
    stamps = (1 + np.arange(steps)) * 10**8
    scans = []
    for stamp, pose in zip(stamps.tolist(), truth, strict=True):
        laser = pose + (0.2 * math.cos(pose[2]), 0.2 * math.sin(pose[2]), 0.1)
        ranges = in_a_room(laser, -angles if upside_down else angles).astype(np.float32)
        scans.append(LidarScan(stamp, -2.0, angles[1] - angles[0], ranges, 0.05, 30.0, 0.0, "laser"))
    poses = tuple(WheelPose(int(stamp), pose) for stamp, pose in zip(stamps, wheels, strict=True))
    return LidarDrive("curve", "curve", tuple(scans), poses, mounting, TruePoses(stamps, truth))


@pytest.mark.parametrize("upside_down", [False, True])
@pytest.mark.parametrize("program", ["icp-slam", "rbpf-slam"])
def test_a_program_corrects_wheels_that_turn_too_much(program: mrpt_slam.Program, upside_down: bool) -> None:
    if lacking := mrpt_slam.missing(program):
        pytest.skip(lacking)
    a = drive(upside_down)
    assert isinstance(a.reference, TruePoses)
    found = mrpt_slam.run(program, a, MrptConfig(step_m=0.1))
    truth, wheels = a.reference.poses_xyyaw, np.stack([pose.pose_xyyaw for pose in a.wheels])
    assert found.poses_xyyaw.shape == (60, 3)
    assert abs(wheels[-1, 2] - truth[-1, 2]) > 0.2
    assert abs(found.poses_xyyaw[-1, 2] - truth[-1, 2]) < 0.05
    assert np.hypot(*(found.poses_xyyaw[-1] - truth[-1])[:2]) < 0.1


def test_frames_come_by_way_and_by_turn() -> None:
    wheels = np.zeros((9, 3))
    wheels[:, 0] = (0.0, 0.1, 0.2, 0.3, 0.4, 0.4, 0.4, 0.4, 0.4)
    wheels[5:, 2] = np.radians((4.0, 8.0, 12.0, 12.0))
    assert mrpt_slam._frames(wheels, MrptConfig(step_m=0.16, step_deg=6.0)).tolist() == [0, 2, 4, 5, 7]


def test_rays_are_thinned_and_sorted_from_right_to_left() -> None:
    ranges = np.arange(1.0, 8.0, dtype=np.float32)
    scan = LidarScan(0, 0.6, -0.2, ranges, 0.0, 6.5, 0.0, "laser")  # clockwise, from 0.6 to -0.6
    raw = mrpt_slam._scan(scan, Mounting(np.array((1.0, 2.0, 0.5))), most_rays=4)
    assert raw.laser == pytest.approx([1.0, 2.0, 0.5])
    assert raw.view_rad == pytest.approx(1.2)
    assert raw.ranges.tolist() == [7.0, 5.0, 3.0, 1.0]
    assert raw.returned.tolist() == [False, True, True, True]


def test_a_drive_without_wheels_is_refused() -> None:
    a = drive()
    without = LidarDrive(a.name, a.identity, a.scans, (), a.mounting, a.reference)
    with pytest.raises(ValueError, match="no wheel odometry"):
        mrpt_slam.run("icp-slam", without, MrptConfig())
