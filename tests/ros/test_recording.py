"""A recording of a real simulator is read by the mcap and by the rosbags library."""

import contextlib
import os
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from demo.recording import ALL_TOPICS, StampTimes
from ngo_recordings.definitions import message_definition
from ngo_sim.episodes import record_episode
from ngo_sim.maze2d import Maze2D
from training.recordings.recorder import Recorder

from .processes import NodeProcess, wait_until

pytestmark = pytest.mark.processes

FRAMES = 40
COUNTS = {"/image": FRAMES, "/scan": FRAMES, "/ground_truth": FRAMES, "/action": FRAMES - 1}


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "recording.mcap"
    times = StampTimes()
    parameters = {"seed": 7, "frames": FRAMES, "rate": 0, "wait_for_subscribers": 1}
    with Recorder(path, int(os.environ["ROS_DOMAIN_ID"]), ALL_TOPICS, chunk_bytes=20_000) as recorder:
        recorder.listen("image", times)
        with NodeProcess("ngo_sim", "maze2d", parameters) as node:

            def all_there() -> bool:
                recorder.spin_once()
                return not node.running and all(recorder.counts[name[1:]] == n for name, n in COUNTS.items())

            wait_until(all_there, "all messages", poll_s=0.0)
            assert node.wait() == 0, node.log
    assert len(times.received_ns) == FRAMES and times.newest_ns == 10**9 + (FRAMES - 1) * 10**8
    assert all(0 < times.received_ns[stamp] - published < 10**10 for stamp, published in times.published_ns.items())
    return path


def test_mcap_reads_every_message(recording: Path) -> None:
    counts: Counter[str] = Counter()
    images = []
    with recording.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            counts[channel.topic] += 1
            assert (schema.encoding, channel.message_encoding) == ("ros2msg", "cdr")
            assert 0 < message.publish_time <= message.log_time
            if channel.topic == "/image":
                images.append(np.frombuffer(decoded.data, np.float32).reshape(241, 4))
    assert {topic: counts[topic] for topic in COUNTS} == COUNTS
    episode = record_episode(Maze2D(), "corners", FRAMES, 7)
    np.testing.assert_array_equal(images, episode.observations)


def test_rosbags_reads_every_message(recording: Path) -> None:
    typestore = get_typestore(Stores.EMPTY)
    for name in ALL_TOPICS.values():
        text = message_definition(name)
        typestore.register({k: v for k, v in get_types_from_msg(text, name).items() if k not in typestore.types})
    counts: Counter[str] = Counter()
    last = None
    with recording.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            decoded = typestore.deserialize_cdr(message.data, schema.name)
            counts[channel.topic] += 1
            if channel.topic == "/ground_truth":
                last = decoded
    assert {topic: counts[topic] for topic in COUNTS} == COUNTS
    assert last is not None and last.child_frame_id == "base_link"


def test_a_file_without_its_end_is_read_to_its_last_chunk(recording: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    shutil.copy(recording, cut)
    with recording.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) > 4
    half = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    os.truncate(cut, half.chunk_start_offset + half.chunk_length // 2)
    messages = 0
    with cut.open("rb") as stream, contextlib.suppress(McapError):
        for record in StreamReader(stream).records:
            messages += isinstance(record, Message)
    assert sum(COUNTS.values()) // 4 < messages < sum(COUNTS.values())
