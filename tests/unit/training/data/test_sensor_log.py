from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.data.lidar_drives import LidarDrive, Relations, TruePoses
from training.data.sensor_log import FAR_AWAY_M, SensorLog

STAMPS = [10, 20, 30, 25, 30, 40]
POSES = np.stack((np.arange(6.0), np.zeros(6), np.zeros(6)), axis=-1)


def drive(reference: TruePoses | Relations | None) -> LidarDrive:
    scans = tuple(LidarScan(t, 0.0, 0.1, np.full(5, t, np.float32), 0.0, 50.0, 0.0, "laser") for t in STAMPS)
    wheels = tuple(map(WheelPose, STAMPS, POSES))
    return LidarDrive("one", "one", scans, wheels, Mounting(np.zeros(3)), reference)


def test_what_is_no_newer_than_before_is_left_out() -> None:
    log = SensorLog.of_drive(drive(TruePoses(np.array(STAMPS), POSES)))
    assert log.stamps_ns.tolist() == log.taken_ns.tolist() == log.wheel_stamps_ns.tolist() == [10, 20, 30, 40]
    assert log.ranges[:, 0].tolist() == [10, 20, 30, 40]
    assert log.true_poses is not None
    assert log.true_poses[:, 0].tolist() == log.wheel_poses[:, 0].tolist() == [0, 1, 2, 5]


def test_a_drive_is_that_of_its_log_with_the_truth_at_the_stamps_as_given() -> None:
    log = SensorLog.of_drive(drive(TruePoses(np.array(STAMPS), POSES)))
    late = replace(log, stamps_ns=log.stamps_ns + 5).drive("late", "why")
    assert late.scan_stamps_ns.tolist() == [15, 25, 35, 45]
    assert [pose.stamp_ns for pose in late.wheels] == [10, 20, 30, 40]
    assert isinstance(late.reference, TruePoses)
    assert late.reference.stamps_ns.tolist() == [15, 25, 35, 45]
    relations = Relations(np.zeros((0, 2)), np.zeros((0, 3)))
    assert SensorLog.of_drive(drive(relations)).drive("a", "b", relations).reference is relations


def test_steps_of_the_wheels_make_their_poses() -> None:
    log = SensorLog.of_drive(drive(None))
    turned = replace(log, wheel_poses=np.array([(1, 2, 0.5), (2, 2, 1.5), (2, 3, 3.0), (0, 0, -3.0)]))
    np.testing.assert_allclose(turned.with_wheel_steps(turned.wheel_steps).wheel_poses, turned.wheel_poses, atol=1e-12)


def test_scanners_that_change_and_truth_of_other_stamps_are_refused() -> None:
    other = drive(None)
    with pytest.raises(ValueError, match="all with the same rays"):
        SensorLog.of_drive(replace(other, scans=(other.scans[0], replace(other.scans[1], angle_min=1.0))))
    with pytest.raises(ValueError, match="other stamps"):
        SensorLog.of_drive(drive(TruePoses(np.arange(6), POSES)))


def test_logs_that_are_put_together_go_on_elsewhere() -> None:
    log = SensorLog.of_drive(drive(TruePoses(np.array(STAMPS), POSES)))
    turned = replace(log, wheel_poses=log.wheel_poses + (0.0, 7.0, 0.0))
    both = log.followed_by(turned, 1e-7)
    assert both.stamps_ns.tolist() == both.wheel_stamps_ns.tolist() == [10, 20, 30, 40, 140, 150, 160, 170]
    assert both.wheel_poses[:, 0].tolist() == [0, 1, 2, 5, 5, 6, 7, 10]
    assert not both.wheel_poses[:, 1:].any()
    assert both.true_poses is not None
    assert both.true_poses[4:, 0].tolist() == [FAR_AWAY_M + x for x in (0, 1, 2, 5)]
    here = log.followed_by(turned, 1e-7, 0.0).true_poses
    assert here is not None and here[4:, 0].tolist() == [0, 1, 2, 5]
