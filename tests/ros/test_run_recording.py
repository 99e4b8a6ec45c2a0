"""`ros2 run ngo_estimator run_recording`: the results of the live nodes fed the same messages, and what it leaves."""

import json
import os
import shutil
import subprocess
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction, Trajectory
from rich.console import Console
from sensor_msgs.msg import Image

from demo.graph import NodeSpec
from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.data.relative_step import RESTART_AFTER_NS
from ngo_estimator.nodes.messages import to_ns
from ngo_estimator.nodes.run_recording import Arguments
from ngo_estimator.nodes.run_recording import run as run_in_process
from ngo_estimator.trajectory.files import read_tum
from ngo_estimator.trajectory.report import trajectory_report
from ngo_recordings.frames import UNUSABLE
from ngo_recordings.recording import open_recording
from ngo_recordings.topics import TopicArguments
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.maze2d import Maze2D
from ngo_sim.maze3d import Maze3D
from tests.unit.ngo_recordings import messages as make

from .processes import NodeProcess, Probe, run_forked

pytestmark = pytest.mark.processes

START_NS = 1_700_000_000_000_000_000
WARM_UP_NS = START_NS + 10**15  # later than all that is played: going back begins anew
SEED = 1000
ROUNDING = 2e-5
"""Networks run over several frames at once round otherwise than over one, in single precision (m, rad)."""
PLAY_AGAIN_S = 0.3
AHEAD = 8
"""Frames that the nodes may be behind: images that run far ahead of their actions would be given up."""


def run_recording(*arguments: object) -> subprocess.CompletedProcess[str]:
    (program, *_) = NodeSpec("ngo_estimator", "run_recording").command()
    return run_forked([program, *map(str, arguments)], 170.0, {**os.environ, "COLUMNS": "200"})


def episode_entries(world: str, episode: Episode, start_ns: int, log_ns: int) -> list[make.Entry]:
    """The messages of an episode: image and truth at each frame, and then the action that was taken there."""
    period_ns = round(episode.period_s * 1e9)
    entries: list[make.Entry] = []
    for k, (seen, (x, y, yaw)) in enumerate(zip(episode.observations, episode.poses_xyyaw, strict=True)):
        stamp_ns, at_ns = start_ns + k * period_ns, log_ns + k * period_ns
        pixels = seen.reshape(1, *seen.shape) if world == "maze2d" else seen
        encoding = "32FC4" if world == "maze2d" else "rgb8"
        entries.append(("/image", at_ns, make.image(stamp_ns, pixels, encoding)))
        entries.append(("/ground_truth", at_ns, make.odometry(stamp_ns, make.pose(x, y, yaw), make.twist(0, 0, 0))))
        if k < len(episode.actions):
            entries.append(("/action", at_ns + 1, make.action(stamp_ns, int(episode.actions[k]))))
    return entries


def drive(world: str, frames: int, seed: int = SEED) -> Episode:
    simulator = Maze3D() if world == "maze3d" else Maze2D()
    try:
        return record_episode(simulator, "random_goals" if world == "maze3d" else "corners", frames, seed)
    finally:
        simulator.close()


def faulty_entries() -> list[make.Entry]:
    """A drive with lost, repeated, late and broken images and lost actions, and another after a jump back in time."""
    first, second = drive("maze2d", 60), drive("maze2d", 40, SEED + 1)
    entries = episode_entries("maze2d", first, START_NS, 10**18)
    images = [entry for entry in entries if entry[0] == "/image"]
    actions = [entry for entry in entries if entry[0] == "/action"]
    lost = [images[8], images[20], images[21], images[35], images[50], actions[30], actions[40], actions[41]]
    entries = [entry for entry in entries if not any(entry is one for one in lost)]
    topic, log_ns, late = images[21]
    entries.append((topic, log_ns + 250_000_000, late))
    entries.append((topic, log_ns + 650_000_000, images[27][2]))
    broken = first.observations[50].copy()
    broken[7, 0] = np.nan
    entries.append((topic, images[50][1], make.image(header_ns(images[50][2]), broken[None], "32FC4")))
    topic, log_ns, whole = images[35]
    entries.append((topic, log_ns, replace(whole, data=whole.data[:100])))
    entries.sort(key=lambda entry: entry[1])
    return entries + episode_entries("maze2d", second, START_NS - 10**13, 10**18 + 10**11)


@dataclass
class Live:
    """What the live nodes published."""

    odometry: list[Odometry] = field(default_factory=list)
    poses: list[PoseWithCovarianceStamped] = field(default_factory=list)
    trajectories: list[Trajectory] = field(default_factory=list)


class LiveNodes:
    """Both estimators as processes, and a probe that plays messages to them."""

    def __init__(self, world: str) -> None:
        sensor = {"image_reliability": "reliable", "image_depth": 1000}
        self._processes = [
            NodeProcess("ngo_estimator", "ngo_node", {"world": world, "path_rate_hz": 0.0}),
            NodeProcess("ngo_estimator", "local_node", {"world": world, **sensor}),
        ]
        self._probe = Probe()
        self.out = Live(
            self._probe.collect(Odometry, "odom"),
            self._probe.collect(PoseWithCovarianceStamped, "ngo/pose"),
            self._probe.collect(Trajectory, "ngo/trajectory"),
        )
        topics: dict[str, type] = {"/image": Image, "/action": DiscreteAction}
        self._publishers = {name: self._probe.node.create_publisher(kind, name, 1000) for name, kind in topics.items()}

    def close(self) -> None:
        self._probe.close()
        for process in self._processes:
            process.__exit__(None, None, None)

    def warm_up(self, entries: list[make.Entry]) -> None:
        """Play the first frames, always later in time, until all answers come: then everybody is connected."""
        first = [entry for entry in entries if entry[0] in self._publishers][:5]
        begin_ns = header_ns(first[0][2])
        turn, sent_s = 0, 0.0
        listeners = self._publishers.values()
        self._probe.spin_until(lambda: all(one.get_subscription_count() for one in listeners), "subscribers")
        self._probe.meet("local_node", "ngo_node")

        def answered() -> bool:
            nonlocal turn, sent_s
            if time.monotonic() - sent_s > PLAY_AGAIN_S:
                turn, sent_s = turn + 1, time.monotonic()
                for topic, _, message in first:
                    self._send(topic, shifted(message, WARM_UP_NS + turn * 10**9 + header_ns(message) - begin_ns))
            return all((self.out.odometry, self.out.poses, self.out.trajectories))

        self._probe.spin_until(answered, "the first answers")

    def play(self, entries: list[make.Entry]) -> Live:
        """What they publish about these messages."""
        stamps_ns: list[int] = []  # of the frames that were sent
        for topic, _, message in entries:
            if topic not in self._publishers:
                continue
            stamp_ns = header_ns(message)
            if topic != "/action":
                if stamps_ns and stamp_ns < max(stamps_ns) - RESTART_AFTER_NS:
                    # A node that is behind would give up the frames that wait for their actions.
                    self._wait_for_answers(max(stamps_ns))
                    stamps_ns = []
                stamps_ns.append(stamp_ns)
            self._send(topic, message)
            if len(stamps_ns) > AHEAD:
                self._wait_for_odometry(stamps_ns[-AHEAD], max(stamps_ns))
        newest_ns = max(stamps_ns)
        self._wait_for_answers(newest_ns)
        # Without the answers to the first frames that were played to connect.
        kept = ([m for m in messages if to_ns(m.header.stamp) < WARM_UP_NS] for messages in vars(self.out).values())
        return Live(*kept)

    def _wait_for_odometry(self, first_ns: int, last_ns: int) -> None:
        def there() -> bool:
            return bool(self.out.odometry) and first_ns <= to_ns(self.out.odometry[-1].header.stamp) <= last_ns

        self._probe.spin_until(there, f"the odometry of the frame at {first_ns} ns or of one after it")

    def _wait_for_answers(self, stamp_ns: int) -> None:
        def there() -> bool:
            newest = [messages[-1] for messages in vars(self.out).values() if messages]
            return len(newest) == 3 and all(to_ns(message.header.stamp) == stamp_ns for message in newest)

        self._probe.spin_until(there, f"the answers to the frame at {stamp_ns} ns")

    def _send(self, topic: str, message: Any) -> None:
        self._publishers[topic].publish(make.serialised(message))


def header_ns(message: Any) -> int:
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def shifted(message: Any, stamp_ns: int) -> Any:
    return replace(message, header=make.header(stamp_ns))


def recorded_poses(file: Path, topic: str) -> dict[int, tuple[float, ...]]:
    with open_recording([file]) as recording:
        return {header_ns(message.value): numbers(message.value) for message in recording.messages([topic])}


def numbers(message: Any) -> tuple[float, ...]:
    pose = message.pose.pose
    covariance = tuple(float(value) for value in message.pose.covariance)
    return (pose.position.x, pose.position.y, pose.orientation.z, pose.orientation.w, *covariance)


@pytest.mark.parametrize("world", ["maze3d", "faulty"])
def test_equals_the_live_nodes(world: str, tmp_path: Path) -> None:
    name = "maze2d" if world == "faulty" else world
    if world == "faulty":
        entries = faulty_entries()
    else:
        # After 103 steps no optimisation is under way, whose end the live node would wait for.
        entries = episode_entries(world, drive(world, 104), START_NS, START_NS)
    recording = make.write_mcap(tmp_path / "drive.mcap", entries)
    nodes = LiveNodes(name)
    try:
        nodes.warm_up(entries)
        live = nodes.play(entries)
    finally:
        nodes.close()
    done = run_recording(recording, "--world", name, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stdout + done.stderr
    parts = [tmp_path / "out", *([tmp_path / "out" / "part2"] if world == "faulty" else [])]
    for topic, messages in (("/odom", live.odometry), ("/ngo/pose", live.poses)):
        ours: dict[int, tuple[float, ...]] = {}
        for part in parts:
            ours |= recorded_poses(part / "trajectories.mcap", topic)
        assert [to_ns(message.header.stamp) for message in messages] == list(ours)
        np.testing.assert_allclose([numbers(m) for m in messages], list(ours.values()), rtol=1e-4, atol=ROUNDING)
    path, final = read_tum(parts[-1] / "corrected.tum"), live.trajectories[-1]
    assert path.stamps_ns.tolist() == list(final.stamps_ns)
    np.testing.assert_allclose(path.positions_xyz[:, :2], np.column_stack((final.x, final.y)), atol=ROUNDING)
    if world == "faulty":
        said = json.loads((tmp_path / "out" / "run.json").read_text())
        assert said["frames"] == 60 - 5 + 3 + 40
        expected = {"older than the frame before": 1, "the stamp came twice": 1, "not usable": 1}
        assert said["not_used"] == {**expected, "no action or velocity led to it": 3, UNUSABLE: 1}
        assert [part["folder"] for part in said["trajectories"]] == [".", "part2"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of 80 frames in the 2D world."""
    entries = episode_entries("maze2d", drive("maze2d", 80), START_NS, START_NS)
    return make.write_mcap(tmp_path_factory.mktemp("recording") / "drive.mcap", entries)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    write_untrained(folder, "maze2d")
    return folder


def flat(report: dict[str, Any]) -> dict[str, Any]:
    """The leaves of a report, by their places."""
    leaves: dict[str, Any] = {}
    for key, value in report.items():
        inner = flat(value) if isinstance(value, dict) else {"": value}
        leaves |= {f"{key}/{place}": leaf for place, leaf in inner.items()}
    return leaves


RESULTS = {
    "odometry.tum",
    "graph.g2o",
    "online.tum",
    "corrected.tum",
    "truth.tum",
    "trajectories.mcap",
    "plot.png",
    "metrics.json",
    "run.json",
}


def test_two_runs_leave_the_same_bytes(recording: Path, weights: Path, tmp_path: Path) -> None:
    outs = tmp_path / "first", tmp_path / "second"
    done = run_recording(recording, "--weights", weights, "--out", outs[0])
    assert done.returncode == 0, done.stdout + done.stderr
    run_in_process(Arguments((recording,), outs[1], weights=weights), Console(quiet=True))
    assert {path.name for path in outs[0].iterdir()} == RESULTS
    for path in outs[0].iterdir():
        assert path.read_bytes() == (outs[1] / path.name).read_bytes(), path.name
    # What it says about errors is what evaluate.py says about the files.
    metrics = json.loads((outs[0] / "metrics.json").read_text())
    truth = read_tum(outs[0] / "truth.tum")
    for name in ("odometry", "online", "corrected"):
        report = trajectory_report(read_tum(outs[0] / f"{name}.tum"), truth)
        assert flat(metrics[name]) == pytest.approx(flat(report), abs=1e-6)
    assert metrics["truth_residual"] == {"z_m": 0.0, "roll_deg": 0.0, "pitch_deg": 0.0}
    assert "ATE" in done.stdout and "80 frames in" in done.stdout
    with open_recording([outs[0] / "trajectories.mcap"]) as written:
        counts = {name: info.count for name, info in written.topics.items()}
        (path,) = (message.value for message in written.messages(["/ngo/path"]))
    paths = {"/odom/path": 1, "/ngo/path": 1, "/ground_truth/path": 1}
    assert counts == {"/odom": 79, "/ngo/pose": 79, "/tf": 79, **paths}
    corrected = read_tum(outs[0] / "corrected.tum")
    assert [header_ns(pose) for pose in path.poses] == corrected.stamps_ns.tolist()
    np.testing.assert_array_equal([pose.pose.position.x for pose in path.poses], corrected.positions_xyz[:, 0])


def test_what_cannot_be_run_is_said_in_one_line(recording: Path, weights: Path, tmp_path: Path) -> None:
    full, pictures = tmp_path / "full", tmp_path / "pictures.mcap"
    full.mkdir()
    (full / "mine.txt").write_text("kept")
    entries = episode_entries("maze2d", drive("maze2d", 3), START_NS, START_NS)
    grey = np.zeros((48, 64, 1), np.uint8)
    make.write_mcap(
        pictures,
        [
            (topic, log_ns, make.image(header_ns(message), grey, "mono8") if topic == "/image" else message)
            for topic, log_ns, message in entries
        ],
    )
    for files, changes, message in (
        ((tmp_path / "nowhere.mcap",), {}, "there is no file .*nowhere.mcap"),
        ((recording,), {"weights": tmp_path}, "local_pose_network"),
        ((recording,), {"weights": None, "world": "mars"}, "no folder of weights .*mars; worlds: .*maze2d, maze3d"),
        ((recording,), {"topics": TopicArguments(image="/camera")}, "there is no topic /camera"),
        ((recording,), {"topics": TopicArguments(action="none")}, "need the action of each step"),
        ((pictures,), {}, "no two frames of /image could be used: 3 not usable, first .* 64 x 48"),
        ((recording,), {"world": "maze2d"}, "either --world .* or --weights FOLDER"),
        ((recording,), {"window_frames": 3}, "window_frames is 3"),
        ((), {}, "no recording was given"),
    ):
        arguments = replace(Arguments(files, tmp_path / "out", weights=weights), **changes)  # type: ignore[arg-type]
        with pytest.raises(ValueError, match=message) as caught:
            run_in_process(arguments, Console(quiet=True))
        assert "\n" not in str(caught.value)
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
    done = run_recording(recording, "--weights", weights, "--out", full)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr
    assert done.stderr.startswith(f"run_recording: {full} is not empty; give a new folder")
    assert [path.name for path in full.iterdir()] == ["mine.txt"]


def test_old_results_are_replaced_as_a_whole(recording: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "part2").mkdir(parents=True)
    for path in (out / "metrics.json", out / "part2" / "corrected.tum", out / "mine.txt"):
        path.write_text("old")
    arguments = Arguments(
        (recording,), out, weights=weights, topics=TopicArguments(ground_truth="none"), overwrite=True
    )
    run_in_process(arguments, Console(quiet=True))
    assert {path.name for path in out.iterdir()} == (RESULTS - {"metrics.json", "truth.tum"}) | {"part2", "mine.txt"}
    assert not list((out / "part2").iterdir())


def test_a_run_that_fails_leaves_earlier_results_and_no_others(
    recording: Path, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    arguments = Arguments((recording,), out, weights=weights, overwrite=True)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ngo_estimator.nodes.recorded_output.save_plot", full)
    with pytest.raises(OSError, match="No space left"):
        run_in_process(arguments, Console(quiet=True))
    assert not out.exists()
    out.mkdir()
    (out / "corrected.tum").write_text("old")
    with pytest.raises(OSError, match="No space left"):
        run_in_process(arguments, Console(quiet=True))
    assert [path.name for path in out.iterdir()] == ["corrected.tum"]
    assert (out / "corrected.tum").read_text() == "old"
