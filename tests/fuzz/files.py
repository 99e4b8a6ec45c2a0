"""Files that users give: mutants of good ones must be read, or refused with one line."""

import random
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rclpy
from rclpy.context import Context
from rclpy.logging import LoggingSeverity, set_logger_level

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.settings import BadParameter
from ngo_estimator.checkpoint import load_local, load_optimizer, load_place, write_untrained
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.graph.robust import Robust
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.trajectory.chained_graph import chained
from ngo_estimator.trajectory.files import read_tum, write_tum
from ngo_estimator.trajectory.g2o import read_g2o, write_g2o
from ngo_recordings.frames import frames
from ngo_recordings.poses import read_tum as read_track
from ngo_recordings.recording import open_recording
from ngo_recordings.topics import TopicArguments, choose_topics
from ngo_sim.doom_engine import SHIPPED
from ngo_sim.doom_level import load_level
from tests.fuzz.mutants import mutant
from tests.fuzz.outcomes import Outcomes
from tests.unit.ngo_recordings import messages as m
from tests.unit.ngo_recordings import test_carmen_log as carmen
from tests.unit.ngo_recordings.test_ros1_bag import write_bag

WEIGHTS = Path(__file__).parents[2] / "ros_ws/src/ngo_estimator/weights"
_CLEAN = (ValueError, OSError)


@dataclass(frozen=True)
class Target:
    """Good files to spoil, and what reads them; a mutant takes the place of its original."""

    originals: Callable[[Path], list[Path]]
    read: Callable[[Path], None]


def run(name: str, count: int, rng: random.Random, folder: Path) -> Outcomes:
    """Read so many mutants of the files of a target."""
    target, outcomes = TARGETS[name], Outcomes()
    originals = target.originals(folder)
    contents = [path.read_bytes() for path in originals]
    for path in originals:
        target.read(path)  # a good one is read
    for _ in range(count):
        which = rng.randrange(len(originals))
        path = originals[which]
        path.write_bytes(mutant(contents[which], rng))
        outcomes.add(name, lambda path=path: target.read(path), _CLEAN)  # type: ignore[misc]
        path.write_bytes(contents[which])
    return outcomes


def _recordings(folder: Path) -> list[Path]:
    rng, entries = np.random.default_rng(0), []
    for k in range(4):
        stamp, at = 10**9 + k * 10**8, m.pose(0.1 * k, 0.0, 0.0)
        pixels = rng.integers(0, 256, (4, 8, 3), np.uint8)
        entries.append(("/image", stamp, m.image(stamp, pixels)))
        entries.append(("/camera/compressed", stamp, m.compressed(stamp, pixels, "png")))
        entries.append(("/scan", stamp, m.scan(stamp, rng.uniform(1.0, 5.0, 9).astype(np.float32))))
        entries.append(("/odom", stamp, m.odometry(stamp, at, m.twist(0.1, 0.0, 0.0))))
        entries.append(("/tf", stamp, m.transforms(m.transform(stamp, "odom", "base_link", at))))
    bag = write_bag(folder / "a.bag", 6)
    lines = [carmen.flaser(k, (0.1 * k, 0.0, 0.0)) for k in range(4)]
    database = m.write_rosbag(folder / "folder", entries)
    return [
        m.write_mcap(folder / "a.mcap", entries),
        m.write_mcap(folder / "b.mcap", entries, chunk_bytes=500),
        bag,
        carmen.write(folder / "a.log", lines),
        carmen.write(folder / "a.log.gz", lines),
        database / "metadata.yaml",
        next(database.glob("*.db3")),
    ]


def _read_recording(path: Path) -> None:
    opened = path.parent if path.parent.name == "folder" else path
    for image in ("/image", "/camera/compressed", "/scan"):
        with open_recording([opened]) as recording:
            for _ in recording.messages():
                pass
            if image in recording.topics:
                for _ in frames(recording, choose_topics(recording, TopicArguments(image=image))):
                    pass


def _checkpoints(folder: Path) -> list[Path]:
    write_untrained(folder / "weights", "maze2d")
    return sorted((folder / "weights").iterdir())


def _read_checkpoint(path: Path) -> None:
    for load in (load_local, load_place, load_optimizer):
        load(path.parent)


def _lidar_files(folder: Path) -> list[Path]:
    shutil.copytree(WEIGHTS / "scan", folder / "scan")
    return sorted(path for path in (folder / "scan").iterdir() if path.is_file())


def _read_lidar(path: Path) -> None:
    MixtureLidar.load(path.parent, "scan")
    ScanTrajectory.load(path.parent, "scan", 1)


def _wads(folder: Path) -> list[Path]:
    names = ("my_way_home.wad", "basic.wad", "health_gathering.wad")
    return [Path(shutil.copy(SHIPPED / "scenarios" / name, folder)) for name in names]


def _read_wad(path: Path) -> None:
    load_level(str(path), "MAP01")


def _tum_files(folder: Path) -> list[Path]:
    rng = np.random.default_rng(0)
    write_tum(folder / "a.tum", np.arange(1, 9) * 10**8, rng.normal(size=(8, 3)))
    return [folder / "a.tum"]


def _read_tum(path: Path) -> None:
    read_tum(path)
    read_track(path, 10**9)


def _graph_files(folder: Path) -> list[Path]:
    """A square drive, with marks on its loops and stamps."""
    turn = "10 1 0 10 0 40"
    vertices = [f"VERTEX_SE2 {2 * k} {k} 0.5 {0.1 * k} # stamp {k}.5" for k in range(8)]
    edges = [f"EDGE_SE2 {2 * k} {2 * k + 2} 1 0 0.1 {turn}" for k in range(7)]
    loops = [f"EDGE_SE2 {2 * k} 0 {-k} 0 -0.5 {turn} # loop 0.5" for k in (3, 5, 7)]
    (folder / "a.g2o").write_text("\n".join((*vertices, "FIX 0", *edges, *loops)) + "\n")
    return [folder / "a.g2o"]


def _read_graph(path: Path) -> None:
    """Read, correct and write it."""
    graph = chained(read_g2o(path))
    with suppress(ArithmeticError):  # as the command says it
        write_g2o(path.with_name("out.g2o"), graph.corrected(Robust().correct(graph.problem)))


def _parameter_files(folder: Path) -> list[Path]:
    (folder / "a.yaml").write_text(
        "/**:\n  ros__parameters:\n    world: maze2d\n    window_frames: 500\n    path_rate_hz: 5.0\n"
        "    initial_pose: [0.0, 1.0, 2.0]\n    publish_tf: true\n    map_frame: map\n"
    )
    return [folder / "a.yaml"]


@contextmanager
def _node_context(path: Path) -> Iterator[Context]:
    context = Context()
    set_logger_level("rcl", LoggingSeverity.FATAL)  # as run_node does: rcl would say the same on a line of its own
    try:
        rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    except RuntimeError as error:  # what run_node turns into its one line
        raise ValueError(" ".join(str(error).split())) from None
    try:
        yield context
    finally:
        rclpy.try_shutdown(context=context)


def _read_parameters(path: Path) -> None:
    with _node_context(path) as context:
        node = rclpy.create_node("ngo_node", context=context, start_parameter_services=False, enable_rosout=False)
        try:
            LiveSettings(node, NgoNodeSettings)
        except BadParameter as error:
            raise ValueError(" ".join(str(error).split())) from None  # as run_node prints it
        finally:
            node.destroy_node()


TARGETS = {
    "recordings": Target(_recordings, _read_recording),
    "checkpoints": Target(_checkpoints, _read_checkpoint),
    "lidar settings": Target(_lidar_files, _read_lidar),
    "WADs": Target(_wads, _read_wad),
    "TUM files": Target(_tum_files, _read_tum),
    "graph files": Target(_graph_files, _read_graph),
    "parameter files": Target(_parameter_files, _read_parameters),
}
