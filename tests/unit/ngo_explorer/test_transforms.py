"""Chains of transforms: where the robot is, and of when that is."""

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from tf2_msgs.msg import TFMessage

from ngo_explorer.nodes.transforms import TransformTree


def placed(frame: str, child: str, x: float, stamp_s: int) -> TFMessage:
    found = TransformStamped(child_frame_id=child)
    found.header.frame_id, found.header.stamp.sec = frame, stamp_s
    found.transform.translation.x, found.transform.rotation.w = x, 1.0
    return TFMessage(transforms=[found])


def test_a_pose_is_as_old_as_the_robots_own_motion() -> None:
    tree = TransformTree()
    tree.take(placed("footprint", "base_link", 1.0, 3), static=True)
    assert tree.pose("map", "base_link") is None
    tree.take(placed("odom", "footprint", 10.0, 7))
    tree.take(placed("map", "odom", 100.0, 9))
    found = tree.pose("map", "base_link")
    assert found is not None
    pose, stamp_s = found
    np.testing.assert_array_equal(pose, (111.0, 0.0, 0.0))
    assert stamp_s == pytest.approx(7.0)
