"""Frames: what belongs to an image is found by stamps, in whatever order it was recorded, and nothing is made up."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import NO_DEPTH, UNUSABLE, Frame, frames
from ngo_recordings.recording import open_recording
from ngo_recordings.topics import GroundTruth, RecordingTopics, TopicArguments, choose_topics

from . import messages as m

S = 10**9
PERIOD = S // 10
TOPICS = RecordingTopics("/image", action="/action", ground_truth=GroundTruth(topic="/ground_truth"))


def pixels(k: int) -> np.ndarray:
    return np.full((2, 8, 3), k % 256, np.uint8)


def stamp(k: float) -> int:
    return 5 * S + round(k * PERIOD)


def drive(count: int = 30) -> list[m.Entry]:
    """A robot on a circle: an image every 0.1 s, at each the action k % 3 and the truth of x = k."""
    entries: list[m.Entry] = []
    for k in range(count):
        at = m.pose(float(k), 2.0 * k, 0.1 * k, z=0.5, roll=0.02, pitch=-0.01)
        entries.append(("/ground_truth", stamp(k), m.odometry(stamp(k), at, m.twist(float(k), 0.0, 0.1))))
        entries.append(("/image", stamp(k), m.image(stamp(k), pixels(k))))
        entries.append(("/action", stamp(k), m.action(stamp(k), k % 3)))
    return entries


def read(path: Path, topics: RecordingTopics = TOPICS, skipped: Counter[str] | None = None) -> list[Frame]:
    with open_recording([path]) as recording:
        return list(frames(recording, topics, skipped))


def check_drive(found: Sequence[Frame], count: int = 30) -> None:
    """Every frame has all that belongs to it."""
    assert [frame.stamp_ns for frame in found] == [stamp(k) for k in range(count)]
    for k, frame in enumerate(found):
        np.testing.assert_array_equal(frame.image, pixels(k))
        assert frame.action == (None if k == 0 else (k - 1) % 3)
        assert frame.pose_xyyaw is not None and frame.pose_residual is not None
        yaw = math.remainder(0.1 * k, math.tau)
        np.testing.assert_allclose(frame.pose_xyyaw, [k, 2 * k, yaw], atol=1e-9)
        np.testing.assert_allclose(frame.pose_residual, [0.5, 0.02, -0.01], atol=1e-9)


def test_a_frame_has_the_action_that_led_to_it_and_its_true_pose(tmp_path: Path) -> None:
    check_drive(read(m.write_mcap(tmp_path / "a.mcap", drive())))
    check_drive(read(m.write_rosbag(tmp_path / "b", drive())))


@settings(deadline=None, max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(delays=st.fixed_dictionaries({topic: st.integers(0, S) for topic in ("/image", "/action", "/ground_truth")}))
def test_it_does_not_matter_how_late_a_topic_was_recorded(tmp_path: Path, delays: dict[str, int]) -> None:
    entries = [(topic, time_ns + delays[topic], message) for topic, time_ns, message in drive(25)]
    check_drive(read(m.write_mcap(tmp_path / "drive.mcap", entries)), 25)


def test_truth_is_interpolated_over_small_gaps_alone(tmp_path: Path) -> None:
    entries = [entry for entry in drive() if entry[0] != "/ground_truth"]
    for k in (0.5, 2.5, 5.5, 6.5):
        entries.append(("/ground_truth", stamp(k), m.pose_stamped(stamp(k), k, 2.0 * k, 0.1 * k)))
    entries.sort(key=lambda entry: entry[1])
    found = read(m.write_mcap(tmp_path / "a.mcap", entries))
    with_pose = {k: frame.pose_xyyaw for k, frame in enumerate(found) if frame.pose_xyyaw is not None}
    assert sorted(with_pose) == [1, 2, 6], "0.2 s are bridged, 0.3 s are not, and nothing beyond the ends"
    np.testing.assert_allclose(with_pose[1], [1.0, 2.0, 0.1], atol=1e-9)


def test_an_action_belongs_to_the_nearest_frame_within_the_tolerance(tmp_path: Path) -> None:
    entries = [entry for entry in drive(8) if entry[0] != "/action"]
    offsets = {0: 0.02, 1: -0.03, 3: 0.07, 4: 0.0}  # s; of 3 it is nearer to frame 4, whose own is nearer still
    for k, offset_s in offsets.items():
        time_ns = stamp(k) + round(offset_s * S)
        entries.append(("/action", time_ns, m.action(time_ns, k % 3)))
    entries.sort(key=lambda entry: entry[1])
    found = read(m.write_mcap(tmp_path / "a.mcap", entries))
    assert [frame.action for frame in found] == [None, 0, 1, None, None, 1, None, None]


def test_velocity_is_the_mean_of_a_step_or_a_little_older(tmp_path: Path) -> None:
    entries = [entry for entry in drive(9) if entry[0] == "/image"]
    speeds = [(0.2, 1.0), (0.7, 3.0), (1.0, 5.0), (1.5, -1.0), (8.0, 7.0)]
    for when, speed in speeds:  # Twist has no header: when it was logged counts
        entries.append(("/cmd_vel", stamp(when), m.twist(speed, 0.1, 0.2)))
    entries.sort(key=lambda entry: entry[1])
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    found = read(path, RecordingTopics("/image", twist="/cmd_vel", twist_tolerance_s=0.5))
    forward = [None if frame.twist_xyyaw is None else float(frame.twist_xyyaw[0]) for frame in found]
    assert forward == [None, 3.0, -1.0, -1.0, -1.0, -1.0, -1.0, None, 7.0]
    assert found[1].twist_xyyaw is not None
    np.testing.assert_allclose(found[1].twist_xyyaw, [3.0, 0.1, 0.2])


def test_velocity_of_an_odometry_is_its_twist(tmp_path: Path) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", drive())
    found = read(path, RecordingTopics("/image", twist="/ground_truth"))
    assert found[0].twist_xyyaw is None
    np.testing.assert_allclose([frame.twist_xyyaw for frame in found[1:]], [[k, 0.0, 0.1] for k in range(1, 30)])


@pytest.mark.parametrize("latched_first", [True, False])
def test_truth_from_transforms_goes_through_the_tree(tmp_path: Path, latched_first: bool) -> None:
    entries = [entry for entry in drive() if entry[0] != "/ground_truth"]
    static = (
        m.transform(0, "base_link", "camera", m.pose(0.0, 0.5, 0.0)),
        m.transform(0, "world", "map", m.pose(100.0, 0.0, 0.0)),
    )
    latched = ("/tf_static", stamp(-1 if latched_first else 3), m.transforms(*static))
    for k in range(-1, 31):
        when = stamp(k + 0.5)
        entries.append(("/tf", when, m.transforms(m.transform(when, "/odom", "/base_link", m.pose(k + 0.5, 0.0, 0.0)))))
        entries.append(
            ("/tf", when + 1, m.transforms(m.transform(when, "map", "odom", m.pose(0.0, 10.0, math.pi / 2))))
        )
    entries = sorted([latched, *entries], key=lambda entry: entry[1])
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    topics = RecordingTopics("/image", action="/action", ground_truth=GroundTruth(tf=("world", "camera")))
    found = read(path, topics)
    for k, frame in enumerate(found):
        assert frame.pose_xyyaw is not None
        np.testing.assert_allclose(frame.pose_xyyaw, [99.5, 10.0 + k, math.pi / 2], atol=1e-9)


def test_transforms_that_are_not_of_the_chain_may_be_late(tmp_path: Path) -> None:
    """A detection that took 3 s, or a driver that leaves its stamps at 0, is no restart of the robot."""
    entries: list[m.Entry] = []
    for k in range(30):
        at = m.transform(stamp(k), "map", "base_link", m.pose(float(k), 0.0, 0.0))
        tag = m.transform(stamp(k) - 3 * S if k % 2 else 0, "camera", "tag", m.pose(1.0, 0.0, 0.0))
        entries.append(("/image", stamp(k), m.image(stamp(k), pixels(k))))
        entries.append(("/tf", stamp(k + 0.5), m.transforms(at, tag)))
    topics = RecordingTopics("/image", ground_truth=GroundTruth(tf=("map", "base_link")))
    found = read(m.write_mcap(tmp_path / "a.mcap", entries), topics)
    assert [None if f.pose_xyyaw is None else f.pose_xyyaw[0] for f in found] == list(range(30))


def test_truth_from_a_file_counts_by_the_same_rules(tmp_path: Path) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", drive(6))
    truth = tmp_path / "truth.tum"
    truth.write_text("".join(f"{stamp(k) / S:.9f} {k} 0 0 0 0 0 1\n" for k in (0.5, 1.5, 2.5)))
    found = read(path, RecordingTopics("/image", ground_truth=GroundTruth(tum=truth)))
    known = [None if frame.pose_xyyaw is None else round(float(frame.pose_xyyaw[0]), 6) for frame in found]
    assert known == [None, 1.0, 2.0, None, None, None]


def test_a_source_that_restarts_begins_anew(tmp_path: Path) -> None:
    """Stamps jump back; frames go on, no step leads over the jump, and nothing of before is mixed in."""
    shifted = [(topic, time_ns + 100 * S, value) for topic, time_ns, value in drive(30)]
    found = read(m.write_mcap(tmp_path / "a.mcap", [*drive(30), *shifted]))
    assert len(found) == 60
    check_drive(found[:30])
    check_drive(found[30:])


def test_a_late_or_repeated_image_takes_no_step(tmp_path: Path) -> None:
    order = [0, 1, 3, 2, 3, 4]
    entries: list[m.Entry] = []
    for log, k in enumerate(order):
        entries.append(("/image", stamp(log), m.image(stamp(k), pixels(k))))
        entries.append(("/action", stamp(log) + 1, m.action(stamp(k), k % 3)))
    found = read(m.write_mcap(tmp_path / "a.mcap", entries), RecordingTopics("/image", action="/action"))
    assert [frame.stamp_ns for frame in found] == [stamp(k) for k in order]
    assert [frame.action for frame in found] == [None, 0, 1, None, None, 0]


def test_depth_becomes_a_channel_and_images_without_it_are_left_out_and_counted(tmp_path: Path) -> None:
    entries: list[m.Entry] = []
    for k in range(10):
        entries.append(("/image", stamp(k), m.image(stamp(k), pixels(k))))
        if k != 4:
            depth = np.full((2, 8, 1), k, np.float32)
            entries.append(("/depth", stamp(k) + S // 50, m.image(stamp(k) + S // 100, depth, "32FC1")))
        entries.append(("/action", stamp(k) + S // 40, m.action(stamp(k), 1)))
    skipped: Counter[str] = Counter()
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    found = read(path, RecordingTopics("/image", depth="/depth", action="/action"), skipped)
    assert [frame.stamp_ns for frame in found] == [stamp(k) for k in range(10) if k != 4]
    assert skipped == {NO_DEPTH: 1}
    assert found[3].image.shape == (2, 8, 4) and found[3].image[0, 0, 3] == 3.0
    assert [frame.action for frame in found] == [None, *[1] * 8]


@pytest.mark.parametrize("unit", [0.0, 1e-3])
def test_where_no_topic_has_stamps_of_a_clock_the_times_of_the_recording_count(tmp_path: Path, unit: float) -> None:
    depth = np.ones((2, 8, 1), np.float32)
    entries = [*drive(), *(("/depth", stamp(k), m.image(0, depth, "32FC1")) for k in range(30))]
    velocity = m.make("geometry_msgs/msg/TwistStamped", m.header(0), m.twist(0.5, 0.0, 0.0))
    entries += [("/velocity", stamp(k), replace(velocity, header=m.header(0))) for k in range(30)]
    for _, time_ns, message in entries:
        message.header = m.header(round(unit * time_ns))
    given = TopicArguments(depth="/depth", twist="/velocity")
    path = m.write_mcap(tmp_path / "a.mcap", sorted(entries, key=lambda entry: entry[1]))
    with open_recording([path]) as recording:
        topics = choose_topics(recording, given)
        assert len(recording.notes) == 5
        found = list(frames(recording, topics))
    assert [frame.stamp_ns for frame in found] == [stamp(k) for k in range(30)]
    for k, frame in enumerate(found):
        assert frame.action == (None if k == 0 else (k - 1) % 3) and (frame.twist_xyyaw is None) == (k == 0)
        assert frame.pose_xyyaw is not None and frame.pose_xyyaw[0] == pytest.approx(k)


def test_scans_keep_their_geometry_and_may_change_their_number_of_rays(tmp_path: Path) -> None:
    entries = [("/scan", stamp(k), m.scan(stamp(k), np.full(8 + k % 2, 1.5))) for k in range(4)]
    found = read(m.write_mcap(tmp_path / "a.mcap", entries), RecordingTopics("/scan"))
    assert [frame.image.shape for frame in found] == [(1, 8, 1), (1, 9, 1)] * 2
    assert found[0].scan is not None and found[0].scan.angle_min_rad == -1.0


def test_side_information_that_never_comes_is_not_waited_for(tmp_path: Path) -> None:
    """The first frames do not wait for the end of the recording."""
    entries: list[m.Entry] = [("/action", 1, m.action(1, 0))]
    entries += [("/image", stamp(k), m.image(stamp(k), pixels(k))) for k in range(200)]
    entries.append(("/action", stamp(200), m.action(stamp(200), 2)))
    path = m.write_mcap(tmp_path / "a.mcap", entries, chunk_bytes=500)
    with open_recording([path]) as recording:
        taken: list[str] = []
        original = recording.messages

        def counted(names: Any) -> Any:
            for message in original(names):
                taken.append(message.topic)
                yield message

        recording.messages = counted  # type: ignore[method-assign]
        stream = frames(recording, RecordingTopics("/image", action="/action"))
        for k in range(50):
            assert next(stream).stamp_ns == stamp(k)
        assert len(taken) <= 50 + 25, "2 s of the recording are 20 images"


def test_images_of_several_sizes_are_refused(tmp_path: Path) -> None:
    entries = drive(5)
    entries.append(("/image", stamp(5), m.image(stamp(5), np.zeros((4, 8, 3), np.uint8))))
    with pytest.raises(RecordingError, match=r"/image at 5.500000000 s is \(4, 8, 3\) after images of \(2, 8, 3\)"):
        read(m.write_mcap(tmp_path / "a.mcap", entries))


def test_damaged_images_are_counted_where_that_is_asked_for(tmp_path: Path) -> None:
    entries = drive(12)
    for number in (10, 16):  # images of frames 3 and 5
        assert entries[number][0] == "/image"
        entries[number][2].data = entries[number][2].data[:-1]
    path = m.write_mcap(tmp_path / "a.mcap", entries)
    skipped: Counter[str] = Counter()
    found = read(path, TOPICS, skipped)
    assert skipped == {UNUSABLE: 2}
    assert [frame.stamp_ns for frame in found] == [stamp(k) for k in range(12) if k not in (3, 5)]
    assert [frame.action for frame in found[:5]] == [None, 0, 1, 2, 1], "as if they had never been recorded"
    with pytest.raises(RecordingError, match="an image of /image has 47 bytes"):
        read(path)
    entries[1][2].data = entries[1][2].data[:-1]
    with pytest.raises(RecordingError, match="an image of /image has 47 bytes"):
        read(m.write_mcap(tmp_path / "b.mcap", entries), TOPICS, Counter())


def test_lost_targets_of_a_tracker_are_no_truth(tmp_path: Path) -> None:
    entries = drive(12)
    for entry in entries[9:24:3]:
        assert entry[0] == "/ground_truth"
        entry[2].pose.pose.position.x = math.nan
    found = read(m.write_mcap(tmp_path / "a.mcap", entries))
    assert [frame.pose_xyyaw is None for frame in found] == [3 <= k < 8 for k in range(12)]


@pytest.fixture
def rich(tmp_path: Path) -> Path:
    """A robot with many topics."""
    depth = np.ones((2, 8, 1), np.float32)
    at, speed = m.pose(0.0, 0.0, 0.0), m.twist(0.0, 0.0, 0.0)
    return m.write_mcap(
        tmp_path / "rich.mcap",
        [
            ("/camera/image_raw", 1, m.image(1, pixels(1))),
            ("/camera/depth", 1, m.image(1, depth, "32FC1")),
            ("/camera/image_raw/compressed", 1, m.compressed(1, pixels(1), "jpeg")),
            ("/scan", 1, m.scan(1, np.ones(9))),
            ("/odom", 1, m.odometry(1, at, speed)),
            ("/cmd_vel", 1, speed),
            ("/vicon/robot/pose", 1, m.pose_stamped(1, 0.0, 0.0, 0.0)),
            ("/tf", 1, m.transforms(m.transform(1, "map", "base_link", at))),
        ],
    )


def test_what_is_clear_is_chosen_and_nothing_is_guessed(rich: Path) -> None:
    with open_recording([rich]) as recording:
        assert choose_topics(recording) == RecordingTopics(
            "/camera/image_raw", twist="/cmd_vel", ground_truth=GroundTruth(topic="/vicon/robot/pose")
        )
        given = TopicArguments("scan", None, None, "/odom", "tf:map:/base_link", 0.01, 0.5, 1.0)
        truth = GroundTruth(tf=("map", "base_link"))
        assert choose_topics(recording, given) == RecordingTopics("/scan", None, None, "/odom", truth, 0.01, 0.5, 1.0)
        nothing = TopicArguments(twist="none", ground_truth="none", depth="/camera/depth")
        assert choose_topics(recording, nothing) == RecordingTopics("/camera/image_raw", depth="/camera/depth")


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        (
            {"image": "/camera"},
            r"no topic /camera for the image; of a type that fits: /camera/depth, /camera/image_raw",
        ),
        ({"image": "/odom"}, r"topic /odom for the image is nav_msgs/msg/Odometry; expected sensor_msgs/msg/Image or"),
        ({"action": "/cmd_vel"}, r"topic /cmd_vel for the action is geometry_msgs/msg/Twist; expected ngo_msgs"),
        ({"ground_truth": "/scan"}, r"topic /scan for the ground truth is .*: /odom, /vicon/robot/pose"),
        ({"ground_truth": "tf:map"}, r"expected tf:PARENT:CHILD"),
        ({"ground_truth": "gone.tum"}, r"no file gone.tum"),
    ],
)
def test_topics_that_do_not_fit_are_named_with_those_that_do(rich: Path, given: dict[str, str], complaint: str) -> None:
    with open_recording([rich]) as recording, pytest.raises(RecordingError, match=complaint):
        choose_topics(recording, TopicArguments(**given))  # type: ignore[arg-type]


def test_two_cameras_are_a_question(tmp_path: Path) -> None:
    entries = [(f"/{side}/image", 1, m.image(1, pixels(1))) for side in ("left", "right")]
    with (
        open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording,
        pytest.raises(RecordingError, match=r"several topics may be the image \(/left/image, /right/image\)"),
    ):
        choose_topics(recording)


def test_a_recording_without_images_says_what_it_has(tmp_path: Path) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", [("/odom", 1, m.pose_stamped(1, 0.0, 0.0, 0.0))])
    with open_recording([path]) as recording, pytest.raises(RecordingError, match=r"no topic is an image: .*/odom"):
        choose_topics(recording)


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
def test_tolerances_are_times(value: float) -> None:
    with pytest.raises(RecordingError, match="a tolerance is"):
        TopicArguments(tolerance_s=value)
    with pytest.raises(RecordingError, match="exactly one of"):
        GroundTruth(topic="/odom", tf=("a", "b"))
