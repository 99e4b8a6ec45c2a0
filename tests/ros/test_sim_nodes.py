"""The simulator nodes as real processes over DDS."""

import math
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction
from rcl_interfaces.srv import DescribeParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, LaserScan
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes.messages import to_ns
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.maze2d import Maze2D
from ngo_sim.maze3d import Maze3D

from .processes import NodeProcess, Probe, end, wait_until
from .readings import stamps_ns, xyyaw

pytestmark = pytest.mark.processes

SEED = 7
FRAMES = 25


def simulator(world: str, *ros_arguments: str, **parameters: Any) -> NodeProcess:
    return NodeProcess("ngo_sim", world, parameters, ros_arguments)


def pixels(messages: list[Image], dtype: type, *shape: int) -> np.ndarray:
    return np.array([np.frombuffer(message.data, dtype).reshape(shape) for message in messages])


class Run:
    """What one simulator published until it ended by itself."""

    def __init__(self, probe: Probe, world: str, sensor_type: type, sensor: str, **parameters: Any) -> None:
        self.actions = probe.collect(DiscreteAction, "action")
        self.truth = probe.collect(Odometry, "ground_truth")
        self.clock = probe.collect(Clock, "/clock")
        self.sensor = probe.collect(sensor_type, sensor)
        self.images = probe.collect(Image, "image")  # last: the simulator waits for this one
        with simulator(
            world, seed=SEED, frames=FRAMES, rate=0, wait_for_subscribers=1, publish_clock=True, **parameters
        ) as node:
            probe.spin_until(lambda: len(self.images) == FRAMES, "all images")
            self.topics = dict(probe.node.get_topic_names_and_types())
            probe.spin_until(lambda: not node.running, "the simulator's end")
            probe.spin_until(lambda: len(self.sensor) == len(self.truth) == len(self.clock) == FRAMES, "the rest")
            probe.spin_until(lambda: len(self.actions) == FRAMES - 1, "all actions")
            assert node.wait() == 0, node.log

    def check(self, episode: Episode, period_s: float) -> None:
        """Compare with what the core records without ROS."""
        expected = [10**9 + round(frame * period_s * 1e9) for frame in range(FRAMES)]
        assert stamps_ns(self.images) == stamps_ns(self.truth) == stamps_ns(self.sensor) == expected
        assert stamps_ns(self.actions) == expected[:-1]
        assert [to_ns(message.clock) for message in self.clock] == expected
        assert [message.action for message in self.actions] == episode.actions.tolist()
        np.testing.assert_allclose([xyyaw(message) for message in self.truth], episode.poses_xyyaw, atol=1e-12)
        speeds = [math.hypot(m.twist.twist.linear.x, m.twist.twist.linear.y) for m in self.truth]
        steps = np.linalg.norm(np.diff(episode.poses_xyyaw[:, :2], axis=0), axis=1)
        assert speeds[0] == 0.0
        np.testing.assert_allclose(np.array(speeds[1:]) * period_s, steps, rtol=0.02, atol=1e-9)
        assert {m.header.frame_id for m in self.truth} == {"maze"}
        assert {m.child_frame_id for m in self.truth} == {"base_link"}
        assert "/tf" not in self.topics


def test_maze2d_publishes_what_the_core_records(probe: Probe) -> None:
    run = Run(probe, "maze2d", LaserScan, "scan")
    episode = record_episode(Maze2D(), "corners", FRAMES, SEED)
    run.check(episode, 0.1)
    image, scan = run.images[0], run.sensor[0]
    assert (image.height, image.width, image.encoding, image.step) == (1, 241, "32FC4", 241 * 16)
    np.testing.assert_array_equal(pixels(run.images, np.float32, 241, 4), episode.observations)
    np.testing.assert_array_equal([message.ranges for message in run.sensor], episode.observations[:, ::-1, 3])
    assert math.degrees(scan.angle_min) == pytest.approx(-150)
    assert math.degrees(scan.angle_max) == pytest.approx(150)
    assert scan.angle_min + 240 * scan.angle_increment == pytest.approx(scan.angle_max, abs=1e-5)
    assert max(max(message.ranges) for message in run.sensor) < scan.range_max
    assert scan.header.frame_id == image.header.frame_id == "base_link"


def test_maze3d_publishes_what_the_core_records(probe: Probe, latched: QoSProfile) -> None:
    mounted = probe.collect(TFMessage, "/tf_static", latched)
    run = Run(probe, "maze3d", CameraInfo, "camera_info", policy="learned")
    env = Maze3D()
    episode = record_episode(env, "learned", FRAMES, SEED)
    env.close()
    run.check(episode, 2 / 35)
    image, info = run.images[0], run.sensor[0]
    assert (image.height, image.width, image.encoding, image.step) == (60, 80, "rgb8", 240)
    np.testing.assert_array_equal(pixels(run.images, np.uint8, 60, 80, 3), episode.observations)
    assert (info.width, info.height) == (80, 60)
    assert math.degrees(2 * math.atan(40 / info.k[0])) == pytest.approx(108)
    assert (info.k[2], info.k[5]) == (39.5, 29.5)
    assert info.header.frame_id == image.header.frame_id == "camera_optical_frame"
    probe.spin_until(lambda: mounted, "the camera's mounting")
    (transform,) = mounted[0].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "camera_optical_frame")
    q = transform.transform.rotation
    forward = (2 * (q.x * q.z + q.w * q.y), 2 * (q.y * q.z - q.w * q.x), 1 - 2 * (q.x**2 + q.y**2))
    assert forward == (1.0, 0.0, 0.0), "the optical axis z is forward in base_link"
    right = (1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y + q.w * q.z), 2 * (q.x * q.z - q.w * q.y))
    assert right == (0.0, -1.0, 0.0), "x of the picture is right"


def test_none_is_lost_by_a_slow_subscriber(probe: Probe) -> None:
    """A consumer whose queue holds no more than what may be in flight, and that answers late."""
    in_flight = 3
    images = probe.collect(Image, "image", QoSProfile(depth=in_flight + 1))
    answer = probe.node.create_publisher(Odometry, "odom", 10)
    with simulator(
        "maze2d",
        frames=FRAMES,
        rate=0,
        max_in_flight=in_flight,
        wait_for_subscribers=1,
        flow_control_topics=["odom"],
        wait_for_flow_control=True,
    ) as node:
        # Motion has no answer to the first frame, so one more than max_in_flight comes; then nothing until an answer.
        probe.spin_until(lambda: len(images) == in_flight + 1, "the first frames")
        probe.spin_until(lambda: answer.get_subscription_count() == 1, "the simulator to listen")
        for answered in range(1, FRAMES):
            silent_until = time.monotonic() + 0.02
            probe.spin_until(lambda until=silent_until: time.monotonic() > until, "silence")
            assert len(images) == min(answered + in_flight, FRAMES)
            message = Odometry()
            message.header.stamp = images[answered].header.stamp
            answer.publish(message)
            due = min(answered + 1 + in_flight, FRAMES)
            probe.spin_until(lambda due=due: len(images) >= due, f"frame {due}")
        assert node.wait() == 0, node.log
    assert stamps_ns(images) == [10**9 + 10**8 * frame for frame in range(FRAMES)]


def test_without_a_driver_each_command_is_one_step(probe: Probe) -> None:
    actions = probe.collect(DiscreteAction, "action")
    images = probe.collect(Image, "image")  # last: the simulator waits for this one
    command = probe.node.create_publisher(DiscreteAction, "action_command", 10)
    wanted = [0, 1, 2, 2, 1, 0, 0]
    with simulator("maze2d", driver="none", frames=len(wanted) + 1, rate=0, wait_for_subscribers=1) as node:
        probe.spin_until(lambda: len(images) == 1 and command.get_subscription_count() == 1, "the first frame")
        for step, action in enumerate(wanted):
            command.publish(DiscreteAction(action=9))  # is no action, and is dropped
            command.publish(DiscreteAction(action=action))
            probe.spin_until(lambda count=step + 2: len(images) == count, f"frame {step + 1}")
        probe.spin_until(lambda: len(actions) == len(wanted), "all actions")
        assert node.wait() == 0, node.log
        assert "action_command dropped: action is 9; allowed: 0 (forward)" in node.log
    assert [message.action for message in actions] == wanted


def test_parameters_can_be_described_and_changed_only_where_it_makes_sense(probe: Probe) -> None:
    images = probe.collect(Image, "image")
    with simulator("maze2d", rate=0.001, wait_for_subscribers=1):
        described = probe.call(
            DescribeParameters, "maze2d/describe_parameters", DescribeParameters.Request(names=["rate", "rows"])
        ).descriptors
        assert [entry.additional_constraints.endswith("; at any time") for entry in described] == [True, False]
        assert all(entry.description for entry in described)
        assert described[0].floating_point_range[0].to_value == 10_000.0

        def change(name: str, value: Any) -> Any:
            request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()])
            return probe.call(SetParameters, "maze2d/set_parameters", request).results[0]

        assert not change("rate", -1.0).successful
        assert not change("seed", 3).successful
        probe.spin_until(lambda: len(images) == 1, "the first frame; the next is due in 1000 s")
        assert change("rate", 0.0).successful
        probe.spin_until(lambda: len(images) > 100, "many frames")


@pytest.fixture
def latched() -> QoSProfile:
    return QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_bad_parameters_are_one_line_and_exit_code_2(tmp_path: Path) -> None:
    file = tmp_path / "parameters.yaml"
    file.write_text("maze2d:\n  ros__parameters:\n    rowz: 3\n")
    cases: list[tuple[tuple[str, ...], str]] = [
        (("--params-file", str(file)), "parameter 'rowz' is 3, but unknown; did you mean rows?"),
        (("-p", "rows"), "-p rows"),
        (("--", "seed:=3"), "argument 'seed:=3' is unknown; parameters are given as --ros-args -p NAME:=VALUE"),
    ]
    with ExitStack() as stack:  # at once, on all cores
        nodes = [stack.enter_context(simulator("maze2d", *arguments)) for arguments, _ in cases]
        for node, (_, expected) in zip(nodes, cases, strict=True):
            assert node.wait() == 2, node.log
            assert len(node.lines) == 1, node.log
            assert node.lines[0].startswith("[FATAL]") and expected in node.lines[0]


def test_help_lists_the_parameters_and_starts_no_node() -> None:
    with simulator("maze3d", "--", "--help") as node:
        assert node.wait() == 0, node.log
        assert node.lines[0].startswith("usage: ros2 run ngo_sim maze3d ")
        assert any(line.startswith("  frame_prefix:=''  (") for line in node.lines)
        assert "ready" not in node.log


def test_a_start_is_told_in_one_line_and_a_signal_ends_it(probe: Probe) -> None:
    images = probe.collect(Image, "/red/camera")
    before = time.time_ns()
    remapped = ("-r", "__ns:=/red", "-r", "image:=camera")
    settings = {"seed": 3, "rate": 100.0, "use_wall_stamps": True, "wait_for_subscribers": 1}
    with simulator("maze2d", *remapped, **settings) as node:
        probe.spin_until(lambda: len(images) >= 5, "the frames")
        assert len(node.lines) == 1 and "XMLPARSER" not in node.log, node.log
        assert node.lines[0].endswith(
            "ready: /red/maze2d, seed 3, 100 frames a second, publishes /red/action, /red/camera, /red/ground_truth, "
            "/red/scan; waits for 1 subscribers of the image"
        )
        received = stamps_ns(images)
        assert before < received[0] and received == sorted(set(received)) and received[-1] < time.time_ns()
        end(node, by=signal.SIGTERM)


def test_a_killed_maze3d_takes_its_engine_along_and_leaves_no_files(
    probe: Probe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    images = probe.collect(Image, "image")
    with simulator("maze3d", rate=50) as node:
        probe.spin_until(lambda: len(images) > 2, "some frames")
        (engine,) = node.children()
        status = Path(f"/proc/{engine}/stat")
        assert "vizdoom" in status.read_text()
        node.send(signal.SIGKILL)
        node.wait()

        def ended() -> bool:
            """Gone, or but for its parent's taking notice."""
            try:
                return status.read_text().rpartition(")")[2].split()[0] == "Z"
            except (FileNotFoundError, ProcessLookupError):
                return True

        wait_until(ended, "the engine's end")
        assert not list(tmp_path.iterdir())
