"""Writes messages as they came over the wire into one MCAP file that every tool for ROS 2 reads."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import yaml
from mcap.writer import CompressionType, Writer

from ngo_recordings.definitions import message_definition
from ngo_recordings.errors import RecordingError

# What rosbag2 writes for "no limit".
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


class _WithoutAliases(yaml.SafeDumper):
    """Writes what occurs twice in full, as rosbag2 does."""

    def ignore_aliases(self, data: object) -> bool:
        return True


@dataclass
class _Topic:
    channel_id: int
    type_name: str
    qos: list[dict[str, object]]
    count: int = 0


class RecordingWriter:
    """One MCAP file of profile ros2: CDR messages, their real definitions, chunks compressed with zstd.

    What was written is on the file at most flush_s later (by flush_if_due), so a process that is killed leaves a file
    that is read to its last chunk. A path that ends in .mcap is the file itself; any other is a new folder in the
    layout of rosbag2, whose metadata.yaml is written by close. Use it as a context manager.

    Args:
        chunk_bytes: how much is compressed at a time.
        library: name of the program, kept in the file.
        flush_s: None ends chunks by their size alone: then the same messages make the same bytes.

    Raises:
        RecordingError: the folder exists and is not empty. Later, by any method: the disk is full, or gone; the file is
            closed then, and what it holds can be read.
        OSError: the file cannot be made.
    """

    def __init__(
        self,
        path: Path,
        chunk_bytes: int = 2**20,
        library: str = "ngo_recordings",
        flush_s: float | None = 1.0,
    ) -> None:
        self._folder = None if path.suffix == ".mcap" else path
        if self._folder is None:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.file = path
        else:
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise RecordingError(f"{path} exists: give a new folder, or a file that ends in .mcap")
            path.mkdir(parents=True, exist_ok=True)
            self.file = path / f"{path.resolve().name}_0.mcap"
        self._stream = self.file.open("wb")
        self._writer = Writer(self._stream, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library=library)
        self._schemas: dict[str, int] = {}
        self._topics: dict[str, _Topic] = {}
        self._first_ns, self._last_ns = 2**63 - 1, 0
        self._flush_s = flush_s
        self._flushed_s = time.monotonic()
        self._closed = False

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def add_topic(
        self,
        topic: str,
        type_name: str,
        definition: str | None = None,
        *,
        depth: int = 100,
        reliable: bool = True,
        transient_local: bool = False,
    ) -> None:
        """Announce a topic before its first message.

        Args:
            type_name: as in sensor_msgs/msg/Image.
            definition: text of the type and of all it is made of (ros2msg); None: that of the ROS packages on this
                machine, see message_definition.
            depth, reliable, transient_local: the QoS that a player offers.

        Raises:
            RecordingError: the topic is there already, or the type is unknown on this machine.
        """
        if topic in self._topics:
            raise RecordingError(f"topic {topic} was announced twice")
        if type_name not in self._schemas:
            text = message_definition(type_name) if definition is None else definition
            with self._writing():
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", text.encode())
        qos = [_qos(depth, reliable, transient_local)]
        with self._writing():
            channel_id = self._writer.register_channel(
                topic, "cdr", self._schemas[type_name], {"offered_qos_profiles": yaml.safe_dump(qos, sort_keys=False)}
            )
        self._topics[topic] = _Topic(channel_id, type_name, qos)

    def write(self, topic: str, cdr: bytes, log_time_ns: int, publish_time_ns: int | None = None) -> None:
        """Write one serialised message of a topic that was announced; publish_time_ns: None is log_time_ns.

        Raises RecordingError where a time is negative or does not fit into the file's 64 bits.
        """
        entry = self._topics[topic]
        published_ns = log_time_ns if publish_time_ns is None else publish_time_ns
        if not (0 <= log_time_ns < 2**63 and 0 <= published_ns < 2**63):
            raise RecordingError(f"a message of {topic} has the time {log_time_ns} ns; expected 0 to 2^63 ns")
        with self._writing():
            self._writer.add_message(entry.channel_id, log_time_ns, cdr, published_ns, sequence=entry.count)
        entry.count += 1
        self._first_ns, self._last_ns = min(self._first_ns, log_time_ns), max(self._last_ns, log_time_ns)
        self.flush_if_due()

    def flush_if_due(self) -> None:
        """Put what was written onto the file if the last time was flush_s ago; write does so, too."""
        now_s = time.monotonic()
        if self._flush_s is not None and now_s - self._flushed_s >= self._flush_s:
            self._flushed_s = now_s
            with self._writing():
                self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index (and metadata.yaml) and close the file."""
        if self._closed:
            return
        with self._writing():
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.close()
            if self._folder is not None:
                facts = {"rosbag2_bagfile_information": self._metadata()}
                text = yaml.dump(facts, Dumper=_WithoutAliases, sort_keys=False)
                (self._folder / "metadata.yaml").write_text(text)
        self._closed = True

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Around everything that writes: a disk that takes no more ends the recording, with one line."""
        if self._closed:
            raise RecordingError(f"{self.file} is closed")
        try:
            yield
        except OSError as error:
            self._closed = True
            with suppress(OSError):  # of what is still in its buffer
                self._stream.close()
            raise RecordingError(f"{self.file} cannot be written any further: {error.strerror}") from None

    def _metadata(self) -> dict[str, object]:
        """What rosbag2 of Jazzy (version 9) writes about a recording of one file."""
        count = sum(topic.count for topic in self._topics.values())
        extent = {
            "duration": {"nanoseconds": self._last_ns - self._first_ns if count else 0},
            "starting_time": {"nanoseconds_since_epoch": self._first_ns if count else 0},
            "message_count": count,
        }
        return {
            "version": 9,
            "storage_identifier": "mcap",
            **extent,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": name,
                        "type": topic.type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": topic.qos,
                        "type_description_hash": "",
                    },
                    "message_count": topic.count,
                }
                for name, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.file.name],
            "files": [{"path": self.file.name, **extent}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


def _qos(depth: int, reliable: bool, transient_local: bool) -> dict[str, object]:
    """A QoS profile as rosbag2 of Jazzy writes it."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if transient_local else "volatile",
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": "automatic",
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }
