"""How fast recordings are written and read, beside the rosbags library's own writer and reader in the same run.

    python benchmarks/recordings.py
    python benchmarks/recordings.py --frames 20000 --folder /tmp

A frame is what the simulator maze3d publishes for one: an rgb8 image of 80 x 60, camera info, true odometry and the
action, serialised before the clock starts. Both writers compress with zstd. "messages" decodes every message, "frames"
also finds what belongs to each image. Each line is a process of its own; the peak is how much its resident memory grew.
"cpu" divides by processor time, which other processes disturb less, and is what counts. Exit code 1 where writing or
reading is below 1,000 frames/s.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

BAR_FRAMES_PER_S = 1_000
PERIOD_NS = 57_142_857


# Seconds by the clock and of processor time, and bytes of the messages.
Result = tuple[float, float, int]


class Begin:
    """A moment from which on time is measured."""

    def __init__(self) -> None:
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def elapsed(self) -> tuple[float, float]:
        """Seconds since then, by the clock and of processor time."""
        return time.perf_counter() - self._wall_s, time.process_time() - self._cpu_s


@dataclass(frozen=True)
class Arguments:
    """What to measure, and where the files go."""

    frames: int = 6000
    folder: Path | None = None


@dataclass(frozen=True)
class Measurement:
    """Of one way to write or read. megabytes: of serialised messages, before compression."""

    name: str
    frames: int
    wall_s: float
    cpu_s: float
    megabytes: float
    peak_mb: float
    file_mb: float

    @property
    def frames_per_s(self) -> float:
        """By processor time."""
        return self.frames / self.cpu_s


def typestore() -> Any:
    """The rosbags library's types of ROS 2 Jazzy, and ours."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    from ngo_recordings.definitions import message_definition
    from ngo_recordings.topics import ACTION_TYPE

    store = get_typestore(Stores.ROS2_JAZZY)
    types = get_types_from_msg(message_definition(ACTION_TYPE), ACTION_TYPE)
    store.register({name: fields for name, fields in types.items() if name not in store.types})
    return store


def serialised_frames(count: int) -> Iterator[list[tuple[str, str, int, bytes]]]:
    """Topic, type, time and bytes of the messages of each frame."""
    from ngo_recordings.topics import ACTION_TYPE
    from ngo_sim.episodes import record_episode
    from ngo_sim.maze3d import Maze3D

    store = typestore()
    make = store.types
    world = Maze3D()
    episode = record_episode(world, "random_goals", 301, 1000)
    world.close()

    def header(stamp_ns: int) -> Any:
        stamp = make["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
        return make["std_msgs/msg/Header"](stamp, "base_link")

    region = make["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    for index in range(count):
        stamp_ns = 10**9 + index * PERIOD_NS
        picture = episode.observations[index % 300]
        x, y, yaw = episode.poses_xyyaw[index % 300].tolist()
        height, width, _ = picture.shape
        image = make["sensor_msgs/msg/Image"](
            header(stamp_ns), height, width, "rgb8", 0, width * 3, picture.reshape(-1)
        )
        camera = make["sensor_msgs/msg/CameraInfo"](
            header(stamp_ns), height, width, "plumb_bob", np.zeros(5), np.eye(3).ravel(), np.eye(3).ravel(),
            np.zeros(12), 0, 0, region,
        )  # fmt: skip
        pose = make["geometry_msgs/msg/Pose"](
            make["geometry_msgs/msg/Point"](x, y, 0.0),
            make["geometry_msgs/msg/Quaternion"](0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)),
        )
        zero = make["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        odometry = make["nav_msgs/msg/Odometry"](
            header(stamp_ns),
            "base_link",
            make["geometry_msgs/msg/PoseWithCovariance"](pose, np.zeros(36)),
            make["geometry_msgs/msg/TwistWithCovariance"](make["geometry_msgs/msg/Twist"](zero, zero), np.zeros(36)),
        )
        action = make[ACTION_TYPE](header=header(stamp_ns), action=int(episode.actions[index % 300]))
        messages = {"/ground_truth": odometry, "/camera_info": camera, "/image": image, "/action": action}
        yield [
            (topic, each.__msgtype__, stamp_ns, bytes(store.serialize_cdr(each, each.__msgtype__)))
            for topic, each in messages.items()
        ]


def write_ours(path: Path, count: int) -> Result:
    """With our writer."""
    from ngo_recordings.writer import RecordingWriter

    # The same messages over and over: what is measured is the writer, not the making of messages.
    batch = list(serialised_frames(300))
    topics = {topic: kind for topic, kind, _, _ in batch[0]}
    size, begin = 0, Begin()
    with RecordingWriter(path) as writer:
        for topic, kind in topics.items():
            writer.add_topic(topic, kind)
        for index in range(count):
            shift_ns = index // 300 * 300 * PERIOD_NS
            for topic, _, stamp_ns, data in batch[index % 300]:
                writer.write(topic, data, stamp_ns + shift_ns)
                size += len(data)
    return *begin.elapsed(), size


def write_rosbags(path: Path, count: int) -> Result:
    """With that of rosbags."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

    batch, store = list(serialised_frames(300)), typestore()
    size, begin = 0, Begin()
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {topic: writer.add_connection(topic, kind, typestore=store) for topic, kind, _, _ in batch[0]}
        for index in range(count):
            shift_ns = index // 300 * 300 * PERIOD_NS
            for topic, _, stamp_ns, data in batch[index % 300]:
                writer.write(connections[topic], stamp_ns + shift_ns, data)
                size += len(data)
    return *begin.elapsed(), size


def read_messages(path: Path, count: int) -> Result:
    """Every message with our reader."""
    from ngo_recordings.recording import open_recording

    begin = Begin()
    with open_recording([path]) as recording:
        images = sum(message.topic == "/image" for message in recording.messages())
    assert images == count, f"{images} images were read; {count} were written"
    return *begin.elapsed(), 0


def read_frames(path: Path, count: int) -> Result:
    """Frames with our reader."""
    from ngo_recordings.frames import frames
    from ngo_recordings.recording import open_recording
    from ngo_recordings.topics import choose_topics

    begin = Begin()
    with open_recording([path]) as recording:
        found = sum(frame.pose_xyyaw is not None for frame in frames(recording, choose_topics(recording)))
    assert found == count, f"{found} frames were read; {count} were written"
    return *begin.elapsed(), 0


def read_rosbags(path: Path, count: int) -> Result:
    """Every message with the reader of rosbags."""
    from rosbags.highlevel import AnyReader

    begin, images = Begin(), 0
    with AnyReader([path]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
            images += connection.topic == "/image"
    assert images == count, f"{images} images were read; {count} were written"
    return *begin.elapsed(), 0


def measured(function: Callable[[Path, int], Result], path: Path, count: int) -> tuple[Result, float]:
    """Run in this process, a writer with few frames before: its result, and how much the memory grew at most, MB."""
    if function in (write_ours, write_rosbags):
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            function(Path(folder, "warm.mcap" if function is write_ours else "warm"), 10)
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result = function(path, count)
    return result, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb) / 1024


def main(args: Arguments) -> int:
    """Measure, print the table and, last, everything as one line of JSON; return the exit code."""
    results: list[Measurement] = []
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        ours, theirs = Path(folder, "ours.mcap"), Path(folder, "theirs")
        plan: list[tuple[str, Callable[[Path, int], Result], Path]] = [
            ("write", write_ours, ours),
            ("write, rosbags", write_rosbags, theirs),
            ("read messages", read_messages, ours),
            ("read frames", read_frames, ours),
            ("read messages, rosbags", read_rosbags, ours),
        ]
        megabytes = 0.0
        for name, function, path in tqdm(plan, unit="task"):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                (wall_s, cpu_s, size), peak_mb = process.submit(measured, function, path, args.frames).result()
            megabytes = size / 1e6 or megabytes
            files = path.rglob("*.mcap") if path.is_dir() else [path]
            file_mb = sum(file.stat().st_size for file in files) / 1e6
            results.append(Measurement(name, args.frames, wall_s, cpu_s, megabytes, peak_mb, file_mb))
    print(f"{'':24}{'cpu frames/s':>14}{'wall frames/s':>15}{'cpu MB/s':>10}{'file MB':>9}{'peak MB':>9}")
    for each in results:
        print(
            f"{each.name:24}{each.frames_per_s:14,.0f}{each.frames / each.wall_s:15,.0f}"
            f"{each.megabytes / each.cpu_s:10.0f}{each.file_mb:9.1f}{each.peak_mb:9.1f}"
        )
    print(json.dumps({each.name: {**asdict(each), "frames_per_s": each.frames_per_s} for each in results}))
    ours_only = [each for each in results if "rosbags" not in each.name]
    return 0 if all(each.frames_per_s >= BAR_FRAMES_PER_S for each in ours_only) else 1


def parse(argv: list[str] | None = None) -> Arguments:
    """The arguments of a command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=Arguments.frames, help="in the recording")
    parser.add_argument("--folder", type=Path, help="for the files, which are removed at the end")
    given = parser.parse_args(argv)
    if given.frames < 1:
        parser.error(f"frames is {given.frames}; it must be at least 1")
    return Arguments(given.frames, given.folder)


if __name__ == "__main__":
    sys.exit(main(parse()))
