"""Scans and wheel poses come in order; wheels, mounting and angles are found or doubted by the rules."""

import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ngo_recordings.errors import RecordingError
from ngo_recordings.laser_scan import LidarScan, scan_angles
from ngo_recordings.lidar_description import describe_lidar
from ngo_recordings.mounting import find_mounting
from ngo_recordings.odometry_poses import OdometryPoses
from ngo_recordings.recording import open_recording
from ngo_recordings.scan_stream import BAD_SCAN, BAD_WHEELS, ImuReading, WheelPose, scan_stream
from ngo_recordings.topics import GroundTruth, RecordingTopics, TopicArguments, WheelSource, choose_topics

from . import messages as m

S = 10**9
STILL = m.twist(0.0, 0.0, 0.0)
WITH_WHEELS = RecordingTopics("/scan", wheels=WheelSource("/odom"))


def stamp(k: float) -> int:
    return 10 * S + round(k * S / 10)


def scan(stamp_ns: int, frame: str = "laser", rays: int = 20, increment: float = 0.1) -> Any:
    made = m.scan(stamp_ns, np.arange(1.0, 1.0 + rays), increment=increment)
    made.header.frame_id = frame
    return made


def odometry(stamp_ns: int, x: float, y: float, yaw: float, frame: str = "odom") -> Any:
    made = m.odometry(stamp_ns, m.pose(x, y, yaw), STILL)
    made.header.frame_id = frame
    return made


def drive(count: int = 20, lag_ns: int = 0) -> list[m.Entry]:
    """Odometry at every stamp and scans between, odometry recorded late by lag_ns."""
    entries: list[m.Entry] = []
    for k in range(count):
        entries.append(("/odom", stamp(k) + lag_ns, odometry(stamp(k), 0.1 * k, -0.2, 0.01 * k)))
        entries.append(("/scan", stamp(k + 0.5), scan(stamp(k + 0.5))))
    return sorted(entries, key=lambda entry: entry[1])


def static(parent: str, child: str, *pose: float, **turn: float) -> Any:
    return m.transform(0, parent, child, m.pose(*pose, **turn))


@pytest.mark.parametrize("kind", ["PoseStamped", "PoseWithCovarianceStamped", "TwistStamped"])
def test_odometry_of_another_type_counts_where_it_is_named(tmp_path: Path, kind: str) -> None:
    def wheels(k: int) -> Any:
        pose = m.pose(0.1 * k, 0.0, 0.0)
        inside = {
            "PoseStamped": pose,
            "PoseWithCovarianceStamped": m.make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36)),
            "TwistStamped": m.twist(1.0, 0.0, 0.0),
        }
        return m.make(f"geometry_msgs/msg/{kind}", m.header(stamp(k), "odom"), inside[kind])

    entries = [("/scan", stamp(k), scan(stamp(k))) for k in range(9)]
    entries += [(name, stamp(k), wheels(k)) for name in ("/encoders", "/cmd_vel", "/goal_pose") for k in range(9)]
    in_map = m.make("geometry_msgs/msg/PoseStamped", m.header(stamp(0), "map"), m.pose(1.0, 0.0, 0.0))
    entries += [("/localization", stamp(k), in_map) for k in range(9)]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        (note,) = describe_lidar(recording, choose_topics(recording)).notes
        assert "if it is /encoders (10.0 Hz), --wheels names it" in note
        assert not describe_lidar(recording, choose_topics(recording, TopicArguments(wheels="none"))).notes
        topics = choose_topics(recording, TopicArguments(wheels="/encoders"))
        assert "wheels: /encoders, 9 poses" in describe_lidar(recording, topics).lines()
        poses = [each.pose_xyyaw for each in scan_stream(recording, topics) if isinstance(each, WheelPose)]
    np.testing.assert_allclose(poses, [(0.1 * k, 0.0, 0.0) for k in range(9)], atol=1e-12)


def test_odometry_with_velocities_alone_is_summed_up(tmp_path: Path) -> None:
    entries: list[m.Entry] = []
    for k in range(60):
        made = odometry(stamp(k), 0.0, 0.0, 0.0)
        made.twist.twist = m.twist(0.5, 0.0, 0.2)
        if k % 2:
            made.pose.pose.orientation.w = 0.0  # as robots leave it that fill in nothing
        entries += [("/odom", stamp(k), made), ("/scan", stamp(k), scan(stamp(k)))]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        found = [each for each in scan_stream(recording, WITH_WHEELS, skipped=Counter()) if isinstance(each, WheelPose)]
    turned, radius = 0.2 * 5.9, 0.5 / 0.2
    np.testing.assert_allclose(
        found[-1].pose_xyyaw, [radius * math.sin(turned), radius * (1.0 - math.cos(turned)), turned], atol=1e-3
    )
    poses = OdometryPoses()
    for k in range(60):  # the direction is filled in, as from a compass, and the place is not
        made = odometry(stamp(k), 0.0, 0.0, 0.02 * k)
        made.twist.twist = m.twist(0.5, 0.0, 0.2)
        summed = poses.read(made)
    np.testing.assert_allclose(summed, found[-1].pose_xyyaw, atol=1e-3)
    standing = odometry(stamp(1), 1.0, 2.0, 0.5)
    poses = OdometryPoses()
    for _ in range(20):
        np.testing.assert_allclose(poses.read(standing), [1.0, 2.0, 0.5], atol=1e-12)


def test_single_wrong_velocities_change_no_unit() -> None:
    poses, headings = OdometryPoses(), []
    for k in range(60):
        made = odometry(stamp(k), 0.0, 0.0, 0.0)
        made.twist.twist = m.twist(0.5, 0.0, 20.0 if k in (10, 20, 30) else 0.4)
        pose = poses.read(made)
        assert pose is not None
        headings.append(pose[2])
    np.testing.assert_allclose(np.diff(headings[35:]), 0.04, atol=1e-9)


@pytest.mark.parametrize("lag_ns", [0, S // 5, 9 * S // 10])
def test_records_come_in_order_of_their_stamps_however_late_they_were_recorded(tmp_path: Path, lag_ns: int) -> None:
    with open_recording([m.write_mcap(tmp_path / "a.mcap", drive(lag_ns=lag_ns))]) as recording:
        found = list(scan_stream(recording, WITH_WHEELS))
    assert [each.stamp_ns for each in found] == [stamp(k / 2) for k in range(40)]
    wheels = [each.pose_xyyaw for each in found if isinstance(each, WheelPose)]
    np.testing.assert_allclose(wheels, [[0.1 * k, -0.2, 0.01 * k] for k in range(20)], atol=1e-12)
    scans = [each for each in found if isinstance(each, LidarScan)]
    assert scans[0].frame_id == "laser" and scans[0].ranges.dtype == np.float32
    assert (scans[0].angle_min, scans[0].angle_increment) == pytest.approx((-1.0, 0.1))
    np.testing.assert_array_equal(scans[0].ranges, np.arange(1.0, 21.0))


def test_wheels_come_before_a_scan_of_the_same_stamp(tmp_path: Path) -> None:
    entries = [("/scan", stamp(1), scan(stamp(1))), ("/odom", stamp(1), odometry(stamp(1), 0, 0, 0))]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        assert [type(each) for each in scan_stream(recording, WITH_WHEELS)] == [WheelPose, LidarScan]


def test_a_source_that_restarts_begins_anew(tmp_path: Path) -> None:
    entries = drive(20)
    again = [(topic, time_ns + 100 * S, message) for topic, time_ns, message in drive(20)]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", [*entries, *again])]) as recording:
        found = [each.stamp_ns for each in scan_stream(recording, WITH_WHEELS)]
    assert found == 2 * [stamp(k / 2) for k in range(40)]


@pytest.mark.parametrize("chained", [False, True])
def test_wheels_of_transforms(tmp_path: Path, chained: bool) -> None:
    child = "base_footprint" if chained else "base_link"
    entries: list[m.Entry] = [("/tf_static", stamp(0), m.transforms(static("base_footprint", "base_link", 0.5, 0, 0)))]
    for k in range(20):
        moved = m.transform(stamp(k), "odom", child, m.pose(0.1 * k, 0.0, math.pi / 2))
        other = m.transform(stamp(k), "map", "odom", m.pose(9.0, 9.0, 1.0))
        entries += [("/tf", stamp(k), m.transforms(other, moved)), ("/scan", stamp(k), scan(stamp(k)))]
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    topics = RecordingTopics("/scan", wheels=WheelSource.parse("tf:odom:base_link"))
    with open_recording([path]) as recording:
        poses = [each.pose_xyyaw for each in scan_stream(recording, topics) if isinstance(each, WheelPose)]
        assert choose_topics(recording).wheels == WheelSource(tf=("odom", child))
    expected = [[0.1 * k, 0.5 if chained else 0.0, math.pi / 2] for k in range(20)]
    np.testing.assert_allclose(poses, expected, atol=1e-9)


@pytest.mark.parametrize("parent", ["odom_combined", "world", "start", "base_footprint", "base_stabilized"])
def test_odometry_on_tf_below_a_frame_called_odom_counts_and_below_others_is_named(tmp_path: Path, parent: str) -> None:
    entries: list[m.Entry] = [("/tf_static", stamp(0), m.transforms(static("base_link", "laser", 0.5, 0, 0)))]
    for k in range(20):
        moved = m.transform(stamp(k), parent, "base_link", m.pose(0.1 * k, 0.0, 0.0))
        entries += [("/tf", stamp(k), m.transforms(moved)), ("/scan", stamp(k), scan(stamp(k)))]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        topics = choose_topics(recording)
        (*_, note) = ("", *describe_lidar(recording, topics).notes)
    assert str(topics.wheels) == ("tf:odom_combined:base_link" if parent == "odom_combined" else "None")
    assert (f"if it is tf:{parent}:base_link, --wheels names it" in note) == (parent in ("world", "start"))


def test_of_several_echoes_the_first_counts(tmp_path: Path) -> None:
    plain, echo = scan(stamp(1)), m.STORE.types["sensor_msgs/msg/LaserEcho"]
    echoes = [echo(np.array([each, each + 1.0][: 1 + k % 2], np.float32)) for k, each in enumerate(plain.ranges)]
    echoes[3] = echo(np.zeros(0, np.float32))
    fields = {**vars(plain), "ranges": echoes, "intensities": []}
    fields.pop("__msgtype__", None)
    made = m.STORE.types["sensor_msgs/msg/MultiEchoLaserScan"](**fields)
    with open_recording([m.write_mcap(tmp_path / "a.mcap", [("/echoes", stamp(1), made)])]) as recording:
        topics = choose_topics(recording)
        (found,) = scan_stream(recording, topics)
        assert describe_lidar(recording, topics).rays == len(plain.ranges)
    assert isinstance(found, LidarScan) and np.isnan(found.ranges[3])
    np.testing.assert_array_equal(np.delete(found.ranges, 3), np.delete(plain.ranges, 3))


def test_what_is_damaged_is_counted_or_named(tmp_path: Path) -> None:
    entries = drive(3)
    entries.append(("/odom", stamp(4), odometry(stamp(4), math.nan, 0, 0)))
    entries.append(("/scan", stamp(5), scan(stamp(5), increment=0.0)))
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        skipped: Counter[str] = Counter()
        assert len(list(scan_stream(recording, WITH_WHEELS, skipped=skipped))) == 6
        assert skipped == {BAD_SCAN: 1, BAD_WHEELS: 1}
        with pytest.raises(RecordingError, match=r"a scan of /scan has 20 rays 0 rad apart"):
            list(scan_stream(recording, WITH_WHEELS))
        with pytest.raises(RecordingError, match=r"topic /odom is nav_msgs/msg/Odometry; expected sensor_msgs"):
            list(scan_stream(recording, RecordingTopics("/odom")))


@pytest.mark.parametrize(
    ("unit", "said"),
    [
        (0.0, "stand still"),
        (1e-3, "run 0.001 times as fast as the clock"),
        (1e3, "run 1e+03 times as fast as the clock"),
        (-1e7, "run -1e+07 times as fast as the clock"),  # overflowed
    ],
)
def test_where_stamps_run_as_no_clock_does_the_times_of_the_recording_count(
    tmp_path: Path, unit: float, said: str
) -> None:
    for wrong in ("/scan", "/odom"):
        entries = drive(30)
        for topic, time_ns, message in entries:
            if topic == wrong:
                stamp_ns = round(unit * time_ns)
                message.header.stamp.sec, message.header.stamp.nanosec = stamp_ns // 10**9, stamp_ns % 10**9
        with open_recording([m.write_mcap(tmp_path / f"{wrong[1:]}.mcap", entries)]) as recording:
            topics = choose_topics(recording)
            assert recording.notes == (f"stamps of {wrong} {said}: the times of the recording count",)
            records = list(scan_stream(recording, topics))
            assert [r.stamp_ns for r in records if isinstance(r, LidarScan)] == [stamp(k + 0.5) for k in range(30)]
            assert [r.stamp_ns for r in records if isinstance(r, WheelPose)] == [stamp(k) for k in range(30)]


def geometry(low: float, high: float, increment: float, rays: int) -> Any:
    made = scan(stamp(0), rays=rays)
    made.angle_min, made.angle_max, made.angle_increment = (math.radians(value) for value in (low, high, increment))
    return made


@pytest.mark.parametrize(
    ("low", "high", "increment", "rays", "counts", "likely", "note"),
    [
        (-90, 90, 1.0, 181, 1.0, None, None),
        (-90, 90, 180 / 179, 180, 180 / 179, 1.0, "likely are 1.0000 deg"),
        (-180, 178.0028, 359 / 360, 360, 359 / 360, 1.0, "one ray more"),
        (-90, 90, 0.5, 361, 0.5, None, None),
        (-90, 90, 1.0, 180, 1.0, None, "angle_max"),
        (-90, 90, 0.5, 181, 1.0, None, "contradicts its ends"),
        (90, -90, -1.0, 181, -1.0, None, None),
        (90, -90, 1.0, 181, -1.0, None, "contradicts its ends"),
        (180, -180, 1.0, 360, -1.0, None, "contradicts its ends"),
        (-90, 90, 0.0, 181, 1.0, None, "its ends count"),
        (-90, 90, math.nan, 181, 1.0, None, "its ends count"),
        (-90, 0.0, 1e-9, 181, 0.5, None, "its ends count"),
        (-180, 180, 0.25, 1441, 0.25, None, None),
        (-90, math.nan, 1.0, 181, 1.0, None, "angle_max"),
        (-180, -181, 1.0, 360, 1.0, None, "angle_max"),
        (150, -150, 1.0, 61, 1.0, None, "angle_max"),
        (80, -80, 1.0, 201, 1.0, None, "angle_max"),
    ],
)
def test_angles_follow_the_rule(
    low: float, high: float, increment: float, rays: int, counts: float, likely: float | None, note: str | None
) -> None:
    angles = scan_angles(geometry(low, high, increment, rays))
    assert math.degrees(angles.angle_increment) == pytest.approx(counts)
    assert math.degrees(angles.angle_min) == pytest.approx(low)
    found = None if angles.likely_increment is None else math.degrees(angles.likely_increment)
    assert found == (None if likely is None else pytest.approx(likely))
    assert (note is None) == (angles.note is None) and (note or "") in (angles.note or "")


def test_angles_in_degrees_are_taken_so() -> None:
    message = scan(stamp(0), rays=181)
    message.angle_min, message.angle_max, message.angle_increment = -90.0, 90.0, 1.0
    angles = scan_angles(message)
    assert (angles.angle_min, angles.angle_increment) == pytest.approx((-0.5 * math.pi, math.pi / 180.0))
    assert angles.note is not None and "are in degrees" in angles.note


@given(low=st.floats(), high=st.floats(), increment=st.floats(), rays=st.integers(0, 5))
def test_angles_are_within_a_turn_or_refused(low: float, high: float, increment: float, rays: int) -> None:
    message = scan(stamp(0), rays=rays)
    message.angle_min, message.angle_max, message.angle_increment = low, high, increment
    try:
        angles = scan_angles(message)
    except RecordingError:
        return
    assert 0.0 < abs(angles.angle_increment) * max(rays - 1, 1) < math.inf and math.isfinite(angles.angle_min)
    assert abs(angles.angle_increment) * (rays - 1) < 6.4


def test_an_empty_scan_and_one_of_more_than_a_turn_do_not_end_a_recording(tmp_path: Path) -> None:
    increment = math.radians(1.0)
    whole = [scan(stamp(k), rays=360, increment=increment) for k in range(4)]
    whole[0].ranges = np.zeros(0, np.float32)
    whole[2] = scan(stamp(2), rays=400, increment=increment)
    whole[3].range_min, whole[3].range_max = 12.0, 0.1  # leaves no range: neither is believed
    whole[1].range_min = whole[1].range_max = math.nan
    entries = [("/scan", stamp(k), each) for k, each in enumerate(whole)]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        topics = choose_topics(recording)
        skipped: Counter[str] = Counter()
        found = [each for each in scan_stream(recording, topics, skipped=skipped) if isinstance(each, LidarScan)]
        assert [len(each.ranges) for each in found] == [360, 360, 360] and skipped == {BAD_SCAN: 1}
        assert [each.range_max for each in found] == [0.0, 10.0, 0.0]
        assert len(found[0].hits()) == 360
        described = describe_lidar(recording, topics)
    assert described.rays == 360 and "1 of the first 200 scans of /scan are damaged" in described.notes[0]


def test_a_caller_may_override_the_increment(tmp_path: Path) -> None:
    with open_recording([m.write_mcap(tmp_path / "a.mcap", drive(2))]) as recording:
        found = list(scan_stream(recording, RecordingTopics("/scan"), angle_increment=0.25))
        assert [each.angle_increment for each in found if isinstance(each, LidarScan)] == [0.25, 0.25]
        for increment in (0.0, 1e-9, math.nan):
            with pytest.raises(RecordingError, match="the increment is"):
                list(scan_stream(recording, RecordingTopics("/scan"), angle_increment=increment))


def mounted(path: Path, *entries: m.Entry, frame: str = "laser") -> Any:
    scans = [("/scan", stamp(k), scan(stamp(k), frame)) for k in range(3)]
    odometries = [("/odom", stamp(k), odometry(stamp(k), 0, 0, 0)) for k in range(3)]
    with open_recording([m.write_mcap(path, [*entries, *odometries, *scans])]) as recording:
        return find_mounting(recording, choose_topics(recording))


def test_a_chain_of_static_transforms_is_composed(tmp_path: Path) -> None:
    parts = (static("base_link", "plate", 0.3, 0.1, math.pi / 2, z=0.2), static("plate", "laser", 0.1, 0.0, 0.5, z=0.1))
    for name, entries in {
        "one": [("/tf_static", 1, m.transforms(*parts))],
        "two": [("/tf_static", 1, m.transforms(parts[1])), ("/tf_static", 2, m.transforms(parts[0]))],
    }.items():
        found = mounted(tmp_path / f"{name}.mcap", *entries)
        np.testing.assert_allclose(found.base_from_scan_xyyaw, [0.3, 0.2, math.pi / 2 + 0.5], atol=1e-12)
        assert (found.source, found.upside_down, found.base_frame) == ("/tf_static", False, "base_link")
        assert found.height_m == pytest.approx(0.3) and found.tilt_rad == pytest.approx(0.0, abs=1e-7)


@pytest.mark.parametrize("yaw", [0.0, 1.0, -3.0])
def test_a_scanner_that_hangs_upside_down_is_seen(tmp_path: Path, yaw: float) -> None:
    found = mounted(
        tmp_path / "a.mcap", ("/tf_static", 1, m.transforms(static("base_link", "laser", 0.2, 0, yaw, 0, math.pi)))
    )
    assert found.upside_down and "upside down" in str(found)
    np.testing.assert_allclose(found.base_from_scan_xyyaw, [0.2, 0.0, yaw], atol=1e-9)


def mounting_of_drives(tmp_path: Path, *drives: tuple[int, int, Mapping[int, float]]) -> Any:
    """Of files, each with its start (ns), its count of scans, and when the scanner is said to sit where (x, m)."""
    paths = []
    for start_ns, scans, said in drives:
        entries = [(name, at + start_ns, message) for name, at, message in drive(scans)]
        for at, x in said.items():
            entries.append(("/tf_static", at, m.transforms(static("base_link", "laser", x, 0.0, 0.0))))
        paths.append(m.write_mcap(tmp_path / f"{len(paths)}.mcap", sorted(entries, key=lambda entry: entry[1])))
    with open_recording(paths) as recording:
        return find_mounting(recording, WITH_WHEELS)


def test_of_a_mounting_that_changes_the_one_that_holds_longest_counts(tmp_path: Path) -> None:
    found = mounting_of_drives(tmp_path, (0, 20, {stamp(0): 0.3, stamp(15): 0.9, stamp(18): 0.3}))
    assert found.base_from_scan_xyyaw[0] == pytest.approx(0.3) and "it changes on the way" in str(found)


def test_two_robots_whose_frames_have_the_same_names_are_told(tmp_path: Path) -> None:
    entries = [*drive(10), *(("/other/scan", stamp(k + 0.5), scan(stamp(k + 0.5))) for k in range(10))]
    for at, x in ((1, 0.3), (2, 0.9)):
        entries.append(("/tf_static", at, m.transforms(static("base_link", "laser", x, 0.0, 0.0))))
    with open_recording([m.write_mcap(tmp_path / "a.mcap", sorted(entries, key=lambda entry: entry[1]))]) as recording:
        notes = describe_lidar(recording, choose_topics(recording)).notes
    assert [note for note in notes if "robots whose frames have the same names cannot be told apart" in note]


def test_time_without_scans_speaks_for_no_mounting(tmp_path: Path) -> None:
    found = mounting_of_drives(tmp_path, (0, 20, {1: 5.0, stamp(-10): 0.3}))
    assert found.base_from_scan_xyyaw[0] == pytest.approx(0.3)
    pause_ns = 3600 * S
    found = mounting_of_drives(tmp_path, (0, 3, {stamp(-1): 5.0}), (pause_ns, 20, {stamp(-1) + pause_ns: 0.3}))
    assert found.base_from_scan_xyyaw[0] == pytest.approx(0.3)


def test_a_tilt_is_stated(tmp_path: Path) -> None:
    found = mounted(
        tmp_path / "a.mcap", ("/tf_static", 1, m.transforms(static("base_link", "laser", 0, 0, 0, pitch=0.3)))
    )
    assert found.tilt_rad == pytest.approx(0.3) and "tilted by 17.2 deg" in str(found)


def test_transforms_that_are_sent_again_and_again_serve_but_not_those_that_move_the_robot(tmp_path: Path) -> None:
    moving = m.transform(stamp(0), "odom", "base_link", m.pose(5.0, 5.0, 1.0))
    sent = m.transform(stamp(0), "base_link", "laser", m.pose(0.1, 0.0, 0.2))
    found = mounted(tmp_path / "a.mcap", ("/tf", stamp(0), m.transforms(moving)), ("/tf", stamp(1), m.transforms(sent)))
    assert found.source == "/tf"
    np.testing.assert_allclose(found.base_from_scan_xyyaw, [0.1, 0.0, 0.2], atol=1e-12)
    outside = m.transform(stamp(0), "odom", "laser", m.pose(0.1, 0.0, 0.2))
    assert mounted(tmp_path / "b.mcap", ("/tf", stamp(0), m.transforms(moving, outside))) is None


def test_a_chain_may_be_said_in_part_by_static_transforms(tmp_path: Path) -> None:
    lift = m.transform(stamp(0), "base_link", "lift", m.pose(0.1, 0.0, 0.0))
    laser = static("lift", "laser", 0.2, 0.0, 0.5)
    said = ("/tf", stamp(0), m.transforms(lift)), ("/tf_static", stamp(1), m.transforms(laser))
    found = mounted(tmp_path / "a.mcap", *said)
    np.testing.assert_allclose(found.base_from_scan_xyyaw, [0.3, 0.0, 0.5], atol=1e-12)


def test_without_transforms_the_mounting_is_not_known_unless_frames_are_the_same(tmp_path: Path) -> None:
    assert mounted(tmp_path / "a.mcap") is None
    found = mounted(tmp_path / "b.mcap", frame="base_link")
    assert found.source == "the scan's own frame" and not found.base_from_scan_xyyaw.any()
    cyclic = m.transforms(static("a", "laser", 1, 0, 0), static("laser", "a", 1, 0, 0))
    assert mounted(tmp_path / "c.mcap", ("/tf_static", 1, cyclic)) is None


def test_of_transforms_that_go_round_or_give_two_parents_those_count_that_lead_to_the_robot(tmp_path: Path) -> None:
    right, back = static("base_link", "laser", 0.3, 0.1, 0.5), static("laser", "base_link", 0.0, 0.0, 0.0)
    other, round_ = static("chassis", "laser", 0.9, 0.0, 0.0), static("laser", "chassis", 0.0, 0.0, 0.0)
    for k, parts in enumerate([(right, back), (back, right), (right, other), (other, right), (right, other, round_)]):
        found = mounted(tmp_path / f"{k}.mcap", ("/tf_static", 1, m.transforms(*parts)))
        np.testing.assert_allclose(found.base_from_scan_xyyaw, [0.3, 0.1, 0.5], atol=1e-12)
        assert ("/tf_static, whose transforms go round" in str(found)) == (k < 2)
    assert str(found).endswith("(from /tf_static, which gives laser several parents)")


@pytest.mark.parametrize("own_topics", [False, True])
@pytest.mark.parametrize("robot", ["robot1", "robot2"])
def test_each_robot_of_a_recording_has_its_own_wheels_and_mounting(
    tmp_path: Path, robot: str, own_topics: bool
) -> None:
    """Frames with a prefix on one /tf; or topics of transforms in each robot's namespace, whose frames are the same."""
    entries: list[m.Entry] = []
    for k, name in enumerate(("robot1", "robot2")):
        prefix, tf = ("", f"/{name}/tf") if own_topics else (f"{name}/", "/tf")
        mounting = static(f"{prefix}base_link", f"{prefix}laser", 0.1 + k, 0, 0)
        entries.append((f"{tf}_static", stamp(0), m.transforms(mounting)))
        for step in range(5):
            made = odometry(stamp(step), 0.1 * step, 0, 0, f"{prefix}odom")
            made.child_frame_id = f"{prefix}base_link"
            entries.append((f"/{name}/odom", stamp(step), made))
            entries.append((f"/{name}/scan", stamp(step), scan(stamp(step), f"{prefix}laser")))
            sent = m.transform(stamp(step), f"{prefix}odom", f"{prefix}base_link", m.pose(0.1 * step, 0, 0))
            entries.append((tf, stamp(step), m.transforms(sent)))
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        topics = choose_topics(recording, TopicArguments(image=f"/{robot}/scan"))
        found = find_mounting(recording, topics)
        assert topics.wheels == WheelSource(f"/{robot}/odom") and found is not None
        assert found.base_from_scan_xyyaw[0] == pytest.approx(0.1 if robot == "robot1" else 1.1)
        by_tf = RecordingTopics(topics.image, wheels=WheelSource(tf=(f"{found.base_frame[:-9]}odom", found.base_frame)))
        assert len([each for each in scan_stream(recording, by_tf) if isinstance(each, WheelPose)]) == 5


@pytest.mark.parametrize(("scans", "wheels"), [("/lidar/front", "/diff_drive/odom"), ("/scan_1", "/odom_1")])
def test_wheels_are_those_that_carry_the_scanner(tmp_path: Path, scans: str, wheels: str) -> None:
    """Topics and frames may have any names: transforms say what belongs together."""
    entries: list[m.Entry] = [("/tf_static", stamp(0), m.transforms(static("body_1", "eye_1", 0.1, 0, 0)))]
    for k in range(5):
        entries.append((scans, stamp(k), scan(stamp(k), "eye_1")))
        for name, child in ((wheels, "body_1"), ("/odom_2", "body_2")):
            made = odometry(stamp(k), 0.1 * k, 0, 0, "odom_1")
            made.child_frame_id = child
            entries.append((name, stamp(k), made))
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        topics = choose_topics(recording, TopicArguments(image=scans))
        found = find_mounting(recording, topics)
    assert topics.wheels == WheelSource(wheels) and found is not None and found.base_frame == "body_1"


@pytest.mark.parametrize(("roll", "rate"), [(0.0, 0.3), (math.pi, -0.3), (math.pi / 2, 0.1)])
def test_an_imu_says_the_robots_own_yaw_rate_and_where_up_is(tmp_path: Path, roll: float, rate: float) -> None:
    entries = drive(5)
    entries.append(("/tf_static", 1, m.transforms(static("base_link", "gyro", 0.1, 0, 0, roll=roll))))
    for k in range(4):
        values = (np.zeros(9), m.vector(0.0, 0.1, 0.3), np.zeros(9), m.vector(0.0, 0.0, 9.8), np.zeros(9))
        orientation = m.pose(0, 0, 0.7, roll=roll, pitch=0.1).orientation  # the robot's nose is down
        made = m.make("sensor_msgs/msg/Imu", m.header(stamp(k), "gyro"), orientation, *values)
        entries.append(("/imu/data", stamp(k), made))
    with open_recording([m.write_mcap(tmp_path / "a.mcap", sorted(entries, key=lambda entry: entry[1]))]) as recording:
        topics = choose_topics(recording)
        found = [each for each in scan_stream(recording, topics) if isinstance(each, ImuReading)]
        assert topics.imu == "/imu/data" and "IMU: /imu/data (10.0 Hz)" in describe_lidar(recording, topics).lines()
        assert choose_topics(recording, TopicArguments(imu="none")).imu is None
    assert [each.stamp_ns for each in found] == [stamp(k) for k in range(4)]
    assert [each.rate_rps for each in found] == pytest.approx([rate] * 4)
    assert found[0].up is not None
    np.testing.assert_allclose(found[0].up, [-math.sin(0.1), 0.0, math.cos(0.1)], atol=1e-9)


def test_a_direction_that_is_given_leaves_the_scanner_its_place(tmp_path: Path) -> None:
    entries = [("/tf_static", 1, m.transforms(static("base_link", "laser", 0.78, 0.1, 0.3))), *drive(3)]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        given = describe_lidar(recording, choose_topics(recording)).looking_at(math.pi)
    assert given.mounting is not None
    np.testing.assert_allclose(given.mounting.base_from_scan_xyyaw, [0.78, 0.1, math.pi], atol=1e-12)
    assert "x 0.780 m, y 0.100 m, yaw 180.0 deg" in given.lines()[1] and "as it was given" in given.lines()[1]


def test_of_several_scans_and_odometries_one_is_taken_and_the_others_are_named(tmp_path: Path) -> None:
    entries = drive(10)
    for name in ("/scan_filtered", "/front/scan"):
        entries += [(name, stamp(k + 0.5), scan(stamp(k + 0.5))) for k in range(20)]
    for name in ("/wheel/odom", "/odometry/filtered"):
        entries += [(name, stamp(k), odometry(stamp(k), 0, 0, 0)) for k in range(20)]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", sorted(entries, key=lambda entry: entry[1]))]) as recording:
        topics = choose_topics(recording)
        assert (topics.image, topics.wheels) == ("/scan", WheelSource("/wheel/odom"))
        scans, wheels = describe_lidar(recording, topics).notes
    assert scans.startswith("scans of /scan are used; others are /front/scan (10.0 Hz), /scan_filtered (10.0 Hz)")
    assert wheels.startswith(
        "/wheel/odom is used of /wheel/odom (10.0 Hz), /odom (10.0 Hz), /odometry/filtered (10.0 Hz)"
    )


def chosen(path: Path, odometries: dict[str, str], given: TopicArguments | None = None) -> RecordingTopics:
    entries = [(name, stamp(0), odometry(stamp(0), 0, 0, 0, frame)) for name, frame in odometries.items()]
    with open_recording([m.write_mcap(path, [*entries, ("/scan", stamp(0), scan(stamp(0)))])]) as recording:
        return choose_topics(recording, given)


@pytest.mark.parametrize(
    ("odometries", "wheels"),
    [
        ({}, None),
        ({"/odom": "odom"}, "/odom"),
        ({"/whatever": "odom"}, "/whatever"),
        ({"/ground_truth": "odom"}, None),
        ({"/odom": "map"}, None),
        ({"/odom": "odom", "/ground_truth": "map"}, "/odom"),
        ({"/odom": "odom", "/odometry/filtered": "odom"}, "/odom"),
        ({"/wheel_odometry": "odom", "/odometry/filtered": "odom"}, "/wheel_odometry"),
        ({"/a": "odom", "/b": "odom"}, None),
    ],
)
def test_wheels_are_chosen_where_they_are_clear_and_are_never_the_truth(
    tmp_path: Path, odometries: dict[str, str], wheels: str | None
) -> None:
    found = chosen(tmp_path / "a.mcap", odometries).wheels
    assert found == (None if wheels is None else WheelSource(wheels))


def test_wheels_are_named_or_left_out(tmp_path: Path) -> None:
    both = {"/odom": "odom", "/b": "odom"}
    assert chosen(tmp_path / "a.mcap", both, TopicArguments(wheels="none")).wheels is None
    assert chosen(tmp_path / "b.mcap", both, TopicArguments(wheels="b")).wheels == WheelSource("/b")
    truth = chosen(tmp_path / "c.mcap", both, TopicArguments(ground_truth="/odom"))
    assert (truth.ground_truth, truth.wheels) == (GroundTruth(topic="/odom"), WheelSource("/b"))
    for arguments, complaint in (
        (TopicArguments(wheels="/odom", ground_truth="/odom"), "wheel odometry and ground truth are both /odom"),
        (TopicArguments(wheels="tf:odom"), "expected tf:PARENT:CHILD, as in tf:odom:base_link"),
        (TopicArguments(wheels="tf:odom:base_link"), "no topic holds transforms"),
        (TopicArguments(wheels="/scan"), "topic /scan for the wheels is sensor_msgs/msg/LaserScan"),
        (TopicArguments(wheels="/gone"), "there is no topic /gone for the wheels"),
    ):
        with pytest.raises(RecordingError, match=complaint):
            chosen(tmp_path / "d.mcap", both, arguments)
    with pytest.raises(RecordingError, match="exactly one of"):
        WheelSource()


def test_a_lidar_is_described(tmp_path: Path) -> None:
    entries = [("/tf_static", 1, m.transforms(static("base_link", "laser", 0.1, 0, 0))), *drive()]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        found = describe_lidar(recording, choose_topics(recording))
        assert (found.scan_topic, found.scans, found.rays, found.stamps) == ("/scan", 20, 20, "recorded")
        assert found.rate_hz == pytest.approx(10.0) and found.field_of_view == pytest.approx(1.9)
        assert (found.wheels, found.wheel_poses, found.notes) == (WheelSource("/odom"), 20, ())
        lines = found.lines()
        assert lines[1] == "mounting: laser in base_link at x 0.100 m, y 0.000 m, yaw 0.0 deg (from /tf_static)"
        assert lines[2] == "wheels: /odom, 20 poses" and lines[3] == "stamps: recorded"
    with open_recording([m.write_mcap(tmp_path / "b.mcap", [("/scan", k, scan(0)) for k in range(3)])]) as recording:
        found = describe_lidar(recording, RecordingTopics("/scan"))
        assert (found.stamps, found.rate_hz, found.mounting) == ("none", None, None)
        assert "mounting: not in the recording" in found.lines() and "wheels: none" in found.lines()
