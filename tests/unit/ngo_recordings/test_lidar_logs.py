"""Real logs are read whole and fast. Their folder is named by NGO_LIDAR_LOGS; without it these tests are skipped."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from ngo_recordings.lidar_description import describe_lidar
from ngo_recordings.recording import open_recording
from ngo_recordings.scan_stream import LidarScan, WheelPose, scan_stream
from ngo_recordings.topics import WheelSource, choose_topics

LOGS = os.environ.get("NGO_LIDAR_LOGS")
pytestmark = pytest.mark.skipif(not LOGS, reason="NGO_LIDAR_LOGS does not name the folder of real lidar logs")


def log(name: str) -> Path:
    path = Path(str(LOGS), name)
    if not path.exists():
        pytest.skip(f"{name} is not in the folder that NGO_LIDAR_LOGS names")
    return path


@pytest.mark.parametrize(
    ("name", "scans", "rays", "wheels", "rate_hz", "path_m"),
    [("aces.bag", 7374, 180, 7375, 6.25, 300.0), ("mit-csail.clf.gz", 1988, 361, 1988, 4.76, 400.0)],
)
def test_every_scan_and_wheel_pose_is_read(
    name: str, scans: int, rays: int, wheels: int, rate_hz: float, path_m: float
) -> None:
    start_s = time.process_time()
    with open_recording([log(name)]) as recording:
        topics = choose_topics(recording)
        found = list(scan_stream(recording, topics))
        took_s = time.process_time() - start_s
        described = describe_lidar(recording, topics)
    read = [each for each in found if isinstance(each, LidarScan)]
    poses = np.array([each.pose_xyyaw for each in found if isinstance(each, WheelPose)])
    assert (len(read), len(poses)) == (scans, wheels) and {len(each.ranges) for each in read} == {rays}
    assert all(a.stamp_ns <= b.stamp_ns for a, b in zip(found[:-1], found[1:], strict=True))
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).sum() == pytest.approx(path_m, rel=0.35)
    assert topics.wheels == WheelSource("/odom") and described.rate_hz == pytest.approx(rate_hz, rel=0.05)
    assert described.mounting is not None and not described.mounting.base_from_scan_xyyaw.any()
    assert took_s < 6.0, "about 2 s, and three times that on a busy machine"


def test_the_doubtful_increment_of_aces_is_stated() -> None:
    with open_recording([log("aces.bag")]) as recording:
        angles = describe_lidar(recording, choose_topics(recording)).angles
    assert np.degrees(angles.angle_increment) == pytest.approx(180.0 / 179.0, abs=1e-5)
    assert angles.likely_increment is not None and np.degrees(angles.likely_increment) == pytest.approx(1.0, abs=1e-5)


# Of raw odometry against GMapping's poses after the best alignment, m, as computed apart from this code.
@pytest.mark.parametrize(
    ("name", "rmse_m"),
    [
        ("acapulco", 1.23),
        ("belgioioso", 1.70),
        ("edmonton", 2.48),
        ("fhw", 26.2),
        ("freiburg-101", 8.56),
        ("orebro", None),
        ("seattle", 2.71),
    ],
)
def test_raw_odometry_of_logs_that_gmapping_wrote(name: str, rmse_m: float | None) -> None:
    with open_recording([log(f"radish/{name}.log.gz")]) as recording:
        made = bool(recording.stamps_made)
        tracks: dict[str, dict[int, list[float]]] = {"/odom": {}, "/corrected_pose": {}}
        for message in recording.messages([topic for topic in tracks if topic in recording.topics]):
            value = message.value
            pose = value.pose.pose if message.topic == "/odom" else value.pose
            stamp_ns = value.header.stamp.sec * 10**9 + value.header.stamp.nanosec
            tracks[message.topic][stamp_ns] = [pose.position.x, pose.position.y]
        assert len(tracks["/corrected_pose"]) == recording.topics["/scan"].count
    assert made == (name in ("belgioioso", "orebro"))
    if rmse_m is None:
        assert not tracks["/odom"]
        return
    stamps = [stamp_ns for stamp_ns in tracks["/corrected_pose"] if stamp_ns in tracks["/odom"]]
    raw, true = (np.array([tracks[topic][stamp_ns] for stamp_ns in stamps]) for topic in tracks)
    raw, true = raw - raw.mean(axis=0), true - true.mean(axis=0)
    u, _, v = np.linalg.svd(raw.T @ true)
    turn = u @ np.diag([1.0, np.linalg.det(u @ v)]) @ v
    rmse = float(np.sqrt(((raw @ turn - true) ** 2).sum(axis=1).mean()))
    assert len(stamps) == len(tracks["/corrected_pose"]) and rmse == pytest.approx(rmse_m, abs=0.05)
