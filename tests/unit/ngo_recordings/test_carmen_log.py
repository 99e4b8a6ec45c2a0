"""CARMEN logs are read as topics, with odometry, corrected poses and stamps told apart; damage is counted or named."""

import gzip
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ngo_recordings import carmen_log
from ngo_recordings.carmen_lines import OdometryLine, ScanLine, parse_line
from ngo_recordings.carmen_stamps import MADE_PERIOD_S
from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import frames
from ngo_recordings.mounting import find_mounting
from ngo_recordings.recording import Recording, open_recording
from ngo_recordings.topics import RecordingTopics, TopicArguments, WheelSource, choose_topics

Pose = tuple[float, float, float]


@pytest.fixture(autouse=True, params=[0, 4_000_000], ids=["long", "short"])
def kept_numbers(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """Each log is read as a long one, whose scans are read again, and as a short one, whose scans stay in memory."""
    kept = int(request.param)
    monkeypatch.setattr(carmen_log, "_MOST_KEPT_NUMBERS", kept)
    return kept


def numbers(values: Any) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def flaser(
    k: int, laser: Pose, robot: Pose | None = None, rays: int = 181, stamp: str = "", host: str = "robot"
) -> str:
    ranges = 1.0 + 0.01 * np.arange(rays) + 0.1 * (k % 3)
    tail = stamp or f"{100 + 0.2 * k:.3f} {host} {1 + 0.2 * k:.3f}"
    return f"FLASER {rays} {numbers(ranges)} {numbers(laser)} {numbers(robot or laser)} {tail}"


def odom(pose: Pose, time_s: float, forward: float = 0.5, turn: float = 0.1) -> str:
    return f"ODOM {numbers(pose)} {forward} {turn} 0 {time_s:.3f} robot {time_s:.3f}"


def write(path: Path, lines: list[str]) -> Path:
    text = "\n".join(["# CARMEN Logfile", *lines]) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


def compose(a: Pose, b: Pose) -> Pose:
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


def between(a: Pose, b: Pose) -> Pose:
    c, s = math.cos(a[2]), math.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return c * dx + s * dy, c * dy - s * dx, b[2] - a[2]


def drive(count: int) -> list[Pose]:
    """Along an arc."""
    poses = [(0.0, 0.0, 0.0)]
    for _ in range(count - 1):
        poses.append(compose(poses[-1], (0.2, 0.0, 0.05)))
    return poses


def planar(pose: Any) -> Pose:
    return pose.position.x, pose.position.y, 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)


def odometry_of(recording: Recording) -> np.ndarray:
    return np.array([planar(message.value.pose.pose) for message in recording.messages(["/odom"])])


def stamps_of(recording: Recording, topic: str) -> list[float]:
    found = [message.value.header.stamp for message in recording.messages([topic])]
    return [stamp.sec + 1e-9 * stamp.nanosec for stamp in found]


@pytest.mark.parametrize("name", ["a.log", "a.clf", "a.log.gz", "a.clf.gz"])
def test_a_raw_log_is_scans_and_their_odometry(tmp_path: Path, name: str) -> None:
    poses = drive(30)
    with open_recording([write(tmp_path / name, [flaser(k, pose) for k, pose in enumerate(poses)])]) as recording:
        assert {topic: info.count for topic, info in recording.topics.items()} == {
            "/scan": 30,
            "/odom": 30,
            "/tf_static": 1,
        }
        assert recording.notes == () and recording.stamps_made == () and recording.unfinished == ()
        np.testing.assert_allclose(odometry_of(recording), poses, atol=1e-8)
        np.testing.assert_allclose(stamps_of(recording, "/scan"), 100 + 0.2 * np.arange(30), atol=1e-6)
        message = next(recording.messages(["/odom"])).value
        assert message.header.frame_id == "odom" and message.child_frame_id == "base_link"
        assert math.isnan(message.twist.twist.linear.x)
        topics = choose_topics(recording)
        assert topics == RecordingTopics("/scan", wheels=WheelSource("/odom"))
        mounting = find_mounting(recording, topics)
        assert mounting is not None
        np.testing.assert_allclose(mounting.base_from_scan_xyyaw, 0.0)
        first = next(frames(recording, topics))
        np.testing.assert_allclose(first.image[0, ::-1, 0], 1.0 + 0.01 * np.arange(181), atol=1e-6)


@pytest.mark.parametrize(("rays", "degrees"), [(180, 1.0), (181, 1.0), (360, 0.5), (361, 0.5), (91, 2.0)])
def test_angles_of_a_flaser_follow_from_its_rays(tmp_path: Path, rays: int, degrees: float) -> None:
    lines = [flaser(k, pose, rays=rays) for k, pose in enumerate(drive(3))]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        scan = next(recording.messages(["/scan"])).value
        assert scan.header.frame_id == "laser"
        assert (scan.angle_min, scan.angle_increment) == pytest.approx((-math.pi / 2, math.radians(degrees)))
        assert scan.angle_max == pytest.approx(scan.angle_min + (rays - 1) * scan.angle_increment)
        assert len(recording.notes) == (rays == 91)


def test_what_a_sick_writes_for_no_return_is_infinite(tmp_path: Path) -> None:
    def line(k: int, no_return: str) -> str:
        ranges = [no_return if ray % 4 == 0 else f"{2 + ray / 100}" for ray in range(180)]
        return f"FLASER 180 {' '.join(ranges)} {k} 0 0 {k} 0 0 {k + 1} robot {k}"

    for value, note in (("81.91", False), ("32.767", True), ("51.16", True), ("nan", False)):
        with open_recording([write(tmp_path / "a.log", [line(k, value) for k in range(20)])]) as recording:
            ranges = next(recording.messages(["/scan"])).value.ranges
            assert np.isinf(ranges[::4]).all() and np.isfinite(np.delete(ranges, np.s_[::4])).all()
            assert bool(recording.notes) == note
    with open_recording([write(tmp_path / "a.log", [line(k, "31.0") for k in range(20)])]) as recording:
        assert np.isfinite(next(recording.messages(["/scan"])).value.ranges).all()  # a wall


def test_two_poses_that_differ_by_one_step_are_the_mounting(tmp_path: Path) -> None:
    offset = (-0.12, 0.03, math.pi)
    lines = [flaser(k, compose(pose, offset), pose) for k, pose in enumerate(drive(40))]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert "/corrected_pose" not in recording.topics
        np.testing.assert_allclose(odometry_of(recording), drive(40), atol=1e-8)
        mounting = find_mounting(recording, choose_topics(recording))
        assert mounting is not None and mounting.source == "/tf_static"
        x, y, yaw = mounting.base_from_scan_xyyaw
        assert (x, y, abs(yaw)) == pytest.approx((-0.12, 0.03, math.pi), abs=1e-6)


def test_two_poses_that_drift_apart_are_corrected_and_odometry(tmp_path: Path) -> None:
    corrected = [(0.2 * k, 0.0, 0.0) for k in range(30)]
    lines = ["PARAM robot_frontlaser_offset 0.25 nohost 0"]
    lines += [flaser(k, good, raw) for k, (good, raw) in enumerate(zip(corrected, drive(30), strict=True))]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        np.testing.assert_allclose(odometry_of(recording), drive(30), atol=1e-8)
        found = [planar(message.value.pose) for message in recording.messages(["/corrected_pose"])]
        np.testing.assert_allclose(found, corrected, atol=1e-8)
        assert len(recording.notes) == 1
        topics = choose_topics(recording, TopicArguments(ground_truth="/corrected_pose"))
        assert topics.wheels == WheelSource("/odom")
        poses = [frame.pose_xyyaw for frame in frames(recording, topics)]
        np.testing.assert_allclose(np.array(poses), corrected, atol=1e-8)
        mounting = find_mounting(recording, topics)
        assert mounting is not None
        np.testing.assert_allclose(mounting.base_from_scan_xyyaw, [0.25, 0.0, 0.0])


def test_odometry_lines_on_another_track_are_the_wheels(tmp_path: Path) -> None:
    lines = []
    for k, raw in enumerate(drive(30)):
        lines += [odom((raw[0] + 5.0, raw[1], raw[2]), 100 + 0.2 * k - 0.05), flaser(k, (0.2 * k, 0.0, 0.0))]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        expected = np.array(drive(30)) + [5.0, 0.0, 0.0]
        np.testing.assert_allclose(odometry_of(recording), expected, atol=1e-8)
        assert recording.topics["/corrected_pose"].count == 30


def gmapping_lines(raw: list[Pose], corrected: list[Pose], between_scans: int) -> list[str]:
    """As GMapping writes a log: ODOM lines go on from its own pose, the first one with a stamp from nowhere."""
    lines = [f"ODOM {numbers(raw[0])} 0 0 0 99.9 pippo 99.9"]
    for k in range(len(corrected)):
        at = k * between_scans
        lines += ["NEFF 30", flaser(k, corrected[k], host="pippo")]
        lines.append(f"ODOM {numbers(corrected[k])} 0 0 0 4.6e-86 pippo 4.6e-86")
        for j in range(1, between_scans + 1):
            if at + j < len(raw):
                pose = compose(corrected[k], between(raw[at], raw[at + j]))
                lines.append(odom(pose, 100 + 0.2 * (k + j / between_scans) - 0.001, 0.0, 0.0))
    return lines


def test_raw_odometry_of_a_log_of_gmapping_is_chained_between_scans(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    raw = drive(61)
    corrected = [compose(raw[3 * k], (0.01 * k, -0.02 * k, 0.01 * rng.normal())) for k in range(20)]
    with open_recording([write(tmp_path / "a.log", gmapping_lines(raw, corrected, 3))]) as recording:
        odometry = {
            round(stamp, 3): pose
            for stamp, pose in zip(stamps_of(recording, "/odom"), odometry_of(recording), strict=True)
        }
        at_scans = np.array([odometry[round(stamp, 3)] for stamp in stamps_of(recording, "/scan")])
        np.testing.assert_allclose(at_scans, raw[:60:3], atol=1e-6)
        assert len(odometry) == 20 + 60 + 1, "what GMapping repeats after a scan is left out"
        found = [planar(message.value.pose) for message in recording.messages(["/corrected_pose"])]
        np.testing.assert_allclose(found, corrected, atol=1e-8)
        assert any("GMapping wrote the log" in note for note in recording.notes)


def test_a_log_of_gmapping_without_moving_odometry_has_none(tmp_path: Path) -> None:
    lines = gmapping_lines(drive(1), drive(30), 1)
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert set(recording.topics) == {"/scan", "/corrected_pose", "/tf_static"}
        assert any("no wheel odometry" in note for note in recording.notes)
        assert choose_topics(recording).wheels is None


@pytest.mark.parametrize("stamp", ["0 robot 0", "1.01893e+09 robot 1.01893e+09", "nan robot x"])
def test_stamps_that_tell_nothing_are_made_and_it_is_said(tmp_path: Path, stamp: str) -> None:
    lines = []
    for k, pose in enumerate(drive(10)):
        lines += [flaser(k, pose, stamp=stamp), f"ODOM {numbers(pose)} 0 0 0 {stamp}"]
    path = write(tmp_path / "a.log", lines)
    with open_recording([path]) as recording:
        assert recording.stamps_made == (path,)
        assert any("no usable stamps" in note and "1 s from scan to scan" in note for note in recording.notes)
        np.testing.assert_allclose(np.diff(stamps_of(recording, "/scan")), MADE_PERIOD_S, atol=1e-8)
        assert (np.diff(stamps_of(recording, "/odom")) > 0.0).all()


def test_the_loggers_stamps_serve_where_the_scans_have_none(tmp_path: Path) -> None:
    lines = [flaser(k, pose, stamp=f"0 robot {5 + k}") for k, pose in enumerate(drive(10))]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert stamps_of(recording, "/scan") == [5.0 + k for k in range(10)]
        assert recording.stamps_made == () and "logger's" in recording.notes[0]


def test_odometry_with_stamps_from_nowhere_is_left_out(tmp_path: Path) -> None:
    lines = []
    for k, pose in enumerate(drive(10)):
        lines += [odom(pose, 5000.0 if k == 3 else 100 + 0.2 * k - 0.1), flaser(k, pose)]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert max(stamps_of(recording, "/odom")) < 102.0 and recording.topics["/odom"].count == 19
        assert "1 ODOM lines are left out" in recording.notes[0]


def configured(kind: str, k: int, remissions: int | None, poses: str) -> str:
    rays = [2.0 + 0.01 * ray for ray in range(269)] + [30.0, 99.0]
    extra = "" if remissions is None else f" {remissions} {'7 ' * remissions}"
    return f"{kind} 0 -2.356 4.712 0.017453 30 0.01 0 271 {numbers(rays)}{extra} {poses} {10 + k} robot {k}"


@pytest.mark.parametrize("kind", ["RAWLASER1", "ROBOTLASER1"])
@pytest.mark.parametrize("remissions", [None, 0, 5])
def test_newer_lines_say_their_own_angles(tmp_path: Path, kind: str, remissions: int | None) -> None:
    lines = []
    for k, pose in enumerate(drive(10)):
        laser = compose(pose, (0.3, 0.0, 0.0))
        tail = f"{numbers(laser)} {numbers(pose)} 0 0 0 0{'' if remissions is None else ' 1e6'}"
        lines += [odom(pose, 9.9 + k), configured(kind, k, remissions, tail if kind == "ROBOTLASER1" else "")]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert recording.notes == ()
        scan = next(recording.messages(["/scan"])).value
        assert (scan.angle_min, scan.angle_increment, scan.range_max) == (-2.356, 0.017453, 30.0)
        assert len(scan.ranges) == 271 and np.isinf(scan.ranges[-2:]).all()
        assert recording.topics["/odom"].count == (20 if kind == "ROBOTLASER1" else 10)
        message = next(recording.messages(["/odom"])).value
        assert (message.twist.twist.linear.x, message.twist.twist.angular.z) == (0.5, 0.1)
        mounting = find_mounting(recording, choose_topics(recording))
        assert (mounting is not None) == (kind == "ROBOTLASER1")


def test_of_several_kinds_of_scans_one_is_read_and_the_others_are_named(tmp_path: Path) -> None:
    lines = []
    for k, pose in enumerate(drive(10)):
        lines += [configured("RAWLASER1", k, 0, ""), flaser(k, pose), flaser(k, pose).replace("FLASER", "RLASER")]
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert recording.topics["/scan"].count == 10
        assert [note.split(": ", 1)[1] for note in recording.notes] == [
            "10 RAWLASER1 lines are left out",
            "10 RLASER lines are left out",
        ]


def test_a_damaged_line_is_left_out_and_counted(tmp_path: Path) -> None:
    lines = [flaser(k, pose) for k, pose in enumerate(drive(30))]
    lines[7] = lines[7][:400]
    lines[12] = lines[12].replace(" 1.01 ", " 1.0x ", 1)
    with open_recording([write(tmp_path / "a.log", lines)]) as recording:
        assert recording.topics["/scan"].count == len(list(recording.messages(["/scan"]))) == 28
        assert "2 damaged lines are left out, the first is line 9: FLASER" in recording.notes[0]


def test_a_log_that_is_cut_is_read_up_to_there(tmp_path: Path) -> None:
    lines = [flaser(k, pose) for k, pose in enumerate(drive(30))]
    path = write(tmp_path / "a.log", lines)
    path.write_bytes(path.read_bytes()[:-900])
    packed = write(tmp_path / "b.log.gz", lines)
    packed.write_bytes(packed.read_bytes()[:-600])
    for cut in (path, packed):
        with open_recording([cut]) as recording:
            assert recording.unfinished == (cut,)
            assert 0 < recording.topics["/scan"].count == len(list(recording.messages(["/scan"]))) < 30


def test_what_is_no_log_or_mostly_damaged_is_named_with_its_line(tmp_path: Path) -> None:
    good = [flaser(k, pose) for k, pose in enumerate(drive(10))]
    with pytest.raises(RecordingError, match=r"a\.log, line 2: FLASER .*10 of 10 lines are damaged"):
        open_recording([write(tmp_path / "a.log", [line[:300] for line in good])])
    with pytest.raises(RecordingError, match=r"has no FLASER, ROBOTLASER, RAWLASER or ODOM line"):
        open_recording([write(tmp_path / "a.log", ["INFO: started", "INFO: stopped"])])
    (tmp_path / "a.log").write_bytes(b"FLASER " * 10**6)
    with pytest.raises(RecordingError, match=r"a\.log, line 1: longer than"):
        open_recording([tmp_path / "a.log"])
    packed = bytearray(write(tmp_path / "a.log.gz", good * 10).read_bytes())
    packed[-6] ^= 1  # the checksum
    (tmp_path / "a.log.gz").write_bytes(packed)
    with pytest.raises(RecordingError, match=r"a\.log\.gz is damaged after line \d+"):
        open_recording([tmp_path / "a.log.gz"])


def test_a_bomb_and_a_pipe_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.log.gz"
    path.write_bytes(gzip.compress(b"#\n" * 2**24))
    with pytest.raises(RecordingError, match=r"line 100001: of 100001 lines 0 are scans or odometry"):
        open_recording([path])
    path.write_bytes(gzip.compress((b"#" * 2000 + b"\n") * 2**16))
    with pytest.raises(RecordingError, match=r"unpacks to more than 67108864 bytes"):
        open_recording([path])
    path.write_bytes(gzip.compress(bytes(2**27)))
    with pytest.raises(RecordingError, match=r"line 1: longer than"):
        open_recording([path])
    for name in ("b.log", "b.mcap", "b.bag", "b.db3"):
        os.mkfifo(tmp_path / name)
        with pytest.raises(RecordingError, match="is no regular file"):
            open_recording([tmp_path / name])


REALS = st.floats(-1e6, 1e6, allow_nan=False)


@given(
    ranges=st.lists(st.floats(0.0, 81.0), min_size=1, max_size=400),
    poses=st.lists(REALS, min_size=6, max_size=6),
    stamp=st.floats(0.0, 2e9),
)
def test_what_is_written_is_read(ranges: list[float], poses: list[float], stamp: float) -> None:
    words = ["FLASER", len(ranges), *ranges, *poses, stamp, "host", 3.5]
    scan = parse_line(" ".join(map(str, words)).encode())
    assert isinstance(scan, ScanLine) and scan.laser_pose is not None and scan.robot_pose is not None
    np.testing.assert_array_equal(scan.ranges, np.array(ranges, np.float32))
    assert (*scan.laser_pose[:2], *scan.robot_pose[:2]) == (*poses[:2], *poses[3:5])
    assert math.remainder(scan.laser_pose[2] - poses[2], math.tau) == pytest.approx(0.0, abs=1e-6)
    assert (scan.stamp_s, scan.logger_stamp_s) == (stamp, 3.5)
    line = parse_line(" ".join(map(str, ["ODOM", *poses, stamp, "host", 3.5])).encode())
    assert isinstance(line, OdometryLine)
    assert (*line.pose[:2], line.forward, line.turn, line.stamp_s) == (*poses[:2], *poses[3:5], stamp)


def test_a_long_log_that_gets_shorter_meanwhile_is_refused(tmp_path: Path, kept_numbers: int) -> None:
    lines = [flaser(k, (0.2 * k, 0.0, 0.0)) for k in range(20)]
    path = write(tmp_path / "a.log", lines)
    with open_recording([path]) as recording:
        write(path, lines[:10])
        if kept_numbers:
            assert len(list(recording.messages(["/scan"]))) == 20
            return
        with pytest.raises(RecordingError, match="has changed while it was read"):
            list(recording.messages(["/scan"]))
