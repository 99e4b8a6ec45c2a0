"""A node that is switched on within a saved map finds its pose there, and says so until it has.

With mode:=localization the map stays as it is, with map_changes:=learn or state_mode:=relocalise it grows from there.
"""

import dataclasses
import signal
from collections.abc import Iterator
from copy import deepcopy
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import RelativePose, Trajectory
from ngo_msgs.srv import LoadState, Reset, SaveState
from tf2_msgs.msg import TFMessage

from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.nodes.messages import pose_message, relative_pose_message, to_ns
from ngo_estimator.nodes.ngo_node import NgoNode
from tests.golden.drives import WEIGHTS, GoldenDrive, estimates

from .processes import NodeProcess, Probe, end
from .readings import xyyaw
from .relative_poses import Optimizer

pytestmark = pytest.mark.processes

START = 110  # Frame at which the robot is switched on again.


@dataclasses.dataclass
class Mapped:
    """A saved session, and the steps of a robot from ``START`` on, whose odometry begins there."""

    parameters: dict[str, Any]
    frames: int
    steps: list[RelativePose]
    expected: np.ndarray
    odom: np.ndarray


@dataclasses.dataclass
class Again(Mapped):
    """The same, and a node in localization mode."""

    process: NodeProcess
    probe: Probe
    optimizer: Optimizer
    transforms: list[TFMessage]


class Node(Optimizer):
    """A node that may not know its pose, and so would not answer."""

    def connect(self) -> None:
        self.meet()


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    drive = GoldenDrive.load("maze2d")
    steps = estimates(drive, LocalOdometry.load(WEIGHTS / "maze2d"))
    folder = tmp_path_factory.mktemp("states")
    parameters: dict[str, Any] = {"world": "maze2d", "save_directory": str(folder), "diagnostics_period_s": 0.2}
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
        optimizer = Node(process, WEIGHTS / "maze2d", probe)
        last = optimizer.pose_after(*(relative_pose_message(step, "base_link") for step in steps))
        response = probe.call(SaveState, "ngo_node/save_state", SaveState.Request(path="maze"))
        assert response.success, response.message
        process.send(signal.SIGINT)
        assert process.wait() == 0
    begin = steps[START - 1]
    later = [
        dataclasses.replace(step, odom_xyyaw=between(begin.odom_xyyaw, step.odom_xyyaw), origin_stamp_ns=begin.stamp_ns)
        for step in steps[START:]
    ]
    messages = [relative_pose_message(step, "base_link") for step in later]
    return Mapped(parameters, len(steps) + 1, messages, xyyaw(last), later[-1].odom_xyyaw)


@pytest.fixture(scope="module")
def again(mapped: Mapped) -> Iterator[Again]:
    parameters = {**mapped.parameters, "mode": "localization", "state": "maze"}
    with Probe() as probe:
        transforms = probe.collect(TFMessage, "tf")
        with NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
            node = Node(process, WEIGHTS / "maze2d", probe)
            yield Again(**vars(mapped), process=process, probe=probe, optimizer=node, transforms=transforms)
            end(process)


def test_another_start_is_found_in_the_loaded_map_which_then_grows(mapped: Mapped) -> None:
    """Nothing is published until the robot is found; then one map holds both drives."""
    later, frames = [_later(message) for message in mapped.steps], mapped.frames
    parameters = {**mapped.parameters, "state": "maze", "state_mode": "relocalise", "path_rate_hz": 0.0}
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
        node = Node(process, WEIGHTS / "maze2d", probe)
        transforms = probe.collect(TFMessage, "tf")
        trajectories: list[Trajectory] = probe.collect(Trajectory, "ngo/trajectory")
        node.meet()
        node.publish(mapped.steps[0])
        process.wait_for_log("dropped relative pose: .*expected later stamps")
        node.publish(*later[:3])
        node.wait_for_problem("not localised: ", "support")
        assert not transforms and not node.poses
        node.publish(*later[3:])
        assert xyyaw(node.wait_for_stamp(_stamp_ns(later[-1]))) == pytest.approx(mapped.expected, abs=0.03)
        process.wait_for_log("localised: several frames agree")
        process.wait_for_log("the loaded map grows from here")
        both = frames + len(node.poses)
        probe.spin_until(lambda: trajectories and len(trajectories[-1].stamps_ns) == both, "both drives in one map")
        assert len(node.poses) < len(later)
        found = set(node.stamps_ns())
        # Another one of the newest pose comes where an optimisation ends by itself.
        probe.spin_until(
            lambda: {to_ns(message.transforms[0].header.stamp) for message in transforms} == found, "the transforms"
        )
        node.wait_for_value("frames", str(both).__eq__)
        # Another odometry does not wipe the map: the robot is looked for in it again.
        third, known = [_later(message, 2) for message in mapped.steps], len(node.poses)
        node.publish(*third)
        assert xyyaw(node.wait_for_stamp(_stamp_ns(third[-1]))) == pytest.approx(mapped.expected, abs=0.03)
        process.wait_for_log("looks for the robot in the map, which stays")
        whole = both + len(node.poses) - known
        assert node.wait_for_value("frames", lambda value: value == str(whole))
        # The same while the node runs; and a reset begins a new map.
        load = LoadState.Request(path="maze", mode=LoadState.Request.RELOCALISE)
        response = probe.call(LoadState, "ngo_node/load_state", load)
        assert response.success and response.message.startswith(f"loaded {frames} poses from "), response
        node.wait_for_problem("not localised: no hypothesis yet")
        assert probe.call(Reset, "ngo_node/reset", Reset.Request()).message == f"forgot {frames} poses"
        node.publish(later[0])
        assert np.hypot(*xyyaw(node.wait_for_stamp(_stamp_ns(later[0])))[:2]) < 0.5
        end(process)


def test_a_map_that_learns_grows_from_where_the_robot_is_and_outlives_a_reset(mapped: Mapped) -> None:
    parameters = {**mapped.parameters, "mode": "localization", "map_changes": "learn", "state": "maze"}
    again, third = ([_later(message, hours) for message in mapped.steps] for hours in (3, 4))
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
        node = Node(process, WEIGHTS / "maze2d", probe)
        node.publish(*again)
        assert xyyaw(node.wait_for_stamp(_stamp_ns(again[-1]))) == pytest.approx(mapped.expected, abs=0.03)
        process.wait_for_log("the loaded map grows from here")
        frames = mapped.frames + len(node.poses)
        response = probe.call(SaveState, "ngo_node/save_state", SaveState.Request(path="learnt"))
        assert response.success and response.message.startswith(f"wrote {frames} poses"), response
        assert probe.call(Reset, "ngo_node/reset", Reset.Request()).message == "forgot the pose in the map"
        node.wait_for_problem("not localised")
        known = len(node.poses)
        node.publish(*third)
        assert xyyaw(node.wait_for_stamp(_stamp_ns(third[-1]))) == pytest.approx(mapped.expected, abs=0.03)
        node.wait_for_value("frames", str(frames + len(node.poses) - known).__eq__)
        publisher = probe.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        probe.spin_until(lambda: publisher.get_subscription_count() == 1, "ngo_node's subscription of initialpose")
        given = np.array((1.0, 2.0, 0.5))
        publisher.publish(pose_message(1, "map", given, np.diag((0.1, 0.1, 0.05))))
        process.wait_for_log("the robot is at x 1.000 m, y 2.000 m, yaw 0.500 rad, as it was told")
        fourth = _later(mapped.steps[0], 5)
        node.publish(fourth)
        assert np.hypot(*(xyyaw(node.wait_for_stamp(_stamp_ns(fourth))) - given)[:2]) < 0.5
        end(process)


@pytest.fixture
def learning(mapped: Mapped) -> Iterator[NgoNode]:
    """A node of this process in a map that learns, which has found its robot."""
    parameters = {**mapped.parameters, "mode": "localization", "map_changes": "learn", "state": "maze"}
    rclpy.init(args=["--ros-args", *(word for item in parameters.items() for word in ("-p", "{}:={}".format(*item)))])
    node = NgoNode().start()
    for message in mapped.steps:
        node._on_relative_pose(_later(message, 3))
    assert node._search is None and node._core.newest().frames > mapped.frames
    yield node
    node.destroy_node()
    rclpy.try_shutdown()


def test_a_map_is_finished_before_the_robot_is_looked_for_again_and_moves_no_more(
    learning: NgoNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    monkeypatch.setattr(learning._core, "finish", lambda: done.append("finished"))
    monkeypatch.setattr(learning._out, "send_transform", lambda *_: done.append("sent"))
    learning._on_reset(Reset.Request(), Reset.Response())
    learning._finish()  # the timer
    assert done == ["finished"]


def test_a_core_that_failed_gives_way_to_the_saved_map(
    mapped: Mapped, learning: NgoNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    logger = Mock()
    monkeypatch.setattr(learning, "get_logger", lambda: logger)
    learning._core._log = None  # type: ignore[assignment]
    learning._on_relative_pose(_later(mapped.steps[-1], 4))
    (said,) = logger.error.call_args_list
    assert said.args[0].startswith("internal error, the saved map is loaded again")
    assert learning._search is not None and learning._core.newest().frames == mapped.frames
    learning._on_relative_pose(_later(mapped.steps[0], 5))
    assert logger.error.call_count == 1


def test_a_robot_says_that_it_is_not_localised_until_its_pose_is_known_and_right(again: Again) -> None:
    node = again.optimizer
    node.publish(*again.steps[:3])
    assert "no hypothesis" not in node.wait_for_problem("not localised: ", "support")
    assert node.wait_for_value("localisation", bool) == "not localised"
    node.wait_for_value("received", "3".__eq__)
    assert not again.transforms and not node.poses
    node.publish(*again.steps[3:])
    last = node.wait_for_stamp(_stamp_ns(again.steps[-1]))
    assert xyyaw(last) == pytest.approx(again.expected, abs=0.03)
    again.process.wait_for_log("localised: several frames agree")
    again.probe.spin_until(lambda: len(again.transforms) == len(node.poses), "a transform for each pose")
    (transform,) = again.transforms[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
    assert compose(xyyaw(transform.transform), again.odom) == pytest.approx(again.expected, abs=0.03)
    assert node.wait_for_value("localisation", lambda value: value == "localised")


def test_a_reset_forgets_the_pose_and_initialpose_gives_it(again: Again) -> None:
    node, probe = again.optimizer, again.probe
    assert probe.call(Reset, "ngo_node/reset", Reset.Request()).message == "forgot the pose in the map"
    publisher = probe.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
    probe.spin_until(lambda: publisher.get_subscription_count() == 1, "ngo_node's subscription of initialpose")
    node.poses.clear()
    received = node.count("received")
    node.publish(*again.steps[:2])
    node.wait_for_value("received", str(received + 2).__eq__)
    node.wait_for_problem("not localised")
    assert not node.poses
    given = np.array((1.0, 2.0, 0.5))
    publisher.publish(pose_message(1, "map", given, np.diag((0.1, 0.1, 0.05))))
    again.process.wait_for_log("the robot is at x 1.000 m, y 2.000 m, yaw 0.500 rad, as it was told")
    node.publish(again.steps[2])
    assert np.hypot(*(xyyaw(node.wait_for_stamp(_stamp_ns(again.steps[2]))) - given)[:2]) < 0.5


def _later(message: RelativePose, hours: int = 1) -> RelativePose:
    """The same message so many hours later."""
    moved = deepcopy(message)
    for stamp in (moved.header.stamp, moved.from_stamp, moved.origin_stamp):
        stamp.sec += hours * 3600
    return moved


def _stamp_ns(message: RelativePose) -> int:
    """The stamp of the frame that a relative pose ends at, in ns."""
    stamp = message.header.stamp
    return int(stamp.sec * 10**9 + stamp.nanosec)
