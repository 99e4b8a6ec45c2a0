"""Poses in space and in time: residuals, interpolation, chains of transforms, and the buffer of a live node."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ngo_recordings.errors import RecordingError
from ngo_recordings.poses import Pose, PoseTrack, TransformTree, make_pose, read_tum
from ngo_recordings.transform_buffer import FramePoses, TransformBuffer

from . import messages as m

S = 10**9
angles = st.floats(-3.0, 3.0)
metres = st.floats(-20.0, 20.0)
poses = st.builds(
    lambda x, y, z, a, b, c: Pose(np.array([x, y, z]), Rotation.from_rotvec([a, b, c])),
    metres, metres, metres, st.floats(-1.7, 1.7), st.floats(-1.7, 1.7), st.floats(-1.7, 1.7),
)  # fmt: skip


def flat(x: float, y: float, yaw: float) -> Pose:
    return Pose(np.array([x, y, 0.0]), Rotation.from_euler("z", yaw))


def assert_same(one: Pose | None, other: Pose, atol: float = 1e-9) -> None:
    assert one is not None
    np.testing.assert_allclose(one.position, other.position, atol=atol)
    np.testing.assert_allclose(one.rotation.as_matrix(), other.rotation.as_matrix(), atol=atol)


@given(x=metres, y=metres, z=metres, yaw=angles, pitch=st.floats(-1.4, 1.4), roll=angles)
def test_planar_part_and_residual_are_the_usual_angles(
    x: float, y: float, z: float, yaw: float, pitch: float, roll: float
) -> None:
    pose = Pose(np.array([x, y, z]), Rotation.from_euler("ZYX", [yaw, pitch, roll]))
    planar, residual = pose.planar()
    np.testing.assert_allclose(planar, [x, y, yaw], atol=1e-7)
    np.testing.assert_allclose(residual, [z, roll, pitch], atol=1e-7)


@given(a=poses, b=poses, share=st.integers(0, 1000))
def test_interpolation_moves_along_one_screw_free_line(a: Pose, b: Pose, share: int) -> None:
    track = PoseTrack(gap_ns=1000)
    track.add(0, a)
    track.add(1000, b)
    middle = track.at(share)
    assert middle is not None
    whole = (a.rotation.inv() * b.rotation).magnitude()
    assert math.isclose((a.rotation.inv() * middle.rotation).magnitude(), share / 1000 * whole, abs_tol=1e-6)
    np.testing.assert_allclose(middle.position - a.position, share / 1000 * (b.position - a.position), atol=1e-9)


def test_nothing_is_made_up_beyond_the_ends_or_over_a_gap() -> None:
    track = PoseTrack(gap_ns=1 * S)
    assert track.at(0) is None and track.newest_ns is None
    for second in (1, 2, 5):
        track.add(second * S, flat(second, 0.0, 0.0))
    assert track.at(round(0.9 * S)) is None
    assert track.at(round(5.1 * S)) is None
    assert track.at(3 * S) is None
    assert_same(track.at(round(1.25 * S)), flat(1.25, 0.0, 0.0))
    # Rounded in a text file, a stamp is the same within 1 ms.
    assert_same(track.at(5 * S + 400_000), flat(5.0, 0.0, 0.0))


@given(order=st.permutations(range(6)))
def test_late_poses_go_to_their_place(order: list[int]) -> None:
    track = PoseTrack(gap_ns=S)
    for k in order:
        track.add(k * S, flat(k, -k, 0.0))
    for k in range(5):
        assert_same(track.at(k * S + S // 2), flat(k + 0.5, -k - 0.5, 0.0))


def test_a_chain_goes_up_and_down_the_tree_with_what_is_static() -> None:
    tree = TransformTree(gap_ns=S)
    map_from_odom, odom_from_base = flat(10.0, 0.0, math.pi / 2), flat(1.0, 2.0, 0.3)
    base_from_camera, world_from_map = flat(0.2, 0.0, -0.1), flat(0.0, 5.0, 0.0)
    tree.add("base", "camera", 0, base_from_camera, static=True)
    tree.add("world", "map", 0, world_from_map, static=True)
    assert tree.lookup("map", "camera", S) is None and tree.known_until_ns("map", "camera") is None
    tree.add("map", "odom", 1 * S, map_from_odom, static=False)
    tree.add("odom", "base", 1 * S, odom_from_base, static=False)
    tree.add("odom", "base", 2 * S, odom_from_base, static=False)
    assert tree.known_until_ns("map", "camera") == 1 * S
    expected = map_from_odom @ odom_from_base @ base_from_camera
    assert_same(tree.lookup("map", "camera", 1 * S), expected)
    assert_same(tree.lookup("camera", "map", 1 * S), expected.inverse())
    assert_same(tree.lookup("world", "camera", 1 * S), world_from_map @ expected)
    assert tree.lookup("map", "camera", 2 * S) is None, "odom is known for 1 s only"
    assert tree.lookup("map", "nowhere", 1 * S) is None
    tree.add("map", "odom", 2 * S, map_from_odom, static=False)
    assert_same(tree.lookup("map", "camera", round(1.5 * S)), expected)
    assert_same(tree.lookup("odom", "camera", round(1.5 * S)), odom_from_base @ base_from_camera)


def test_a_ring_of_transforms_is_no_endless_loop() -> None:
    tree = TransformTree(gap_ns=S)
    tree.add("a", "b", 0, flat(1.0, 0.0, 0.0), static=True)
    tree.add("b", "a", 0, flat(-1.0, 0.0, 0.0), static=True)
    assert tree.lookup("a", "c", 0) is None
    assert tree.lookup("a", "b", 0) is not None


def test_poses_that_are_no_numbers_are_no_poses() -> None:
    assert make_pose((math.nan, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)) is None
    assert make_pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)) is None
    assert make_pose((0.0, 0.0, 0.0), (1e300, 0.0, 0.0, 1e300)) is None
    assert make_pose((1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 2.0)) is not None


def test_a_tum_file_is_read_to_the_microsecond(tmp_path: Path) -> None:
    path = tmp_path / "truth.tum"
    path.write_text("# timestamp tx ty tz qx qy qz qw\n1700000000.25 1 2 3 0 0 0 1\n1700000000.75 2 2 3 0 0 1 0\n")
    track = read_tum(path, gap_ns=S)
    pose = track.at(1_700_000_000_500_000_000)
    assert pose is not None
    np.testing.assert_allclose(pose.planar()[0], [1.5, 2.0, math.pi / 2], atol=1e-6)


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 2 3 4 5 6 7 nought\n", "0 1 2 3 0 0 0 1 9\n"])
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "truth.tum"
    path.write_text(text)
    with pytest.raises(RecordingError) as error:
        read_tum(path, gap_ns=S)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


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
