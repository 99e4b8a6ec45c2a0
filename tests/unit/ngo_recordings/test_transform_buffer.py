"""Transforms of messages: chains at any stamp in bounded memory, frames with prefixes, and what is missing in words."""

from typing import Any

import numpy as np
import pytest

from ngo_recordings.transform_buffer import FramePoses, TransformBuffer

from . import messages as m

S = 10**9


def moved(stamp_ns: int, parent: str, child: str, x: float, yaw: float = 0.0) -> Any:
    return m.transform(stamp_ns, parent, child, m.pose(x, 0.0, yaw))


def test_a_chain_is_interpolated_between_its_stamps_and_not_beyond() -> None:
    buffer = TransformBuffer()
    buffer.take([moved(0, "/base_footprint", "base_link", 0.5)], static=True)
    for k in range(3):
        buffer.take([moved(k * S, "odom", "base_footprint", 1.0 * k)], static=False)
    found = buffer.lookup("odom", "base_link", 3 * S // 2)
    assert found is not None
    np.testing.assert_allclose(found.planar()[0], [2.0, 0.0, 0.0], atol=1e-12)
    assert buffer.lookup("odom", "base_link", 5 * S // 2) is None
    late = buffer.missing("odom", "base_link", 5 * S // 2)
    assert "newest transform of 'base_footprint' is at 2.000 s, 0.500 s older" in late
    assert buffer.missing("odom", "base_link", S) == ""


def test_what_is_missing_names_the_frames_that_are_there() -> None:
    buffer = TransformBuffer()
    assert buffer.missing("odom", "base_link", S) == (
        "no transform has the frame 'odom' or 'base_link'; frames that came: none"
    )
    buffer.take([moved(0, "odom", "base_footprint", 0.0)], static=False)
    assert "no transform has the frame 'base_link'" in buffer.missing("odom", "base_link", S)
    buffer.take([moved(0, "chassis", "base_link", 0.0)], static=True)
    apart = buffer.missing("odom", "base_link", S)
    assert apart == (
        "no transform joins 'odom' and 'base_link': 'odom' is below 'odom' and 'base_link' is below 'chassis'"
    )


def test_a_publisher_that_restarts_begins_anew_and_memory_is_bounded() -> None:
    buffer = TransformBuffer()
    for k in range(2000):
        buffer.take([moved(k * S // 10, "odom", "base_link", 0.1 * k)], static=False)
    assert buffer.lookup("odom", "base_link", 0) is None, "what is older than half a minute is dropped"
    buffer.take([moved(S, "odom", "base_link", 7.0)], static=False)
    assert buffer.known_until_ns("odom", "base_link") == S


@pytest.mark.parametrize("prefix", ["robot1/", "robot1_"])
def test_a_frame_is_found_by_its_name_behind_the_robots_prefix(prefix: str) -> None:
    buffer = TransformBuffer()
    for robot in (prefix, prefix.replace("1", "2")):
        parts = ("map", f"{robot}odom"), (f"{robot}odom", f"{robot}base_link"), (f"{robot}base_link", f"{robot}laser")
        buffer.take([moved(0, *part, 0.3) for part in parts], static=True)
    assert buffer.like("base_link", f"{prefix}laser") == f"{prefix}base_link"
    assert buffer.like("odom", f"{prefix}laser") == f"{prefix}odom"
    assert buffer.like("map", f"{prefix}laser") == "map"
    assert buffer.like("base_footprint", f"{prefix}laser") is None
    assert buffer.like("base_link", "elsewhere") is None


def test_poses_of_a_pair_of_frames_come_with_the_last_part_of_their_chain() -> None:
    poses = FramePoses(TransformBuffer(), "odom", "base_link")
    found = []
    for k in range(3):
        found += poses.read([moved(k * S, "odom", "base_footprint", 1.0 * k)], static=False)
        found += poses.read([moved(k * S, "base_footprint", "base_link", 0.5)], static=False)
    assert [(stamp_ns, pose.position[0]) for stamp_ns, pose in found] == [(0, 0.5), (S, 1.5), (2 * S, 2.5)]
    poses = FramePoses(TransformBuffer(), "odom", "base_link")
    stamps = [0, 2 * S, S]  # the last one is late
    found = [each for k in stamps for each in poses.read([moved(k, "odom", "base_link", 1.0)], static=False)]
    assert [stamp_ns for stamp_ns, _ in found] == stamps
    assert not list(poses.read([moved(3 * S, "odom", "base_link", float("nan"))], static=False)) and poses.bad == 1
