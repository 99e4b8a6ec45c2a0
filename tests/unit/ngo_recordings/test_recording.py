"""Recordings of every kind are read the same, whole or cut; what cannot be read says so in one line."""

import shutil
import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionMode, Reader, StoragePlugin

from ngo_recordings.definitions import message_definition
from ngo_recordings.errors import RecordingError
from ngo_recordings.recording import Message, TopicInfo, open_recording
from ngo_recordings.topics import choose_topics
from ngo_recordings.writer import RecordingWriter

from . import messages as m

COUNT = 60


def drive(count: int = COUNT, seed: int = 0) -> Iterator[m.Entry]:
    """Images, custom messages and strings, three a frame."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        stamp_ns = 10**9 + k * 10**8
        yield "/image", stamp_ns, m.image(stamp_ns, rng.integers(0, 256, (8, 12, 3)).astype(np.uint8))
        yield "/pose", stamp_ns + 1, m.pose_stamped(stamp_ns, 0.1 * k, -0.2, 0.3)
        yield "/action", stamp_ns + 2, m.action(stamp_ns, k % 3)


def facts(messages: Iterator[Message]) -> list[tuple[str, int, bytes]]:
    """What can be compared of messages: made into bytes again."""
    return [(each.topic, each.log_time_ns, m.serialised(into_store(each.value))) for each in messages]


def into_store(value: Any) -> Any:
    """The same message of the types of the tests' own store, whose classes differ."""
    if isinstance(value, list):
        return [into_store(item) for item in value]
    if not hasattr(value, "__msgtype__"):
        return value
    fields = {name: into_store(part) for name, part in vars(value).items()}
    return m.STORE.types[value.__msgtype__](**fields)


def expected(entries: list[m.Entry]) -> list[tuple[str, int, bytes]]:
    return [(topic, log_time_ns, m.serialised(message)) for topic, log_time_ns, message in entries]


@pytest.fixture(params=["mcap", "folder", "rosbags_mcap", "rosbags_sqlite3", "sqlite3_file"])
def stored(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """One drive in each form that we read."""
    entries = list(drive())
    if request.param == "mcap":
        return m.write_mcap(tmp_path / "drive.mcap", entries, chunk_bytes=5000)
    if request.param == "folder":
        return m.write_mcap(tmp_path / "drive", entries, chunk_bytes=5000)
    if request.param == "rosbags_mcap":
        return m.write_rosbag(tmp_path / "drive", entries, StoragePlugin.MCAP)
    folder = m.write_rosbag(tmp_path / "drive", entries)
    return folder if request.param == "rosbags_sqlite3" else folder / "drive.db3"


def test_every_form_is_read_the_same(stored: Path) -> None:
    entries = list(drive())
    with open_recording([stored]) as recording:
        assert facts(recording.messages()) == expected(entries)
        assert recording.topics == {
            "/action": TopicInfo("ngo_msgs/msg/DiscreteAction", COUNT, entries[2][1], entries[-1][1]),
            "/image": TopicInfo("sensor_msgs/msg/Image", COUNT, entries[0][1], entries[-3][1]),
            "/pose": TopicInfo("geometry_msgs/msg/PoseStamped", COUNT, entries[1][1], entries[-2][1]),
        }
        assert recording.unfinished == ()
        chosen = [entry for entry in entries if entry[0] != "/image"]
        assert facts(recording.messages(["/pose", "/action"])) == expected(chosen)


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compression", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_compressed_folders_are_read(tmp_path: Path, storage: StoragePlugin, compression: CompressionMode) -> None:
    folder = m.write_rosbag(tmp_path / "drive", drive(), storage, compression)
    with open_recording([folder]) as recording:
        assert facts(recording.messages()) == expected(list(drive()))


def test_custom_types_need_no_ros_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = m.write_mcap(tmp_path / "drive.mcap", drive())
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    with open_recording([path]) as recording:
        actions = [message.value.action for message in recording.messages(["/action"])]
    assert actions == [k % 3 for k in range(COUNT)]


def test_the_mcap_and_the_rosbags_library_read_every_message(tmp_path: Path) -> None:
    entries = list(drive())
    path = m.write_mcap(tmp_path / "drive.mcap", entries, chunk_bytes=5000)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        read = [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]
    assert read == expected(entries)
    with AnyReader([path]) as reader:
        for (connection, log_time_ns, data), (topic, time_ns, cdr) in zip(
            reader.messages(), expected(entries), strict=True
        ):
            assert (connection.topic, log_time_ns, bytes(data)) == (topic, time_ns, cdr)
            assert reader.deserialize(data, connection.msgtype).header.stamp.sec == time_ns // 10**9


def test_a_folder_is_one_of_rosbag2(tmp_path: Path) -> None:
    folder = m.write_mcap(tmp_path / "drive", drive())
    with Reader(folder) as reader:  # refuses metadata.yaml that is not as it should be
        assert reader.message_count == 3 * COUNT and reader.ros_distro == "jazzy"
        assert (reader.start_time, reader.end_time - 1) == (10**9, 10**9 + (COUNT - 1) * 10**8 + 2)
        assert {connection.topic: connection.msgcount for connection in reader.connections} == dict.fromkeys(
            ("/image", "/pose", "/action"), COUNT
        )
        assert sum(1 for _ in reader.messages()) == 3 * COUNT
    text = (folder / "metadata.yaml").read_text()
    assert "&" not in text, "aliases, which rosbag2 does not write"


def test_several_files_are_one_in_order_of_time(tmp_path: Path) -> None:
    entries = list(drive())
    first = m.write_mcap(tmp_path / "b.mcap", entries[::2])
    second = m.write_rosbag(tmp_path / "a", entries[1::2])
    with open_recording([first, second]) as recording:
        assert facts(recording.messages()) == expected(entries)
        assert recording.topics["/image"].count == COUNT


def cut(path: Path, size: int) -> Path:
    copy = path.with_name(f"cut_{size}.mcap")
    copy.write_bytes(path.read_bytes()[:size])
    return copy


def test_wherever_a_file_is_cut_it_is_read_to_its_last_whole_chunk(tmp_path: Path) -> None:
    entries = list(drive())
    path = m.write_mcap(tmp_path / "drive.mcap", entries, chunk_bytes=3000)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) > 10
    ends = [(chunk.chunk_start_offset + chunk.chunk_length, chunk.message_end_time) for chunk in summary.chunk_indexes]
    for end, last_ns in ends:
        for size in (end, end + 5):  # and within the record after it
            with open_recording([cut(path, size)]) as recording:
                read = facts(recording.messages())
                assert recording.unfinished == recording.paths
                assert sum(info.count for info in recording.topics.values()) == len(read)
            assert read == expected([entry for entry in entries if entry[1] <= last_ns])


def test_of_a_file_that_lost_its_end_to_zeros_the_beginning_is_read(tmp_path: Path) -> None:
    path = m.write_mcap(tmp_path / "drive.mcap", drive(), chunk_bytes=5000)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] + bytes(len(whole) // 2))
    with open_recording([path]) as recording:
        read = facts(recording.messages())
        assert 60 < len(read) < 3 * COUNT and read == expected(list(drive()))[: len(read)]
        assert recording.unfinished and "this chunk is left out" in recording.notes[0]


def test_what_is_written_is_on_the_file_before_it_is_closed(tmp_path: Path) -> None:
    path = tmp_path / "drive.mcap"
    with RecordingWriter(path, flush_s=0.0) as writer:
        writer.add_topic("/action", m.ACTION)
        for k in range(5):
            writer.write("/action", m.serialised(m.action(k, 1)), k)
            with open_recording([path]) as recording:
                assert [message.log_time_ns for message in recording.messages()] == list(range(k + 1))


def test_files_without_chunks_or_without_an_index_are_read(tmp_path: Path) -> None:
    entries = list(drive())
    for name, options in (("plain", {"use_chunking": False}), ("unindexed", {"use_statistics": False})):
        path = tmp_path / f"{name}.mcap"
        with path.open("wb") as stream:
            writer = Writer(stream, compression=CompressionType.LZ4, **options)
            writer.start(profile="ros2")
            channels: dict[str, int] = {}
            for topic, log_time_ns, message in entries:
                if topic not in channels:
                    text = message_definition(message.__msgtype__)
                    schema = writer.register_schema(message.__msgtype__, "ros2msg", text.encode())
                    channels[topic] = writer.register_channel(topic, "cdr", schema)
                writer.add_message(channels[topic], log_time_ns, m.serialised(message), log_time_ns)
            writer.finish()
        with open_recording([path]) as recording:
            assert facts(recording.messages()) == expected(entries)
            assert recording.topics["/pose"].count == COUNT
            assert recording.unfinished == ()


def test_sqlite3_of_old_versions_without_definitions_is_read_by_the_standard_ones(tmp_path: Path) -> None:
    import sqlite3

    entries = [entry for entry in drive() if entry[0] == "/pose"]
    path = tmp_path / "old.db3"
    with sqlite3.connect(path) as database:
        database.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT,"
            " offered_qos_profiles TEXT);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB);"
            "INSERT INTO topics VALUES(1, '/pose', 'geometry_msgs/msg/PoseStamped', 'cdr', '');"
        )
        rows = [(1, time_ns, cdr) for _, time_ns, cdr in expected(entries)]
        database.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)", rows)
    database.close()
    with open_recording([path]) as recording:
        assert facts(recording.messages()) == expected(entries)


def test_a_folder_whose_recorder_was_killed_needs_no_metadata(tmp_path: Path) -> None:
    folder = m.write_mcap(tmp_path / "drive", drive())
    (folder / "metadata.yaml").unlink()
    with open_recording([folder]) as recording:
        assert facts(recording.messages()) == expected(list(drive()))


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("gone.mcap", None, "there is no file"),
        ("text.mcap", b"not a recording", "cannot be read as MCAP"),
        ("empty.mcap", b"", "cannot be read as MCAP"),
        ("text.db3", b"not a recording, but longer than a head of sqlite" * 9, "cannot be read as a rosbag2 recording"),
        ("drive.bag", b"#ROSBAG V2.0", "cannot be read as a ROS 1 bag"),
        ("drive.txt", b"12.5 1.0 2.0", "is no recording: expected a .mcap, .db3 or .bag file"),
    ],
)
def test_what_is_no_recording_is_refused_in_one_line(
    tmp_path: Path, name: str, content: bytes | None, complaint: str
) -> None:
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError) as error:
        open_recording([path])
    assert complaint in str(error.value) and str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_folder_says_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"it has no .mcap or .db3 files"):
        open_recording([tmp_path])
    folder = m.write_mcap(tmp_path / "drive", drive())
    (folder / "drive_0.mcap").rename(folder / "other.mcap")
    with open_recording([folder]) as recording:
        assert "/image" in recording.topics
        assert "lacks drive_0.mcap, which its metadata.yaml names: what is there is read" in recording.notes[0]
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    (folder / "b.mcap").touch()
    (folder / "c.db3").write_bytes(b"SQLite format 3")
    with open_recording([folder]) as recording:
        assert "/image" in recording.topics and len(recording.notes) == 3
        assert "metadata.yaml is not what rosbag2 writes: the files beside it are read" in recording.notes[0]
        assert recording.notes[1].startswith("b.mcap in ") and recording.notes[2].startswith("c.db3 in ")
    with pytest.raises(RecordingError, match="no recording was given"):
        open_recording([])


def test_of_a_folder_that_was_copied_in_part_the_rest_is_read(tmp_path: Path) -> None:
    folder = m.write_mcap(tmp_path / "drive", drive())
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("- drive_0.mcap", "- drive_0.mcap\n  - drive_1.mcap"))
    with open_recording([folder]) as recording:
        assert "/image" in recording.topics and "lacks drive_1.mcap" in recording.notes[0]


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_files_after_those_of_the_metadata_are_read(tmp_path: Path, storage: StoragePlugin) -> None:
    entries = list(drive())
    folder, rest = (
        m.write_rosbag(tmp_path / name, part, storage)
        for name, part in (("drive", entries[:90]), ("rest", entries[90:]))
    )
    (first,), (last,) = ([file for file in each.iterdir() if file.suffix != ".yaml"] for each in (folder, rest))
    named = folder / f"drive_0{first.suffix}"
    first.rename(named)
    metadata = folder / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace(first.name, named.name))
    for name in ("drive_1", "other"):
        shutil.copy(last, folder / f"{name}{last.suffix}")
    with open_recording([folder]) as recording:
        assert facts(recording.messages()) == expected(entries)
        (note,) = recording.notes
        assert f"does not name drive_1{last.suffix}, which follow" in note


def test_in_a_folder_names_say_which_files_are_recordings(tmp_path: Path) -> None:
    """What only begins as a recording, or is not named by a metadata.yaml that can be read, lies there by chance."""
    folder = m.write_rosbag(tmp_path / "bag", drive())
    (folder / "metadata.yaml").unlink()
    with sqlite3.connect(folder / "rtabmap.db") as database:
        database.execute("CREATE TABLE Node(id)")
    database.close()
    (folder / "notes.txt.zst").write_bytes(zstandard.ZstdCompressor().compress(b"notes"))
    (folder / "empty.db3.zst").touch()
    cut = m.write_mcap(tmp_path / "drive", drive())
    metadata = cut / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("- drive_0.mcap", "- drive_0.mcap\n  - drive_1.mcap"))
    for name in ("drive_0.mcap.bak", "old.mcap"):
        shutil.copy(cut / "drive_0.mcap", cut / name)
    for opened, note in ((folder, "empty.db3.zst in "), (cut, f"{cut} lacks drive_1.mcap")):
        with open_recording([opened]) as recording:
            assert facts(recording.messages()) == expected(list(drive()))
            assert len(recording.notes) == 1 and recording.notes[0].startswith(note)
    metadata.unlink()
    (cut / "old.mcap").unlink()
    with open_recording([cut]) as recording:
        assert facts(recording.messages()) == expected(list(drive()))
    (cut / "drive_0.mcap").unlink()
    with open_recording([cut]) as recording:  # of a name that says nothing
        assert facts(recording.messages()) == expected(list(drive()))


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_what_a_file_begins_with_counts_before_its_name(tmp_path: Path, kind: str) -> None:
    folder = m.write_rosbag(tmp_path / "db3", drive()) if kind == "db3" else m.write_mcap(tmp_path / "mcap", drive())
    content = next(folder.glob(f"*.{kind}")).read_bytes()
    packed = zstandard.ZstdCompressor().compress(content)
    for name in ("drive", "drive.bag", "drive.MCAP", "drive.DB3", "drive.db", "drive.sqlite"):
        for path, data in ((tmp_path / name, content), (tmp_path / f"{name}.zst", packed), (tmp_path / name, packed)):
            path.write_bytes(data)
            with open_recording([path]) as recording:
                assert facts(recording.messages()) == expected(list(drive())), path


def test_topics_that_are_not_there_or_of_two_types_are_named(tmp_path: Path) -> None:
    first = m.write_mcap(tmp_path / "a.mcap", drive())
    with (
        open_recording([first]) as recording,
        pytest.raises(RecordingError, match=r"there is no topic /images .*it has /action, /image, /pose"),
    ):
        recording.messages(["/images"])
    second = m.write_mcap(tmp_path / "b.mcap", [("/image", 1, m.pose_stamped(1, 0.0, 0.0, 0.0))])
    with pytest.raises(RecordingError, match=r"topic /image is of several types .*open these recordings apart"):
        open_recording([first, second])


def test_a_message_that_is_not_what_its_type_says_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    good = m.serialised(m.pose_stamped(1, 0.0, 0.0, 0.0))
    with RecordingWriter(path) as writer:
        writer.add_topic("/pose", "geometry_msgs/msg/PoseStamped")
        writer.write("/pose", good, 1_500_000_000)
        writer.write("/pose", good[:-20], 2_500_000_000)
    with open_recording([path]) as recording:
        read = recording.messages()
        assert next(read).log_time_ns == 1_500_000_000
        with pytest.raises(
            RecordingError, match=r"/pose at 2.500000000 s \(\d+ bytes\) cannot be read as geometry_msgs"
        ):
            next(read)


def test_the_writer_refuses_what_it_cannot_keep(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").touch()
    with pytest.raises(RecordingError, match="exists: give a new folder"):
        RecordingWriter(tmp_path / "there")
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/pose", "geometry_msgs/msg/PoseStamped")
        with pytest.raises(RecordingError, match="announced twice"):
            writer.add_topic("/pose", "geometry_msgs/msg/PoseStamped")
        with pytest.raises(RecordingError, match=r"no_msgs/msg/None is in no package on AMENT_PREFIX_PATH"):
            writer.add_topic("/none", "no_msgs/msg/None")
        with pytest.raises(RecordingError, match=r"expected a name such as sensor_msgs/msg/Image"):
            writer.add_topic("/none", "geometry_msgs/PoseStamped")


def test_the_first_message_is_there_or_its_lack_is_said(tmp_path: Path) -> None:
    with RecordingWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/empty", "std_msgs/msg/String", "string data")
        writer.add_topic("/action", "ngo_msgs/msg/DiscreteAction")
        for k in range(3):
            writer.write("/action", m.serialised(m.action(k, k)), 5 - k)
    with open_recording([tmp_path / "a.mcap"]) as recording:
        assert recording.first("/action").log_time_ns == 3
        with pytest.raises(RecordingError, match=r"topic /empty has no message in .*a.mcap"):
            recording.first("/empty")


def odometries(count: int) -> list[m.Entry]:
    stamps = [k * 10**8 for k in range(count)]
    return [("/odom", t, m.odometry(t, m.pose(1e-9 * t, 0, 0), m.twist(0, 0, 0))) for t in stamps]


def killed_recorder(folder: Path, count: int = 400) -> Path:
    """A sqlite3 file whose end is in its log alone, as a killed recorder leaves it."""
    entries = odometries(count)
    bag = m.write_rosbag(folder / "whole", entries)
    (source,) = bag.glob("*.db3")
    path = folder / "killed" / "bag_0.db3"
    path.parent.mkdir()
    shutil.copyfile(source, path)
    database = sqlite3.connect(path)
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("PRAGMA wal_autocheckpoint=0")
    rows = database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id").fetchall()
    database.execute("DELETE FROM messages WHERE id > ?", (count // 2,))
    database.commit()
    database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows[count // 2 :])
    database.commit()
    for name in ("", "-wal"):
        shutil.copyfile(f"{path}{name}", folder / f"kept{name}")
    database.close()
    for name in ("", "-wal"):
        shutil.move(folder / f"kept{name}", f"{path}{name}")
    return path


def test_what_a_killed_recorder_had_in_its_log_is_read(tmp_path: Path) -> None:
    path = killed_recorder(tmp_path)
    before = path.read_bytes()
    for opened in (path, path.parent):
        with open_recording([opened]) as recording:
            assert len(list(recording.messages())) == recording.topics["/odom"].count == 400
            assert "bag_0.db3-wal holds its end" in recording.notes[0]
    assert path.read_bytes() == before


def test_packed_files_without_their_metadata_are_read(tmp_path: Path) -> None:
    entries = odometries(9)
    for mode in (CompressionMode.FILE, CompressionMode.MESSAGE):
        bag = m.write_rosbag(tmp_path / mode.name, entries, compression=mode)
        (bag / "metadata.yaml").unlink()
        for opened in (bag, next(bag.iterdir())):
            with open_recording([opened]) as recording:
                found = [each.value.pose.pose.position.x for each in recording.messages()]
                assert found == pytest.approx([0.1 * k for k in range(9)])


@pytest.mark.parametrize("metadata", [True, False])
def test_of_files_that_are_cut_in_the_middle_the_beginning_is_read(tmp_path: Path, metadata: bool) -> None:
    sqlite3_file, mcap_file = StoragePlugin.SQLITE3, StoragePlugin.MCAP
    none, packed = CompressionMode.NONE, CompressionMode.FILE
    for k, (storage, mode) in enumerate([(sqlite3_file, none), (sqlite3_file, packed), (mcap_file, packed)]):
        bag = m.write_rosbag(tmp_path / str(k), odometries(4000), storage, mode)
        (file,) = (each for each in bag.iterdir() if each.name != "metadata.yaml")
        file.write_bytes(file.read_bytes()[: 7 * file.stat().st_size // 10])
        if not metadata:
            (bag / "metadata.yaml").unlink()
        with open_recording([bag]) as recording:
            found = [each.value.pose.pose.position.x for each in recording.messages()]
            assert recording.notes or recording.unfinished
        assert 500 < len(found) < 4000 and found == pytest.approx([0.1 * k for k in range(len(found))])


def test_a_file_that_is_cut_before_anything_is_whole_says_so(tmp_path: Path) -> None:
    path = m.write_mcap(tmp_path / "a.mcap", odometries(50))
    path.write_bytes(path.read_bytes()[:2000])
    with (
        open_recording([path]) as recording,
        pytest.raises(RecordingError, match=r"there are none; a\.mcap is cut off before its first chunk ends"),
    ):
        choose_topics(recording)


def test_a_topic_in_another_encoding_is_left_out_and_named(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start("ros2")
        text = "float64 data\n"
        good = writer.register_channel(
            "/good", "cdr", writer.register_schema("std_msgs/msg/Float64", "ros2msg", text.encode())
        )
        other = writer.register_channel("/other", "json", writer.register_schema("thing", "jsonschema", b"{}"))
        for k in range(4):
            writer.add_message(other, k, b"{}", k)
            writer.add_message(good, k, b"\0\1\0\0" + struct.pack("<d", 0.5 * k), k)
        writer.finish()
    with open_recording([path]) as recording:
        assert [each.value.data for each in recording.messages()] == [0.5 * k for k in range(4)]
        assert set(recording.topics) == {"/good"}
        assert recording.notes == (
            "a.mcap: messages of /other are in json encoding; expected CDR with one, as ROS 2 records: left out",
        )
