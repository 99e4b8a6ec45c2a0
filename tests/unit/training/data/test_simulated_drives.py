"""Simulated drives of the lidar's tables."""

import numpy as np

from training.data.building_drives import building_drive
from training.data.lidar_drives import TruePoses
from training.data.simulated_drives import maze_drive


def test_a_building_is_the_same_each_time_and_another_where_rooms_repeat() -> None:
    first, again = (building_drive(20_003, 3.0) for _ in range(2))
    aliased = building_drive(20_003, 3.0, aliased=True)
    assert len(first.scans) == len(first.wheels) > 10
    assert isinstance(first.reference, TruePoses)
    assert all(np.array_equal(a.ranges, b.ranges) for a, b in zip(first.scans, again.scans, strict=True))
    assert not np.array_equal(first.scans[0].ranges, aliased.scans[0].ranges)
    assert first.reference.stamps_ns.tolist() == [scan.stamp_ns for scan in first.scans]
    assert first.identity != aliased.identity


def test_a_maze_is_seen_from_left_to_right() -> None:
    drive = maze_drive(1_500, 4)
    scan = drive.scans[0]
    assert (len(scan.ranges), drive.wheels) == (241, ())
    np.testing.assert_allclose(
        np.degrees((scan.angle_min, scan.angle_min + 240 * scan.angle_increment)), (150.0, -150.0), atol=1e-6
    )
