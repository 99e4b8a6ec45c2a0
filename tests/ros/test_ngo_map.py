"""ngo_map as a real process: fed over DDS with relative poses and trajectories, and in the graph of the 2D world."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from map_msgs.msg import OccupancyGridUpdate
from nav2_msgs.srv import SaveMap
from nav_msgs.msg import OccupancyGrid
from ngo_msgs.msg import RelativePose, Trajectory
from ngo_msgs.srv import LoadState, SaveState
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose, transformed
from ngo_estimator.mapping.occupancy_grid import OccupancyMap
from ngo_estimator.mapping.scan_map import ScanMap, ScanMapConfig
from ngo_estimator.mapping.scan_source import KeyScans
from ngo_estimator.nodes.messages import relative_pose_message, relative_step, to_ns
from ngo_sim.maze2d import Maze2D
from tests.unit.ngo_estimator.mapping.test_map_files import read_by_nav2
from tests.unit.ngo_estimator.ray_casting import MAX_RANGE, ROOM, cast, fan

from .processes import NodeProcess, Probe

pytestmark = pytest.mark.processes

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)
STEP_NS, BEGIN_NS = 100_000_000, 50_000_000_000
MAX_RANGE_M = 1.0
LIDAR = {"world": "scan", "map_update_interval": 0.05, "max_range": MAX_RANGE_M}
ANGLES = fan(181, 270.0)


def poses(frames: int, bend: float = 0.0) -> np.ndarray:
    """A drive in the room, from the origin of the map; its first frame is at (1, 1) in the room."""
    yaw = (0.03 + bend) * np.arange(frames)
    return np.column_stack((np.cumsum(0.1 * np.cos(yaw)), np.cumsum(0.1 * np.sin(yaw)), yaw)) - [0.1, 0.0, 0.0]


CORRECTED = poses(30, 0.01) + [0.3, -0.2, 0.0]  # Every pose has moved by more than a cell.


def key_scan(frame: int) -> KeyScan:
    sensor = np.array([0.1, 0.0, 0.0])
    room = compose(np.array([1.0, 1.0, 0.0]), poses(frame + 1)[frame])
    ranges = cast(ROOM, compose(room, sensor), ANGLES)
    nothing = np.zeros((0, 2))
    return KeyScan(BEGIN_NS + frame * STEP_NS, nothing, nothing, sensor, ANGLES, ranges, MAX_RANGE)


def relative_pose(frame: int) -> RelativePose:
    """The step to a frame, from 1; all end at key scans."""
    before, here = poses(frame + 1)[-2:]
    covariance = 1e-4 * np.eye(3)
    key = KeyScanStep(key_scan(frame), BEGIN_NS + (frame - 1) * STEP_NS, between(before, here), covariance)
    step = RelativeStep(
        stamp_ns=BEGIN_NS + frame * STEP_NS,
        from_stamp_ns=BEGIN_NS + (frame - 1) * STEP_NS,
        relative_xyyaw=between(before, here),
        covariance=covariance,
        origin_stamp_ns=BEGIN_NS,
        odom_xyyaw=here,
        motion_feature=np.zeros(0, np.float32),
        place_code=np.zeros(0, np.float32),
        key=key,
        origin_scan=key_scan(0) if frame == 1 else None,
    )
    return relative_pose_message(step, "base_link")


def trajectory(path: np.ndarray, frame_id: str = "map") -> Trajectory:
    stamps = BEGIN_NS + STEP_NS * np.arange(len(path))
    x, y, yaw = path.T.tolist()
    message = Trajectory(stamps_ns=stamps.tolist(), x=x, y=y, yaw=yaw, moved=[0.0] * len(path))
    message.header.frame_id = frame_id
    return message


def expected(frames: int, path: np.ndarray) -> OccupancyMap:
    """The map that is to be published."""
    return percentages(frames, path).trinary(0.25, 0.65)


def percentages(frames: int, path: np.ndarray) -> OccupancyMap:
    """The map of the core, fed with the same messages."""
    core, source = ScanMap(ScanMapConfig()), KeyScans(MAX_RANGE_M)
    for frame in range(1, frames):
        step = relative_step(relative_pose(frame))
        core.take(step, source.scans(step))
    core.update(BEGIN_NS + STEP_NS * np.arange(len(path)), path)
    return core.cells()


def is_map(message: OccupancyGrid, wanted: OccupancyMap) -> bool:
    info, origin = message.info, message.info.origin.position
    same_place = np.allclose([origin.x, origin.y], wanted.origin_xy) and abs(info.resolution - 0.05) < 1e-6
    values = np.array(message.data, np.int8).reshape(info.height, info.width)
    return bool(same_place and np.array_equal(values, wanted.values))


class Mapper:
    """A running ngo_map of a lidar, and the ends of its topics."""

    def __init__(self, process: NodeProcess, probe: Probe, namespace: str) -> None:
        self.process, self.probe = process, probe
        self.steps = probe.node.create_publisher(RelativePose, f"{namespace}/relative_pose", 2000)
        self.trajectories = probe.node.create_publisher(Trajectory, f"{namespace}/ngo/trajectory", 10)
        self.maps: list[OccupancyGrid] = probe.collect(OccupancyGrid, f"{namespace}/map", LATCHED)
        ends = (self.steps, self.trajectories)
        probe.spin_until(lambda: all(end.get_subscription_count() == 1 for end in ends), "ngo_map's subscriptions")

    def drive(self, first: int, frames: int, path: np.ndarray) -> None:
        for frame in range(first, frames):
            self.steps.publish(relative_pose(frame))
        self.trajectories.publish(trajectory(path))

    def wait_for_map(self, wanted: OccupancyMap) -> OccupancyGrid:
        self.probe.spin_until(lambda: self.maps and is_map(self.maps[-1], wanted), "the map of the core")
        return self.maps[-1]

    def save(self, **request: Any) -> bool:
        return bool(self.probe.call(SaveMap, "ngo_map/save_map", SaveMap.Request(**request)).result)


@contextmanager
def running(namespace: str = "", **parameters: Any) -> Iterator[Mapper]:
    arguments = ("-r", f"__ns:={namespace}") if namespace else ()
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_map", LIDAR | parameters, arguments) as process:
        process.wait_for_log("ready: ")
        yield Mapper(process, probe, namespace)


@pytest.fixture(scope="module")
def mapper(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mapper]:
    with running(save_directory=str(tmp_path_factory.getbasetemp()), diagnostics_period_s=0.2) as mapper:
        mapper.drive(1, 30, poses(30))
        mapper.wait_for_map(expected(30, poses(30)))
        yield mapper


def test_the_map_is_that_of_the_core_and_follows_the_trajectory(mapper: Mapper) -> None:
    for path in (CORRECTED, poses(30)):
        mapper.trajectories.publish(trajectory(path))
        message = mapper.wait_for_map(expected(30, path))
    assert message.header.frame_id == "map"
    assert to_ns(message.header.stamp) == BEGIN_NS + 29 * STEP_NS
    assert set(np.unique(message.data).tolist()) == {-1, 0, 100}


def test_a_subscriber_that_comes_later_gets_the_map(mapper: Mapper) -> None:
    with Probe("late") as late:
        maps = late.collect(OccupancyGrid, "map", LATCHED)
        late.spin_until(lambda: maps, "the latched map")
        assert is_map(maps[0], expected(30, poses(30)))


def test_small_changes_are_sent_as_updates_where_everybody_takes_them(mapper: Mapper) -> None:
    """A few poses that move change a part; the whole goes out again for one who takes no updates."""
    updates: list[OccupancyGridUpdate] = []
    taking = mapper.probe.node.create_subscription(OccupancyGridUpdate, "map_updates", updates.append, 10)
    mapper.probe.meet("ngo_map")
    moved = poses(30)
    moved[-3:, :2] += 0.3
    mapper.maps.clear()
    mapper.trajectories.publish(trajectory(moved))
    mapper.probe.spin_until(lambda: updates or mapper.maps, "a change of the map")
    assert updates and not mapper.maps, "the whole map was sent for a small change"
    before, after = expected(30, poses(30)), expected(30, moved)
    patched, part = before.values.copy(), updates[-1]
    rows, columns = slice(part.y, part.y + part.height), slice(part.x, part.x + part.width)
    patched[rows, columns] = np.array(part.data, np.int8).reshape(part.height, part.width)
    np.testing.assert_array_equal(patched, after.values)
    with Probe("plain") as plain:
        maps = plain.collect(OccupancyGrid, "map", LATCHED)
        plain.spin_until(lambda: maps and is_map(maps[-1], after), "the whole map, for a new subscriber")
        mapper.trajectories.publish(trajectory(poses(30)))
        plain.spin_until(lambda: is_map(maps[-1], before), "the whole map, for one who takes no updates")
    mapper.probe.node.destroy_subscription(taking)


def test_nav2_reads_the_files_of_save_map(mapper: Mapper, tmp_path: Path) -> None:
    mapper.wait_for_map(expected(30, poses(30)))
    for image_format in ("", "png"):
        assert mapper.save(map_topic="map", map_url=str(tmp_path / "room"), image_format=image_format)
        cells, facts = read_by_nav2(tmp_path / "room.yaml")
        known = percentages(30, poses(30)).cropped().trinary(0.25, 0.65)
        assert facts["image"] == f"room.{image_format or 'pgm'}"
        assert (facts["free_thresh"], facts["occupied_thresh"]) == (0.25, 0.65)
        np.testing.assert_array_equal(cells, known.values)
        np.testing.assert_allclose(facts["origin"][:2], known.origin_xy)


@pytest.mark.parametrize(
    ("request_", "complaint"),
    [
        ({"map_url": "nowhere/room"}, "there is no folder '"),
        ({"map_url": "/nowhere/room"}, "path is '/nowhere/room.pgm'; expected a file in"),
        ({"map_url": "../room"}, "path is '../room.pgm'; expected a file in"),
        ({"map_url": "room", "map_mode": "fancy"}, "map mode is 'fancy'; expected trinary, scale or raw"),
        ({"map_url": "room", "image_format": "gif"}, "image format is 'gif'; expected pgm or png"),
        ({"map_url": "room", "free_thresh": 0.9}, "thresholds of free and occupied are 0.9 and 0.65; expected"),
        ({"map_url": "room", "map_topic": "other"}, "map_topic is 'other'; expected '/map', or nothing"),
        ({}, "map_url is empty; expected the path of the files, without an ending"),
    ],
)
def test_what_cannot_be_saved_is_said_in_one_line(mapper: Mapper, request_: dict[str, Any], complaint: str) -> None:
    before = len(mapper.process.lines)
    assert not mapper.save(**request_)
    mapper.process.wait_for_log(f"save_map: {complaint}")
    assert len(mapper.process.lines) == before + 1


def test_a_saved_map_is_there_again_after_a_restart(mapper: Mapper, tmp_path: Path) -> None:
    mapper.wait_for_map(expected(30, poses(30)))
    for name, said in ((str(tmp_path / "scans"), "wrote "), ("../scans", "path is '../scans'; expected a folder in")):
        answer = mapper.probe.call(SaveState, "ngo_map/save_state", SaveState.Request(path=name))
        assert answer.success == (said == "wrote ") and answer.message.startswith(said)
    with running("/again", state=str(tmp_path / "scans")) as again:
        again.process.wait_for_log("they wait for their trajectory")
        again.trajectories.publish(trajectory(CORRECTED))
        again.wait_for_map(expected(30, CORRECTED))
    with NodeProcess(
        "ngo_estimator", "ngo_map", {**LIDAR, "max_range": 2.0, "state": str(tmp_path / "scans")}
    ) as other:
        assert other.wait() == 2
        assert len(other.lines) == 1 and "was saved with max_range 1.0; here it is 2.0" in other.log


def test_a_saved_map_is_loaded_where_the_node_runs_already(mapper: Mapper, tmp_path: Path) -> None:
    mapper.wait_for_map(expected(30, poses(30)))
    folder = tmp_path / "scans"
    assert mapper.probe.call(SaveState, "ngo_map/save_state", SaveState.Request(path=str(folder))).success
    mapper.drive(1, 10, poses(10))
    mapper.process.wait_for_log("the trajectory began anew, and so does the map")
    for path, said in ((tmp_path / "nothing", "cannot be read (No such file or directory)"), (folder, "loaded ")):
        answer = mapper.probe.call(LoadState, "ngo_map/load_state", LoadState.Request(path=str(path)))
        assert answer.success == (path == folder) and said in answer.message
    mapper.trajectories.publish(trajectory(CORRECTED))
    mapper.wait_for_map(expected(30, CORRECTED))


def test_bad_messages_are_dropped_with_a_reason(mapper: Mapper) -> None:
    mapper.trajectories.publish(trajectory(poses(30), frame_id="odom"))
    mapper.process.wait_for_log("dropped trajectory: it is in the frame 'odom'; expected 'map'")
    bad = relative_pose(20)
    bad.key_scan[0].angles = bad.key_scan[0].angles[:-1]
    mapper.steps.publish(bad)
    mapper.process.wait_for_log("dropped relative pose: angles, ranges and sensor_xyyaw have shapes")
    for moved in (poses(30), CORRECTED, poses(30)):  # a map that stays the same is not published again
        mapper.trajectories.publish(trajectory(moved))
        mapper.wait_for_map(expected(30, moved))


def test_a_bad_start_ends_with_one_line() -> None:
    with NodeProcess("ngo_estimator", "ngo_map", {"world": "scan", "weights": "/nowhere"}) as process:
        assert process.wait() == 2
        assert len(process.lines) == 1 and "weights: there is no folder '/nowhere'" in process.log


def test_the_map_of_a_maze_shows_its_walls() -> None:
    """All nodes together: most of what the map calls free is a corridor, and its walls are where the maze has them."""
    maze = Maze2D()
    _, start = maze.reset(seed=2000)
    estimators = {"world": "maze2d", "image_reliability": "reliable", "image_depth": 100}
    away_from_others = ("-r", "__ns:=/maze")
    with (
        Probe() as probe,
        NodeProcess(
            "ngo_estimator", "ngo_map", {"world": "maze2d", "map_update_interval": 0.1}, away_from_others
        ) as mapper,
        NodeProcess("ngo_estimator", "ngo_node", {"world": "maze2d"}, away_from_others) as ngo,
        NodeProcess("ngo_estimator", "local_node", estimators, away_from_others) as local,
    ):
        for process in (mapper, ngo, local):
            process.wait_for_log("ready: ")
        maps = probe.collect(OccupancyGrid, "/maze/map", LATCHED)
        simulator = {"seed": 2000, "frames": 100, "rate": 0.0, "wait_for_flow_control": True}
        with NodeProcess("ngo_sim", "maze2d", {**simulator, "wait_for_subscribers": 1}, away_from_others):
            # Of the 100 frames, from 1.0 s to 10.9 s; the last may show nothing new.
            late_ns = 10_000_000_000
            probe.spin_until(lambda: maps and to_ns(maps[-1].header.stamp) >= late_ns, "the map of the frames")
    info, first = maps[-1].info, start["pose_xyyaw"]
    values = np.array(maps[-1].data, np.int8).reshape(info.height, info.width)
    rows, columns = np.nonzero(values >= 0)
    centres = np.column_stack((columns, rows)) + 0.5
    in_map = centres * info.resolution + [info.origin.position.x, info.origin.position.y]
    in_maze = transformed(first, in_map)
    blocks = np.floor(in_maze / maze.maze.block_m).astype(int)
    away = np.abs(in_maze / maze.maze.block_m - np.rint(in_maze / maze.maze.block_m)).min(axis=1) * maze.maze.block_m
    free = values[rows, columns] == 0
    assert free.sum() > 2000 and (~free).sum() > 200
    inside = away[free] > 0.05  # of a block, and not at its border
    assert not maze.maze.walls[blocks[free, 1], blocks[free, 0]][inside].any()
    assert (away[~free] < 0.05).mean() > 0.99, "walls begin at the borders of blocks"
