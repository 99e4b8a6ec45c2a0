"""What a simulator records is what it publishes: whole, and after a kill to its last chunk."""

import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import frames
from ngo_recordings.recording import open_recording
from ngo_recordings.topics import choose_topics
from ngo_sim.episodes import record_episode
from ngo_sim.maze2d import Maze2D
from ngo_sim.maze3d import Maze3D

from .processes import TIMEOUT_S, NodeProcess, wait_until

pytestmark = pytest.mark.processes

FRAMES = 40
SENSORS = {"maze2d": "/scan", "maze3d": "/camera_info"}
DRIVERS = {"maze2d": "corners", "maze3d": "random_goals"}


def counts(world: str) -> dict[str, int]:
    topics = {"/image", "/ground_truth", "/clock", SENSORS[world]}
    latched = {"/tf_static": 1} if world == "maze3d" else {}
    return {"/action": FRAMES - 1, **latched, **dict.fromkeys(topics, FRAMES)}


def written(path: Path, topic: str) -> int:
    """How many messages of a topic a recording under way has by now."""
    try:
        with open_recording([path]) as recording:
            return recording.topics[topic].count if topic in recording.topics else 0
    except RecordingError:  # there is no file yet, or not its first byte
        return 0


def record(world: str, path: Path, **parameters: Any) -> None:
    given = {"seed": 1007, "frames": FRAMES, "rate": 0, "publish_clock": True, "record": str(path), **parameters}
    with NodeProcess("ngo_sim", world, given) as node:
        assert node.wait() == 0, node.log


@pytest.mark.parametrize(("world", "name"), [("maze2d", "drive.mcap"), ("maze3d", "drive")])
def test_a_recording_holds_what_the_core_records(tmp_path: Path, world: str, name: str) -> None:
    path = tmp_path / name
    record(world, path)
    make = {"maze2d": Maze2D, "maze3d": Maze3D}[world]
    episode = record_episode(make(), DRIVERS[world], FRAMES, 1007)
    with open_recording([path]) as recording:
        assert {topic: info.count for topic, info in recording.topics.items()} == counts(world)
        assert {info.first_ns for info in recording.topics.values()} == {10**9}, "log times are those of the frames"
        read = list(frames(recording, choose_topics(recording)))
    images = np.stack([frame.image for frame in read])
    np.testing.assert_array_equal(images.reshape(episode.observations.shape), episode.observations)
    assert [frame.action for frame in read] == [None, *episode.actions[: FRAMES - 1].tolist()]
    poses = np.stack([frame.pose_xyyaw for frame in read if frame.pose_xyyaw is not None])
    turned = poses[:, 2] - episode.poses_xyyaw[:, 2]
    np.testing.assert_allclose(poses[:, :2], episode.poses_xyyaw[:, :2], atol=1e-12)
    np.testing.assert_allclose(np.cos(turned), 1.0, atol=1e-12)


def test_a_killed_recording_is_readable_to_its_last_chunk(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with NodeProcess("ngo_sim", "maze2d", {"rate": 300.0, "record": str(path)}) as node:

        def has_images() -> bool:
            assert node.running, node.log
            return written(path, "/image") > 100

        wait_until(has_images, "the first second on the file", poll_s=0.2)
        node.send(signal.SIGKILL)
        node.wait()
    with open_recording([path]) as recording:
        assert recording.unfinished == (path,)
        read = list(frames(recording, choose_topics(recording)))
    assert len(read) > 100
    assert [frame.stamp_ns for frame in read] == [10**9 + k * 10**8 for k in range(len(read))]
    assert all(frame.action is not None and frame.pose_xyyaw is not None for frame in read[1:])


def test_a_recording_that_is_interrupted_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "drive"
    with NodeProcess("ngo_sim", "maze2d", {"rate": 200.0, "record": str(path)}) as node:
        wait_until(lambda: (path / "drive_0.mcap").exists() or not node.running, "the file")
        node.send(signal.SIGINT)
        assert node.wait() == 0, node.log
    with open_recording([path]) as recording:
        assert recording.unfinished == ()


def test_what_is_there_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    path.write_text("precious")
    with NodeProcess("ngo_sim", "maze2d", {"record": str(path)}) as node:
        assert node.wait() == 2
        (line,) = node.lines
    assert "parameter 'record' is" in line and "which exists; allowed: a new .mcap file or a new folder" in line
    assert path.read_text() == "precious"


def test_the_recorder_script_gets_the_same_bytes_over_dds(tmp_path: Path) -> None:
    own, heard = tmp_path / "own.mcap", tmp_path / "heard"
    command = [sys.executable, "-m", "training.record", "--out", str(heard), "--topics", "image", "/ground_truth"]
    log = (tmp_path / "log").open("w+")
    with subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT) as recorder:
        try:
            parameters = {"frames": FRAMES, "rate": 100.0, "wait_for_subscribers": 1, "record": str(own)}
            with NodeProcess("ngo_sim", "maze2d", parameters) as node:
                assert node.wait() == 0, node.log
            wait_until(lambda: written(heard, "/image") == FRAMES, "the recorder to write all images", poll_s=0.1)
            recorder.send_signal(signal.SIGINT)
            assert recorder.wait(TIMEOUT_S) == 0, (tmp_path / "log").read_text()
        finally:
            recorder.kill()
    text = (tmp_path / "log").read_text()
    assert "recording /image (sensor_msgs/msg/Image)" in text and f"{FRAMES:8d} messages of /image" in text
    images = []
    for path in (own, heard):
        with AnyReader([path]) as bag:
            chosen = [connection for connection in bag.connections if connection.topic == "/image"]
            images.append([bytes(data) for _, _, data in bag.messages(chosen)])
    assert images[0] == images[1] and len(images[0]) == FRAMES


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Files of this process's children end at so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_ends_the_node_with_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    parameters = {"rate": 0.0, "record": str(path)}
    with full_disk(2**20 + 2**19), NodeProcess("ngo_sim", "maze2d", parameters, fresh=True) as node:
        assert node.wait() == 1, node.log
        assert "Traceback" not in node.log, node.log
        assert f"parameter 'record': {path} cannot be written any further: File too large" in node.lines[-1]
    with open_recording([path]) as recording:
        assert recording.topics["/image"].count > 10
