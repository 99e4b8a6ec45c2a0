"""Steps get the robot's pose on TF at their own stamp, wait for it while it may come, and say what is missing."""

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.nodes.odometry_on_tf import OdometryOnTf
from ngo_recordings.poses import make_pose
from ngo_recordings.transform_buffer import TransformBuffer

S = 10**9
STEP_NS = S // 10


def step(k: int) -> RelativeStep:
    nothing = np.zeros(0, np.float32)
    return RelativeStep(
        stamp_ns=100 * S + k * STEP_NS,
        from_stamp_ns=100 * S + (k - 1) * STEP_NS,
        relative_xyyaw=np.array([0.1, 0.0, 0.0]),
        covariance=1e-4 * np.eye(3),
        origin_stamp_ns=100 * S,
        odom_xyyaw=np.array([0.1 * k, 0.0, 0.0]),
        motion_feature=nothing,
        place_code=nothing,
    )


def play(late_s: float, clock_s: float, count: int = 60, ends: int = 1000) -> tuple[list[RelativeStep], OdometryOnTf]:
    """A robot at 1 m/s whose transforms come late_s after the scans, stamped by a clock that is ahead by clock_s."""
    buffer, found = TransformBuffer(), []
    on_tf = OdometryOnTf(buffer, "odom", "base_link")
    buffer.add("base_footprint", "base_link", 0, make_pose((0.0, 0.0, 0.1), (0, 0, 0, 1)), static=True)
    late = round(late_s / 0.1)
    for k in range(count):
        if late <= k < ends:
            stamp_ns = 100 * S + (k - late) * STEP_NS + round(clock_s * 1e9) + STEP_NS // 3
            pose = make_pose((7.0 + (stamp_ns / S - 100.0), 0.0, 0.0), (0, 0, 0, 1))
            buffer.add("odom", "base_footprint", stamp_ns, pose, static=False)
        on_tf.add(step(k))
        found += on_tf.ready(0.0)
    return found, on_tf


@pytest.mark.parametrize("late_s", [0.0, 0.4, 2.0])
def test_a_late_pose_is_waited_for_and_interpolated_at_the_stamp(late_s: float) -> None:
    found, on_tf = play(late_s, 0.0)
    known = [each for each in found if each.tf_odom_known]
    assert len(known) >= 60 - round(late_s / 0.1) - 2 and on_tf.waiting <= round(late_s / 0.1) + 1
    for each in known:
        expected = 7.0 + (each.stamp_ns - 100 * S) / S
        np.testing.assert_allclose(each.tf_odom_xyyaw, [expected, 0.0, 0.0], atol=1e-6)
    assert (on_tf.problem() != "") == (late_s > 1.5)


@pytest.mark.parametrize("clock_s", [5.0, 1.7e9, -1.7e9])
def test_transforms_of_another_clock_are_said_and_no_pose_is_made_up(clock_s: float) -> None:
    found, on_tf = play(0.0, clock_s, count=40)
    assert not any(each.tf_odom_known for each in found)
    assert "no map -> odom for the newest scan" in on_tf.problem() and "of 'base_footprint' is at" in on_tf.problem()
    later = play(0.0, clock_s, count=16)[1]
    assert later.problem(), "it is said within 2 s"
    if abs(clock_s) > 10.0:
        assert len(found) >= 40 - 26, "the path goes on"


def test_odometry_that_ends_is_said_and_steps_go_on_without() -> None:
    found, on_tf = play(0.0, 0.0, count=80, ends=20)
    assert all(each.tf_odom_known for each in found[1:19]), "the first one came before the odometry"
    assert not any(each.tf_odom_known for each in found[20:])
    assert len(found) == 80 and "older" in on_tf.problem()


def test_it_is_said_while_scans_wait_for_their_mounting() -> None:
    buffer = TransformBuffer()
    on_tf = OdometryOnTf(buffer, "odom", "base_link")
    stamps_ns = [100 * S + k * STEP_NS for k in range(16)]
    assert "no map -> odom" in on_tf.problem(stamps_ns) and not on_tf.problem(stamps_ns[:15])
    for stamp_ns in stamps_ns[:2]:
        buffer.add("odom", "base_link", stamp_ns, make_pose((0.0, 0.0, 0.0), (0, 0, 0, 1)), static=False)
    assert not on_tf.problem(stamps_ns), "the first one is known"
