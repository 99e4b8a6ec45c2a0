"""Key scans in messages: as they were sent, and refused in one line where they are none."""

from typing import Any

import numpy as np
import pytest
from ngo_msgs.msg import KeyScan, RelativePose

from ngo_estimator.nodes.messages import relative_pose_message, relative_step
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.lidar_steps import lidar_steps
from tests.unit.ngo_estimator.ray_casting import ROOM, scan_at

POSES = np.column_stack((0.1 * np.arange(8), np.zeros(8), np.zeros(8)))
STEPS = list(lidar_steps(POSES, lambda k, stamp_ns: scan_at(ROOM, POSES[k] + (1.0, 1.0, 0.3), stamp_ns)))
KEY = next(k for k, step in enumerate(STEPS) if step.key is not None)


def message(**changes: Any) -> RelativePose:
    made: RelativePose = relative_pose_message(STEPS[KEY], "base_link")
    for name, value in changes.items():
        setattr(made.key_scan[0], name, value)
    return made


def test_a_key_scan_comes_as_it_was_sent() -> None:
    sent, step = STEPS[KEY].key, relative_step(message())
    assert sent is not None and step.key is not None
    for part in ("points", "normals", "angles", "ranges", "sensor_xyyaw"):
        np.testing.assert_array_equal(getattr(step.key.scan, part), getattr(sent.scan, part))
    assert step.key.scan.stamp_ns == sent.scan.stamp_ns and step.key.from_key_stamp_ns == sent.from_key_stamp_ns
    np.testing.assert_array_equal(step.key.covariance, sent.covariance)


@pytest.mark.parametrize(
    "changes",
    [
        {"points": [1.0, 2.0, 3.0]},
        {"points": []},
        {"normals": [1.0] * 4},
        {"points": [float("nan")] * 4, "normals": [0.0] * 4},
        {"points": [1e30] * 4, "normals": [0.0] * 4},
        {"points": [1.0] * 200_000, "normals": [0.0] * 200_000},
        {"angles": [0.0] * 500_000, "ranges": [1.0] * 500_000},
        {"angles": [0.0]},
        {"angles": [float("inf")], "ranges": [1.0]},
        {"max_range": 0.0},
        {"max_range": float("inf")},
        {"sensor": [float("nan"), 0.0, 0.0]},
        {"covariance": [float("nan")] * 9},
        {"covariance": [0.0] * 9},
        {"x": float("nan")},
        {"stamp": KeyScan().stamp},
    ],
    ids=str,
)
def test_a_bad_key_scan_is_refused_in_one_line(changes: dict[str, Any]) -> None:
    trajectory = ScanTrajectory()
    for step in STEPS[:KEY]:
        trajectory.update(step)
    before = trajectory.trajectory()
    with pytest.raises(ValueError, match=r"expected|finite") as told:
        trajectory.update(relative_step(message(**changes)))
    after = trajectory.trajectory()
    assert "\n" not in str(told.value) and len(str(told.value)) < 400
    assert before is not None and after is not None and before.poses_xyyaw.tobytes() == after.poses_xyyaw.tobytes()
    assert not trajectory.update(relative_step(message())).gap


@pytest.mark.parametrize("values", [[1.0], [1.0, 2.0, 3.0, 4.0], [0.0, float("nan"), 0.0]])
def test_a_bad_pose_of_the_robots_odometry_is_refused(values: list[float]) -> None:
    made = message()
    made.robot_odom = values
    with pytest.raises(ValueError, match="robot_odom_xyyaw"):
        ScanTrajectory().update(relative_step(made))
