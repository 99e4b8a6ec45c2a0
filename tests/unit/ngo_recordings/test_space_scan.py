"""Point clouds and depth images become the scans that a laser scanner in their place would have."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_recordings.errors import RecordingError
from ngo_recordings.laser_scan import LidarScan
from ngo_recordings.lidar_description import describe_lidar
from ngo_recordings.recording import open_recording
from ngo_recordings.scan_stream import WheelPose, scan_stream
from ngo_recordings.space_scan import DistanceUnit, cloud_scan, depth_scan
from ngo_recordings.topics import TopicArguments, choose_topics
from tests.unit.ngo_recordings import messages as m
from tests.unit.ngo_recordings.test_scan_stream import odometry, static

BEGIN_NS = 10**12
ROOM_M = np.array((4.0, 3.0))  # half of its sides
HEIGHT_M = 0.5  # of the sensor above the floor


def in_room(azimuths: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """Where rays from the middle of a room meet walls or the floor, ``(rays, 3)``."""
    along = np.stack((np.cos(azimuths), np.sin(azimuths)), axis=-1)
    with np.errstate(divide="ignore"):
        reach = (ROOM_M / np.abs(along)).min(axis=-1)
        floor = np.where(elevations < 0.0, HEIGHT_M / np.tan(-elevations), np.inf)
    reach = np.minimum(reach, floor)
    return np.concatenate((reach[:, None] * along, (reach * np.tan(elevations))[:, None]), axis=1)


def turning(rings: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Points of a lidar with so many rings over 30 degrees, and when each is measured (s), in a tenth of a second."""
    azimuths, elevations = np.meshgrid(
        np.radians(np.arange(-180.0, 180.0, 0.2)), np.radians(np.linspace(-15.0, 15.0, rings)), indexing="ij"
    )
    times = np.repeat(np.linspace(0.0, 0.1, len(azimuths), endpoint=False), rings)
    return in_room(azimuths.ravel(), elevations.ravel()), times


def fields(points: np.ndarray, kind: str = "f4") -> dict[str, np.ndarray]:
    return {name: points[:, k].astype(kind) for k, name in enumerate("xyz")}


def off_walls(scan: LidarScan) -> np.ndarray:
    """How far the ends of the rays that saw something are off the walls (m)."""
    seen = np.isfinite(scan.ranges)
    ends = scan.ranges[seen, None] * np.stack((np.cos(scan.angles), np.sin(scan.angles)), axis=-1)[seen]
    return np.abs(np.abs(ends) - ROOM_M).min(axis=1)


@pytest.mark.parametrize(
    "layout",
    [
        {},
        {"height": 1800},
        {"height": 16, "row_step": 0},
        {"padding": 10},
        {"big": True},
        {"kind": "f8"},
        {"shuffled": True},
        {"rings": 32},
    ],
)
def test_any_layout_of_rings_is_the_scan_at_the_sensors_height(layout: dict[str, Any]) -> None:
    """Neither floor nor ceiling is in it, and most angles saw a wall."""
    points, _ = turning(layout.pop("rings", 16))
    if layout.pop("shuffled", False):
        points = np.random.default_rng(0).permutation(points)
        points[::7] = np.nan
    row_step = layout.pop("row_step", None)
    message = m.cloud(BEGIN_NS, fields(points, layout.pop("kind", "f4")), **layout)
    message.row_step = row_step if row_step is not None else message.row_step
    made = cloud_scan(message, "/points")
    assert (made.stamp_ns, made.frame_id, made.offsets_s) == (BEGIN_NS, "lidar", None)
    assert np.isfinite(made.ranges).sum() > 1300 and off_walls(made).max() < 0.02


@pytest.mark.parametrize(
    ("name", "kind", "factor", "begin_s"),
    [
        ("time", "f4", 1.0, 0.0),  # Velodyne
        ("t", "u4", 1e9, 0.0),  # Ouster
        ("timestamp", "f8", 1.0, BEGIN_NS * 1e-9),  # Hesai, RoboSense
        ("timestamp", "f8", 1e9, BEGIN_NS * 1e-9),  # Livox
        ("timestamp", "f8", 1.0, 1.7e9),  # of another clock
        ("offset_time", "u4", 1e6, 0.0),
    ],
)
def test_the_time_of_each_point_is_that_of_its_ray(name: str, kind: str, factor: float, begin_s: float) -> None:
    points, times = turning()
    cloud = m.cloud(BEGIN_NS, {**fields(points), name: ((times + begin_s) * factor).astype(kind)})
    made = cloud_scan(cloud, "/points")
    assert made.offsets_s is not None and made.sweep_s == pytest.approx(0.1, abs=1e-3)
    np.testing.assert_allclose(made.offsets_s, (made.angles + math.pi) / math.tau * 0.1, atol=2e-4)


def test_a_cloud_that_has_one_time_has_no_sweep() -> None:
    points, times = turning()
    assert cloud_scan(m.cloud(BEGIN_NS, {**fields(points), "time": np.zeros(len(times), "f4")}), "/p").offsets_s is None


def depth_image(encoding: str) -> tuple[Any, Any]:
    """A camera in the room that looks ahead with 90 degrees, and its CameraInfo."""
    width, height, focal = 160, 120, 80.0
    left = (79.5 - np.arange(width)) / focal
    up = (59.5 - np.arange(height))[:, None] / focal + np.zeros(width)
    azimuths, elevations = np.arctan(left) + np.zeros((height, 1)), np.arctan(up / np.hypot(1.0, left))
    depth = in_room(azimuths.ravel(), elevations.ravel())[:, 0].reshape(height, width, 1)
    pixels = (depth * 1000.0).round().astype("u2") if encoding != "32FC1" else depth.astype("f4")
    image = m.image(BEGIN_NS, pixels, encoding)
    image.header.frame_id = "camera_optical_frame"
    k = np.array((focal, 0.0, 79.5, 0.0, focal, 59.5, 0.0, 0.0, 1.0))
    roi = m.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    rest = ("plumb_bob", np.zeros(5), k, np.eye(3).ravel(), np.zeros(12), 0, 0, roi)
    return image, m.make("sensor_msgs/msg/CameraInfo", m.header(BEGIN_NS), height, width, *rest)


@pytest.mark.parametrize("encoding", ["16UC1", "mono16", "32FC1"])
def test_depth_is_a_scan_ahead_as_far_as_depth_is_exact(encoding: str) -> None:
    made = depth_scan(*depth_image(encoding), "/depth")
    seen = np.isfinite(made.ranges)
    assert off_walls(made).max() < 0.03 and made.range_max == 5.0
    assert np.abs(made.angles[seen]).max() == pytest.approx(math.radians(45.0), abs=0.01) and seen.sum() > 120


def test_depth_as_numbers_in_millimetres_is_taken_so() -> None:
    image, info = depth_image("32FC1")
    image.data = (1000.0 * image.data.view("f4")).view(np.uint8)
    made = depth_scan(image, info, "/depth")
    assert off_walls(made).max() < 0.03 and "in millimetres" in made.note


@pytest.mark.parametrize("sky", [65504.0, 1000.0])
def test_sky_with_a_number_is_far_away_and_changes_no_unit(sky: float) -> None:
    image, info = depth_image("32FC1")
    depth = image.data.view("f4").reshape(120, 160)
    depth[:55], depth[:, :20] = sky, sky
    made = depth_scan(image, info, "/depth")
    assert (depth == sky).mean() > 0.5 and np.isfinite(made.ranges).sum() > 100 and off_walls(made).max() < 0.03


def test_a_cloud_in_a_field_is_in_metres() -> None:
    azimuths = np.radians(np.arange(-180.0, 180.0, 0.2))
    reach = 260.0 + 160.0 * np.sin(2.0 * azimuths)
    points = np.stack((reach * np.cos(azimuths), reach * np.sin(azimuths), 0.0 * azimuths), axis=-1)
    assert np.nanmin(cloud_scan(m.cloud(BEGIN_NS, fields(points)), "/points").ranges) == pytest.approx(100.0, abs=1.0)


@pytest.mark.parametrize("change", ["full", "binned", "part", "cut", "no size", "projection"])
def test_a_camera_is_described_whatever_its_images_show_of_it(change: str) -> None:
    """Full pictures of the sensor are twice as large, a part of it lacks a border, and drivers forget half."""
    image, info = depth_image("16UC1")
    if change in ("full", "binned"):
        info.width, info.height = 320, 240
        info.k = np.array((160.0, 0.0, 159.5, 0.0, 160.0, 119.5, 0.0, 0.0, 1.0))
        info.binning_x = info.binning_y = 2 if change == "binned" else 0
    elif change == "part":
        info.width, info.height, info.k = 200, 140, info.k + (0.0, 0.0, 30.0, 0.0, 0.0, 10.0, 0.0, 0.0, 0.0)
        info.roi = m.make("sensor_msgs/msg/RegionOfInterest", 30, 10, 120, 160, False)
    elif change == "cut":  # all numbers are those of the part
        info.roi = m.make("sensor_msgs/msg/RegionOfInterest", 30, 10, 120, 160, False)
    elif change == "no size":
        info.width = info.height = 0
    else:
        info.p, info.k = np.insert(info.k, (3, 6, 9), 0.0), np.zeros(9)
    np.testing.assert_allclose(depth_scan(image, info, "/d").ranges, depth_scan(*depth_image("16UC1"), "/d").ranges)


@pytest.mark.parametrize("kind", ["i2", "f4"])
def test_clouds_in_millimetres_are_taken_so(kind: str) -> None:
    made = cloud_scan(m.cloud(BEGIN_NS, fields(1000.0 * turning()[0], kind)), "/points")
    assert np.isfinite(made.ranges).sum() > 1300 and off_walls(made).max() < 0.02 and "in millimetres" in made.note


@pytest.mark.parametrize(("usual", "once"), [(1000.0, 50.0), (1.0, 250.0)])
def test_the_unit_is_that_of_the_topic_and_not_of_each_message(usual: float, once: float) -> None:
    """A wall at a few centimetres, or a field, among clouds of a room in millimetres or metres."""
    unit, room = DistanceUnit(), turning()[0]
    clouds = [m.cloud(BEGIN_NS, fields(scale * room)) for scale in (usual, usual, once, usual, *[1000.0 / usual] * 12)]
    scans = [cloud_scan(each, "/points", unit) for each in clouds]
    assert [bool(scan.note) for scan in scans] == [usual > 1.0] * 13 + [usual == 1.0] * 3
    assert off_walls(scans[3]).max() < 0.02 and off_walls(scans[-1]).max() < 0.02


@pytest.mark.parametrize("mm_first", [True, False])
def test_a_sensor_in_millimetres_may_stand_at_a_wall(mm_first: bool) -> None:
    unit, room = DistanceUnit(), turning()[0]
    scales = [*[1000.0] * mm_first, *[50.0] * 12, 1000.0, *[50.0] * 12, 1000.0]
    notes = [cloud_scan(m.cloud(BEGIN_NS, fields(scale * room)), "/points", unit).note for scale in scales]
    assert [bool(note) for note in notes] == [mm_first] * (12 + mm_first) + [True] * 14


@pytest.mark.parametrize("frame", ["robot1/base_link", "lidar"])
def test_points_in_the_robots_own_frame_have_the_floor_at_zero(frame: str) -> None:
    on_robot = frame != "lidar"
    message = m.cloud(BEGIN_NS, fields(turning()[0] + (0.0, 0.0, HEIGHT_M * on_robot)))
    message.header.frame_id = frame
    made = cloud_scan(message, "/points")
    assert np.isfinite(made.ranges).sum() > 1300 and off_walls(made).max() < 0.02
    assert ("those at 0.1 to 0.5 m count" in made.note) == on_robot


def test_a_cloud_of_a_flat_lidar_needs_no_z() -> None:
    azimuths = np.radians(np.arange(-180.0, 180.0, 0.2))
    flat = fields(in_room(azimuths, np.zeros(len(azimuths))))
    flat.pop("z")
    made = cloud_scan(m.cloud(BEGIN_NS, flat), "/points")
    assert np.isfinite(made.ranges).sum() > 1300 and off_walls(made).max() < 0.02


def test_a_camera_without_its_description_is_named() -> None:
    image, info = depth_image("16UC1")
    with pytest.raises(RecordingError, match="no CameraInfo came on /camera/camera_info"):
        depth_scan(image, None, "/camera/depth")
    info.width = 80
    with pytest.raises(RecordingError, match="its CameraInfo is of 80 x 120"):
        depth_scan(image, info, "/depth")


def test_a_recording_of_clouds_is_a_stream_of_scans(tmp_path: Path) -> None:
    """In an optical frame, as those of cameras are, that looks to the left."""
    points, _ = turning()
    turned = np.stack((-points[:, 1], -points[:, 2], points[:, 0]), axis=-1)
    optical = static("base_link", "camera_optical_frame", 0.1, 0.0, 0.0)
    rotation = optical.transform.rotation  # the camera looks along y of the robot
    rotation.x, rotation.y, rotation.z, rotation.w = -math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)
    entries: list[m.Entry] = [("/tf_static", 1, m.transforms(optical))]
    for k in range(3):
        stamp_ns = BEGIN_NS + k * 10**8
        entries.append(("/odom", stamp_ns, odometry(stamp_ns, 0.0, 0.0, 0.0)))
        entries.append(("/points", stamp_ns, m.cloud(stamp_ns, fields(turned), "camera_optical_frame")))
        entries.append(("/points/filtered", stamp_ns, m.cloud(stamp_ns, fields(turned[::9]), "camera_optical_frame")))
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        topics = choose_topics(recording)
        assert (topics.image, str(topics.wheels)) == ("/points", "/odom")
        found = list(scan_stream(recording, topics))
        described = describe_lidar(recording, topics)
    scans = [each for each in found if isinstance(each, LidarScan)]
    assert len(scans) == 3 and sum(isinstance(each, WheelPose) for each in found) == 3
    assert off_walls(scans[0]).max() < 0.02
    assert any("others are /points/filtered (10.0 Hz)" in note for note in described.notes)
    assert described.mounting is not None and not described.mounting.upside_down
    np.testing.assert_allclose(described.mounting.base_from_scan_xyyaw, (0.1, 0.0, math.pi / 2), atol=1e-9)
    assert described.mounting.tilt_rad < 1e-6


def test_the_order_of_bytes_is_that_of_the_data_whatever_the_driver_says() -> None:
    points, _ = turning()
    for big in (False, True):
        made = m.cloud(BEGIN_NS, fields(points), padding=5, big=big)
        right = cloud_scan(made, "/points").ranges
        made.is_bigendian = not big
        np.testing.assert_array_equal(cloud_scan(made, "/points").ranges, right)


def test_depth_is_a_scan_where_it_is_asked_for(tmp_path: Path) -> None:
    image, info = depth_image("32FC1")
    entries = [("/camera/camera_info", BEGIN_NS, info), ("/camera/depth", BEGIN_NS, image)]
    with open_recording([m.write_mcap(tmp_path / "a.mcap", entries)]) as recording:
        topics = choose_topics(recording, TopicArguments(scan_topics=("/camera/depth",)))
        (made,) = scan_stream(recording, topics)
        assert isinstance(made, LidarScan) and off_walls(made).max() < 0.03
    _, early = depth_image("32FC1")
    early.k = np.full(9, np.nan)
    late = [("/camera/camera_info", BEGIN_NS - 1, early), *entries]
    with open_recording([m.write_mcap(tmp_path / "c.mcap", late)]) as recording:
        (made,) = scan_stream(recording, topics)
        assert isinstance(made, LidarScan) and np.isfinite(made.ranges).sum() > 120
    without = [m.write_mcap(tmp_path / "b.mcap", entries[1:])]
    with (
        open_recording(without) as recording,
        pytest.raises(RecordingError, match="or depth with a CameraInfo on /camera"),
    ):
        list(scan_stream(recording, choose_topics(recording, TopicArguments(scan_topics=("/camera/depth",)))))
