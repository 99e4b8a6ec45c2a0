"""The topics of a simulator node, and on request a recording of them."""

from __future__ import annotations

import copy
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message

from ngo_common.nodes.process import RunError
from ngo_common.nodes.qos import checked_overrides, overridable
from ngo_common.settings import BadParameter
from ngo_recordings.errors import RecordingError
from ngo_recordings.writer import RecordingWriter

_ACKED_S = 5.0


class Output:
    """One topic; where there is a recording, a message is serialised once for both."""

    def __init__(self, publisher: Publisher, recording: Recording | None) -> None:
        self.publisher = publisher
        self._recording = recording

    def publish(self, message: Any) -> None:
        """Publish a message, and record it."""
        if self._recording is None:
            self.publisher.publish(message)
            return
        cdr = serialize_message(message)
        with _disk_errors():
            self._recording.writer.write(self.publisher.topic_name, cdr, self._recording.now_ns)
        self.publisher.publish(cdr)


class Recording:
    """A file being written, and the log time of the next message."""

    def __init__(self, path: Path) -> None:
        self.writer = RecordingWriter(path, library="ngo_sim")
        self.now_ns = 0


@contextmanager
def _disk_errors() -> Iterator[None]:
    """Around the recording of a running node: a run whose recording has ended ends, too."""
    try:
        yield
    except RecordingError as error:
        raise RunError(f"parameter 'record': {error}") from None


class Outputs:
    """All topics of a node. record: a file ending in .mcap, or a folder for rosbag2's layout; empty: no recording.

    Log times are the stamps of the frames, so a recording does not depend on how fast it was made. Raises BadParameter
    where something is there already, or nothing can be written, and RunError where the disk takes no more later on.
    """

    def __init__(self, node: Node, qos: QoSProfile, record: str) -> None:
        self._node, self._qos = node, qos
        self.topic_names: list[str] = []
        """The resolved names of all topics."""
        self._publishers: list[Publisher] = []
        self._recording: Recording | None = None
        if record:
            path = Path(record).expanduser()
            if path.exists():
                raise BadParameter(
                    f"parameter 'record' is {record!r}, which exists; allowed: a new .mcap file or a new folder"
                )
            try:
                self._recording = Recording(path)
            except (OSError, RecordingError) as error:
                raise BadParameter(f"parameter 'record' is {record!r}, which cannot be written: {error}") from None
            # Nothing else closes the file of a node that is interrupted while it starts.
            weakref.finalize(self, _closed, self._recording.writer)

    def create(self, message_type: type, topic: str, qos: QoSProfile | None = None) -> Output:
        """A topic to publish on; qos: that of the sensors by default."""
        qos = copy.copy(self._qos if qos is None else qos)  # rclpy writes the overrides into it
        with checked_overrides():
            publisher = self._node.create_publisher(message_type, topic, qos, qos_overriding_options=overridable())
        self.topic_names.append(publisher.topic_name)
        self._publishers.append(publisher)
        if self._recording is not None:
            package = message_type.__module__.partition(".")[0]
            type_name = f"{package}/msg/{message_type.__name__}"
            try:
                latched = qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
                self._recording.writer.add_topic(
                    publisher.topic_name, type_name, depth=qos.depth, transient_local=latched
                )
            except RecordingError as error:
                raise BadParameter(f"parameter 'record' is set, but {error}") from None
        return Output(publisher, self._recording)

    def set_time(self, stamp_ns: int) -> None:
        """Set the log time of the next messages."""
        if self._recording is not None:
            self._recording.now_ns = stamp_ns

    def flush_if_due(self) -> None:
        """Write buffered messages to the file once a period."""
        if self._recording is not None:
            with _disk_errors():
                self._recording.writer.flush_if_due()

    def wait_for_all_acked(self) -> None:
        """Wait until every reliable subscriber has every message, for 5 s at most."""
        deadline_s = time.monotonic() + _ACKED_S
        for publisher in self._publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, deadline_s - time.monotonic())))

    def close(self) -> None:
        """End the recording."""
        if self._recording is not None:
            with _disk_errors():
                self._recording.writer.close()


def _closed(writer: RecordingWriter) -> None:
    with suppress(RecordingError):  # nobody is left to be told
        writer.close()
