"""What one file may cost is bounded: sizes of chunks, definitions, lists in messages, stamps."""

import io
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
import zstandard
from mcap.writer import CompressionType, Writer

from ngo_recordings.association import header_stamp_ns
from ngo_recordings.errors import RecordingError
from ngo_recordings.poses import read_tum
from ngo_recordings.recording import open_recording
from ngo_recordings.writer import RecordingWriter

from . import messages as m

MB = 2**20
# Largest resident memory of a process itself, MB; getrusage would count that of the process it was forked from.
PEAK = "print(next(int(line.split()[1]) // 1024 for line in open('/proc/self/status') if line.startswith('VmHWM')))"
PACK: dict[str, Callable[[bytes], bytes]] = {
    "zstd": zstandard.ZstdCompressor().compress,
    "lz4": lz4.frame.compress,
    "": bytes,
}


def write_chunk(path: Path, compression: str, packed: bytes, declared: int) -> Path:
    """A file whose only chunk holds what it likes; written by the library, with the chunk swapped."""

    stream = io.BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE)
    writer.start(profile="ros2")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channel = writer.register_channel("/text", "cdr", schema)
    writer.add_message(channel, 1, b"\0\1\0\0" + struct.pack("<I2s", 2, b"a\0"), 1)
    writer.finish()  # type: ignore[no-untyped-call]
    honest = stream.getvalue()
    start = honest.index(struct.pack("<B", 6), 8)  # the chunk's opcode, after the header
    while True:
        length = struct.unpack_from("<Q", honest, start + 1)[0]
        if honest[start] == 6 and start + 9 + length < len(honest):
            break
        start = honest.index(struct.pack("<B", 6), start + 1)
    body = struct.pack("<QQQI", 1, 1, declared, 0) + struct.pack("<I", len(compression)) + compression.encode()
    body += struct.pack("<Q", len(packed)) + packed
    content = honest[:start] + struct.pack("<BQ", 6, len(body)) + body
    # Without the index that no longer fits: the file was cut after the chunk.
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("compression", list(PACK))
def test_chunks_are_bounded_by_declared_and_real_size(tmp_path: Path, compression: str) -> None:
    big = bytes(4 * MB)
    packed = PACK[compression](big)
    with pytest.raises(RecordingError, match=r"a chunk of 4194304 bytes; expected at most 1048576|a record of 4194\d+"):
        open_recording([write_chunk(tmp_path / "a.mcap", compression, packed, len(big))], max_chunk_bytes=MB)
    with pytest.raises(RecordingError, match=r"a chunk declares 1000 bytes and holds (more than )?\d+|a record of"):
        open_recording([write_chunk(tmp_path / "b.mcap", compression, packed, 1000)], max_chunk_bytes=MB)
    with pytest.raises(RecordingError, match=r"a chunk declares 9999999 bytes and holds 4194304"):
        open_recording([write_chunk(tmp_path / "c.mcap", compression, packed, 9999999)])


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
@pytest.mark.parametrize("declared", [1000, 2**30])
def test_a_bomb_costs_little_memory(tmp_path: Path, compression: str, declared: int) -> None:
    packed = PACK[compression](bytes(2**30))
    path = write_chunk(tmp_path / "a.mcap", compression, packed, declared)
    code = (
        "import sys; from pathlib import Path\n"
        "from ngo_recordings.errors import RecordingError\n"
        "from ngo_recordings.recording import open_recording\n"
        "try: open_recording([Path(sys.argv[1])])\n"
        f"except RecordingError: {PEAK}\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 500


SEPARATOR = "\n" + "=" * 80 + "\n"


def chain(count: int) -> str:
    return SEPARATOR.join(["p/T0 a", *(f"MSG: p/T{k}\np/T{k + 1} a" for k in range(count)), f"MSG: p/T{count}\nint8 a"])


def doubling(count: int) -> str:
    parts = [f"MSG: p/T{k}\np/T{k + 1} a\np/T{k + 1} b" for k in range(count)]
    return SEPARATOR.join(["p/T0 a", *parts, f"MSG: p/T{count}\nint8 a"])


@pytest.mark.parametrize(
    ("definition", "complaint"),
    [
        (SEPARATOR.join(["p/A a", "MSG: p/A\np/B b", "MSG: p/B\np/A a"]), "is cyclic: p/msg/A > p/msg/B > p/msg/A"),
        (SEPARATOR.join(["p/A[] a", "MSG: p/A\np/A[] a"]), "is cyclic"),
        (chain(60), "is deeper than 50"),
        (chain(3000), "cannot be read"),
        (doubling(40), "has more than 10000 parts"),
        ("string[100000000] a", "has more than 10000 parts"),
        (SEPARATOR.join(["p/A[1000000] a", "MSG: p/A\nint8 a"]), "has more than 10000 parts"),
        (SEPARATOR.join(["p/A[] a", "MSG: p/A\np/B[0] a", "MSG: p/B\nint8 a"]), "elements without content"),
        ("p/Missing a", "cannot be read"),
        ("a" * 100_000, "cannot be read"),
    ],
)
def test_hostile_definitions_are_one_clear_line(tmp_path: Path, definition: str, complaint: str) -> None:
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/bad", "p/msg/Bad", definition)
        writer.write("/bad", bytes(64), 1)
    with open_recording([tmp_path / "a.mcap"]) as recording, pytest.raises(RecordingError, match=complaint) as error:
        list(recording.messages())
    assert "\n" not in str(error.value) and "a.mcap" in str(error.value) and len(str(error.value)) < 2000


def test_a_message_of_millions_of_tiny_parts_is_refused(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/bad", "p/msg/Bad", SEPARATOR.join(["p/A[] a", "MSG: p/A\nint8 a"]))
        writer.write("/bad", b"\0\1\0\0" + struct.pack("<I", 5 * 10**6) + bytes(5 * 10**6), 1)
    with open_recording([tmp_path / "a.mcap"]) as recording, pytest.raises(RecordingError, match="more than 1000000"):
        list(recording.messages())


def test_chunks_that_all_overlap_in_time_are_not_held_at_once(tmp_path: Path) -> None:
    text = b"a" * 50_000 + b"\0"
    with RecordingWriter(tmp_path / "a.mcap", chunk_bytes=50_000, flush_s=None) as writer:
        writer.add_topic("/text", "std_msgs/msg/String", "string data")
        for k in range(20):
            writer.write("/text", b"\0\1\0\0" + struct.pack("<I", len(text)) + text, 0 if k % 2 else 10**9 - k)
    with open_recording([tmp_path / "a.mcap"]) as recording:
        times = [message.log_time_ns for message in recording.messages()]
        assert times == sorted(times) and len(times) == 20
    with (
        open_recording([tmp_path / "a.mcap"], max_chunk_bytes=120_000) as recording,
        pytest.raises(RecordingError, match="chunks overlap in time"),
    ):
        list(recording.messages())


def test_times_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"a stamp is -1 s and 5 ns"):
        header_stamp_ns(m.make("sensor_msgs/msg/LaserScan", m.header(5 - 10**9), *([0.0] * 7), [], []))
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/text", "std_msgs/msg/String", "string data")
        for time_ns in (-1, 2**63, 2**80):
            with pytest.raises(RecordingError, match=r"a message of /text has the time"):
                writer.write("/text", b"", time_ns)
    for stamp in ("1e300", "inf", "nan", "-3"):
        (tmp_path / "a.tum").write_text(f"1 0 0 0 0 0 0 1\n{stamp} 0 0 0 0 0 0 1\n")
        with pytest.raises(RecordingError, match=r"a\.tum has the stamp"):
            read_tum(tmp_path / "a.tum", 10**9)


def test_a_full_disk_ends_the_recording_with_one_line(tmp_path: Path) -> None:
    """Whatever was asked last: a message, a topic, the end. What was written before can be read."""
    code = (
        "import resource, sys; from pathlib import Path\n"
        "from ngo_recordings.errors import RecordingError\n"
        "from ngo_recordings.writer import RecordingWriter\n"
        "writer = RecordingWriter(Path(sys.argv[1]), chunk_bytes=1000)\n"
        "writer.add_topic('/text', 'std_msgs/msg/String', 'string data')\n"
        "for k in range(10): writer.write('/text', bytes([k]) * 1000, k)\n"
        "writer._stream.flush()\n"
        "size = Path(sys.argv[1]).stat().st_size\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (size + 100, -1))\n"
        "for work in (lambda: [writer.write('/text', __import__('os').urandom(10**5), k) for k in range(10)],\n"
        "    lambda: writer.add_topic('/more', 'std_msgs/msg/String', 'string data'),\n"
        "    lambda: writer.write('/text', b'', 1)):\n"
        "    try: work()\n"
        "    except RecordingError as error: print(error)\n"
        "writer.close()\n"
    )
    path = tmp_path / "a.mcap"
    done = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines == [f"{path} cannot be written any further: File too large", *2 * [f"{path} is closed"]]
    with open_recording([path]) as recording:
        assert recording.unfinished == (path,) and recording.topics["/text"].count >= 9
