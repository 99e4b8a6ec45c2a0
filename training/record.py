"""Record topics of a running graph, until Ctrl-C or for some seconds.

    python -m training.record --out drive.mcap
    python -m training.record --out drive --topics /camera/image_raw /odom /tf /tf_static --seconds 60

A name that ends in .mcap is the file. Any other name is a new folder in the layout of rosbag2, for `ros2 bag info` and
`ros2 bag play`. If the recorder is killed, the file is readable up to its last second.
"""

import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

from ngo_recordings.errors import RecordingError
from training.recordings.recorder import Recorder

_LOOK_S = 0.2


@dataclass(frozen=True)
class Arguments:
    """Settings of a recording."""

    out: Path  # A new file ending in .mcap, or a new folder.
    topics: tuple[str, ...] = ()  # Topics to record; none: all of the graph, including later ones.
    seconds: float = 0.0  # Duration; 0: until Ctrl-C.

    def __post_init__(self) -> None:
        if self.seconds < 0.0:
            raise RecordingError(f"seconds is {self.seconds:g}; expected a time, or 0 to record until Ctrl-C")
        if self.out.exists():
            raise RecordingError(f"{self.out} exists: name a new .mcap file or a new folder")


class Discovery:
    """Subscribes the wanted topics of a graph as they come, as their publishers offer them."""

    def __init__(self, recorder: Recorder, topics: tuple[str, ...]) -> None:
        self._recorder = recorder
        self._wanted = {recorder.node.resolve_topic_name(topic) for topic in topics}
        self._refused: set[str] = set()

    @property
    def missing(self) -> set[str]:
        """Topics that were asked for and are not there yet."""
        return self._wanted - self._recorder.counts.keys() - self._refused

    def look(self) -> None:
        """Subscribe what is new."""
        for topic, types in self._recorder.node.get_topic_names_and_types():
            if topic in self._recorder.counts or topic in self._refused or (self._wanted and topic not in self._wanted):
                continue
            # Our own end of /rosout alone is no publisher to wait for.
            offers = [info.qos_profile for info in self._recorder.node.get_publishers_info_by_topic(topic)]
            if not offers:
                continue
            try:
                self._recorder.subscribe(
                    topic,
                    types[0],
                    reliable=all(offer.reliability == ReliabilityPolicy.RELIABLE for offer in offers),
                    transient_local=all(offer.durability == DurabilityPolicy.TRANSIENT_LOCAL for offer in offers),
                )
                print(f"recording {topic} ({types[0]})", flush=True)
            except RecordingError as error:
                self._refused.add(topic)
                print(f"left out: {error}", file=sys.stderr, flush=True)


def main(arguments: Arguments) -> dict[str, int]:
    """Record; returns how many messages of each topic there are."""
    ended: list[int] = []
    previous = {
        number: signal.signal(number, lambda got, _: ended.append(got)) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        with Recorder(arguments.out) as recorder:
            discovery = Discovery(recorder, arguments.topics)
            started_s = time.monotonic()
            looked_s = -_LOOK_S
            while not ended:
                now_s = time.monotonic()
                if arguments.seconds and now_s - started_s >= arguments.seconds:
                    break
                if now_s - looked_s >= _LOOK_S:
                    looked_s = now_s
                    discovery.look()
                recorder.spin_once()
            counts = dict(recorder.counts)
            missing = discovery.missing
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
    for topic, count in sorted(counts.items()):
        print(f"{count:8d} messages of {topic}")
    for topic in sorted(missing):
        print(f"topic {topic} never came: `ros2 topic list` shows what there is", file=sys.stderr)
    print(f"{arguments.out}")
    return counts


if __name__ == "__main__":
    try:
        main(tyro.cli(Arguments, description=__doc__))
    except (RecordingError, OSError) as problem:
        sys.exit(f"record: {problem}")
