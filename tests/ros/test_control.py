"""What people do with ngo_node: start and stop it, ask and tell it things, and run several of it."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from evo.tools import file_interface
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import Path as PathMessage
from ngo_msgs.msg import Trajectory
from ngo_msgs.srv import RemoveLoop, SaveGraph, SaveTrajectory
from rcl_interfaces.srv import DescribeParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes.messages import planar_estimate, pose_message, relative_step, to_ns, to_time
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection
from ngo_estimator.trajectory.g2o import PlanarGraph, read_g2o

from .processes import NodeProcess, Probe, end
from .readings import xyyaw
from .relative_poses import Optimizer, assert_pose_is

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def parameters(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    saved = str(tmp_path_factory.getbasetemp())
    return {"world": "maze2d", "weights": str(weights), "diagnostics_period_s": 0.1, "save_directory": saved}


@pytest.fixture(scope="module")
def optimizer(weights: Path, parameters: dict[str, Any]) -> Iterator[Optimizer]:
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
        yield Optimizer(process, weights, probe)
        end(process)


# ---- services


def test_paused_it_follows_the_odometry_and_then_catches_up(optimizer: Optimizer) -> None:
    drive = optimizer.drive()
    steps = drive.steps(1, 72)
    optimizer.pose_after(*steps[:12])
    assert optimizer.pause(True) == "paused: poses follow the odometry"
    optimizer.pose_after(*steps[12:50])
    optimizer.wait_for_value("paused", "true".__eq__)
    assert optimizer.pause(False) == "corrections go on"
    optimizer.pose_after(*steps[50:])
    optimizer.core.reset()
    for k, step in enumerate(steps):
        update = optimizer.core.update(relative_step(step), optimize=not 12 <= k < 50)
        assert_pose_is(optimizer.poses[k], update)
    assert len(optimizer.poses) == 72, "none is lost"


@pytest.mark.parametrize("ending", ["tum", "kitti", "g2o"])
def test_a_trajectory_is_saved_while_steps_go_on(optimizer: Optimizer, tmp_path: Path, ending: str) -> None:
    drive = optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 100))
    client = optimizer.probe.node.create_client(SaveTrajectory, "ngo_node/save_trajectory")
    optimizer.probe.spin_until(client.service_is_ready, "the service")
    path = tmp_path / f"run.{ending}"
    answer = client.call_async(SaveTrajectory.Request(path=str(path)))
    optimizer.publish(*drive.steps(101, 200))
    optimizer.probe.spin_until(answer.done, "an answer")
    optimizer.wait_for_stamp(drive.stamp_ns(200))
    optimizer.probe.node.destroy_client(client)
    assert answer.result().success, answer.result().message
    count = {
        "tum": lambda: file_interface.read_tum_trajectory_file(path).num_poses,
        "kitti": lambda: file_interface.read_kitti_poses_file(path).num_poses,
        "g2o": lambda: path.read_text().count("VERTEX_SE2"),
    }[ending]()
    assert count >= 101
    assert answer.result().message == f"wrote {count} poses to {path}"
    if ending == "g2o":
        assert path.read_text().count("EDGE_SE2") >= count - 1
    assert len(optimizer.poses) == 200


def test_the_graph_is_saved_and_a_loop_is_taken_out(optimizer: Optimizer, tmp_path: Path) -> None:
    drive, probe = optimizer.drive(), optimizer.probe
    optimizer.pose_after(*drive.steps(1, 100))

    def saved(name: str) -> PlanarGraph:
        path = tmp_path / f"{name}.g2o"
        answer = probe.call(SaveGraph, "ngo_node/save_graph", SaveGraph.Request(path=str(path)))
        assert answer.success, answer.message
        beside = file_interface.read_tum_trajectory_file(path.with_suffix(".tum"))
        graph = read_g2o(path)
        assert len(graph.ids) == beside.num_poses == 101
        np.testing.assert_array_equal(graph.poses[:, :2], beside.positions_xyz[:, :2])
        return graph

    def removed(**fields: Any) -> RemoveLoop.Response:
        return probe.call(RemoveLoop, "ngo_node/remove_loop", RemoveLoop.Request(**fields))

    before = saved("before")
    loops = before.edges[before.is_loop].tolist()
    (first, second), (other_first, other_second) = loops[0], loops[-1]
    answer = removed(first_id=first, second_id=second)
    assert answer.success and "loops are out" in answer.message
    stamps = (to_time(int(before.stamps_ns[name])) for name in (other_first, other_second))
    assert removed(**dict(zip(("first", "second"), stamps, strict=True))).success
    after = saved("after")
    left = after.edges[after.is_loop].tolist()
    assert [first, second] not in left and [other_first, other_second] not in left and len(left) > 0
    assert np.abs(after.poses - before.poses).max() > 1e-6
    for fields, said in (
        ({"first_id": first, "second_id": second}, "no loop joins these poses; the nearest one joins"),
        ({"first_id": 0, "second_id": 101}, "there is no vertex 101; expected 0 to 100"),
        ({"what": 7}, "what is 7; expected 0 (LOOP) or 1 (STRETCH)"),
        ({}, "no pose has the stamp 0.000000000; the nearest one is at"),
    ):
        answer = removed(**fields)
        assert not answer.success and said in answer.message
    optimizer.pose_after(*drive.steps(101, 130))
    wrong = SaveGraph.Request(path=str(tmp_path / "graph.txt"))
    assert "ends in .g2o" in probe.call(SaveGraph, "ngo_node/save_graph", wrong).message


def test_a_trajectory_that_cannot_be_saved_is_said_in_one_line(optimizer: Optimizer, tmp_path: Path) -> None:
    optimizer.pose_after(*optimizer.drive().steps(1, 9))
    for path, reason in ((tmp_path / "a.csv", "ends in"), (tmp_path / "no" / "a.tum", "No such file")):
        request = SaveTrajectory.Request(path=str(path))
        response = optimizer.probe.call(SaveTrajectory, "ngo_node/save_trajectory", request)
        assert not response.success and reason in response.message and "\n" not in response.message
    assert not list(tmp_path.iterdir())


# ---- where the map is


def test_two_hundred_calls_at_once_are_all_answered(optimizer: Optimizer, tmp_path: Path) -> None:
    optimizer.pose_after(*optimizer.drive().steps(1, 9))
    client = optimizer.probe.node.create_client(
        SaveTrajectory, "ngo_node/save_trajectory", qos_profile=QoSProfile(depth=200)
    )
    optimizer.probe.spin_until(client.service_is_ready, "the service")
    answers = [client.call_async(SaveTrajectory.Request(path=str(tmp_path / f"{k % 7}.tum"))) for k in range(200)]
    optimizer.probe.spin_until(lambda: all(answer.done() for answer in answers), "200 answers")
    optimizer.probe.node.destroy_client(client)
    assert all(answer.result().success for answer in answers)
    assert len(list(tmp_path.iterdir())) == 7


def test_an_initial_pose_moves_pose_path_and_transform(optimizer: Optimizer) -> None:
    probe = optimizer.probe
    given = probe.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
    trajectories, transforms = probe.collect(Trajectory, "ngo/trajectory"), probe.collect(TFMessage, "/tf")
    probe.spin_until(lambda: given.get_subscription_count() == 1, "ngo_node's subscription")
    optimizer.meet()
    drive = optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 20))
    wanted, covariance = np.array([5.0, -3.0, 2.0]), np.diag([0.04, 0.09, 0.01])
    at = optimizer.expected(drive.steps(1, 20)).pose_xyyaw
    given.publish(pose_message(0, "odom", wanted, covariance))  # of another frame: dropped
    optimizer.process.wait_for_log("dropped initial pose: pose is in the frame 'odom'; expected 'map'")
    given.publish(pose_message(0, "map", wanted, covariance))
    optimizer.process.wait_for_log("the robot is at x 5.000 m, y -3.000 m, yaw 2.000 rad")
    origin = MapOrigin.of_pose(at, wanted, covariance)
    pose = optimizer.pose_after(drive.step(21))
    update = optimizer.expected(drive.steps(1, 21))
    expected = origin.poses(update.pose_xyyaw)
    moved, its_covariance = planar_estimate(pose, "map")
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    np.testing.assert_allclose(its_covariance, origin.covariance_of(expected, update.covariance), rtol=1e-3, atol=1e-9)
    newest = drive.stamp_ns(21)
    probe.spin_until(lambda: trajectories and trajectories[-1].stamps_ns[-1] == newest, "the trajectory")
    whole = np.column_stack((trajectories[-1].x, trajectories[-1].y))
    np.testing.assert_allclose(whole[0], origin.map_from_start_xyyaw[:2], atol=1e-5)
    np.testing.assert_allclose(whole[-1], moved[:2], atol=1e-9)
    probe.spin_until(lambda: transforms and to_ns(transforms[-1].transforms[0].header.stamp) == newest, "the transform")
    map_from_odom = xyyaw(transforms[-1].transforms[0].transform)
    np.testing.assert_allclose(map_from_odom[:2], origin.poses(update.map_from_odom_xyyaw)[:2], atol=1e-5)
    # It belongs to this trajectory: the next one begins where the parameter says.
    drive = optimizer.drive()
    assert_pose_is(optimizer.pose_after(drive.step(1)), optimizer.expected([drive.step(1)]))
    probe.node.destroy_publisher(given)


def test_the_parameter_initial_pose_is_where_the_next_trajectory_begins(optimizer: Optimizer) -> None:
    assert optimizer.probe.set_parameter("ngo_node", "initial_pose", [1.0, 2.0, 1.5]) == ""
    drive = optimizer.drive()
    pose = optimizer.pose_after(drive.step(1))
    step = optimizer.expected([drive.step(1)]).pose_xyyaw
    expected = MapOrigin.of_first_pose(np.array([1.0, 2.0, 1.5])).poses(step)
    np.testing.assert_allclose(xyyaw(pose.pose.pose), expected, atol=1e-6)
    assert optimizer.probe.set_parameter("ngo_node", "initial_pose", [0.0, 0.0, 0.0]) == ""
    assert "three numbers" in optimizer.probe.set_parameter("ngo_node", "initial_pose", [0.0, 0.0])


def test_smoothed_corrections_reach_the_transform_little_by_little(optimizer: Optimizer) -> None:
    """As many steps as leave no optimisation unfinished, which would end by a transform of its own."""
    probe = optimizer.probe
    transforms = probe.collect(TFMessage, "/tf")
    optimizer.meet()
    assert probe.set_parameter("ngo_node", "tf_smoothing_s", 1.0) == ""
    drive = optimizer.drive()
    steps = drive.steps(1, 45)
    optimizer.pose_after(*steps)
    probe.spin_until(
        lambda: transforms and to_ns(transforms[-1].transforms[0].header.stamp) == drive.stamp_ns(45), "the transform"
    )
    smoothing, jumps = SmoothedCorrection(1.0), 0.0
    optimizer.core.reset()
    for message, step in zip(transforms[-45:], map(relative_step, steps), strict=True):
        newest = optimizer.core.update(step).map_from_odom_xyyaw
        expected = smoothing.update(step.stamp_ns, newest, step.odom_xyyaw)
        np.testing.assert_allclose(xyyaw(message.transforms[0].transform), expected, atol=1e-5)
        jumps = max(jumps, float(np.abs(newest - expected).max()))
    assert jumps > 1e-4, "there was nothing to smooth"
    assert probe.set_parameter("ngo_node", "tf_smoothing_s", 0.0) == ""


# ---- parameters


def test_the_path_comes_at_its_rate_and_only_to_those_who_listen(optimizer: Optimizer) -> None:
    probe = optimizer.probe
    assert probe.set_parameter("ngo_node", "path_rate_hz", 0.0) == ""
    paths = probe.collect(PathMessage, "ngo/path")
    probe.spin_until(lambda: paths, "the newest path, for who comes late")
    drive = optimizer.drive()
    paths.clear()
    optimizer.pose_after(*drive.steps(1, 30))
    probe.spin_until(lambda: paths and len(paths[-1].poses) == 31, "a path for each step, and for each correction")
    own = [path for path in paths if to_ns(path.header.stamp) <= drive.stamp_ns(30)]  # of this drive, not the last one
    assert [len(path.poses) for path in own] == sorted([*range(2, 32), 9, 17, 25])
    assert probe.set_parameter("ngo_node", "path_rate_hz", 2.0) == ""
    paths.clear()
    begin_s = time.monotonic()
    optimizer.pose_after(*drive.steps(31, 100))
    probe.spin_until(lambda: paths and len(paths[-1].poses) == 101, "the newest path when it is time")
    assert len(paths) <= 2.0 * (time.monotonic() - begin_s) + 2
    assert probe.set_parameter("ngo_node", "path_rate_hz", 10.0) == ""


def test_what_cannot_change_is_refused_in_one_line(optimizer: Optimizer) -> None:
    for name, value in (("window_frames", 100), ("map_frame", "world"), ("publish_tf", False)):
        reason = optimizer.probe.set_parameter("ngo_node", name, value)
        assert reason == f"parameter '{name}' cannot change now: start or configure the node with it"
    assert "path_rate_hz" in optimizer.probe.set_parameter("ngo_node", "path_rate_hz", -1.0)
    described = optimizer.probe.call(
        DescribeParameters, "ngo_node/describe_parameters", DescribeParameters.Request(names=["path_rate_hz"])
    ).descriptors
    assert described[0].additional_constraints == "a number from 0 to 1000; at any time"


def test_quality_of_service_is_overridden_by_ros_own_parameters() -> None:
    """A path that is latched by the middleware, as some tools ask for."""
    override = "qos_overrides./latched/ngo/path.publisher"
    arguments = ("-r", "__ns:=/latched", "-p", f"{override}.durability:=transient_local", "-p", f"{override}.depth:=3")
    with Probe("qos_probe") as probe, NodeProcess("ngo_estimator", "ngo_node", {"world": "scan"}, arguments) as process:
        process.wait_for_log("ready")
        probe.collect(
            PathMessage, "/latched/ngo/path", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        )

        def durability() -> object:
            infos = probe.node.get_publishers_info_by_topic("/latched/ngo/path")
            return infos[0].qos_profile.durability if infos else None

        probe.spin_until(lambda: durability() == DurabilityPolicy.TRANSIENT_LOCAL, "a latched path")


# ---- life cycle


class Managed:
    """A node that waits to be told."""

    def __init__(self, probe: Probe, name: str) -> None:
        self._probe, self._name = probe, name

    def state(self) -> str:
        """The state that the node says it is in."""
        response = self._probe.call(GetState, f"{self._name}/get_state", GetState.Request())
        return str(response.current_state.label)

    def change(self, transition: int) -> bool:
        """Ask for a transition; whether it succeeded."""
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self._probe.call(ChangeState, f"{self._name}/change_state", request).success)


def test_without_autostart_it_does_what_it_is_told(weights: Path, parameters: dict[str, Any]) -> None:
    name = "/managed/ngo_node"
    with Probe("manager") as probe:
        waiting = {**parameters, "autostart": False, "weights": "/nowhere", "tf_topic": "tf"}
        transforms = probe.collect(TFMessage, "/managed/tf")
        with NodeProcess("ngo_estimator", "ngo_node", waiting, ("-r", "__ns:=/managed")) as process:
            node = Managed(probe, name)
            assert node.state() == "unconfigured"
            assert not node.change(Transition.TRANSITION_CONFIGURE)
            assert node.state() == "unconfigured"
            process.wait_for_log("ERROR.*there is no folder '/nowhere'")
            # Unconfigured, everything may change: it takes part when the node is configured.
            assert probe.set_parameter(name, "weights", str(weights)) == ""
            assert node.change(Transition.TRANSITION_CONFIGURE) and node.state() == "inactive"
            assert "cannot change now" in probe.set_parameter(name, "weights", "")
            assert probe.node.count_subscribers("/managed/relative_pose") == 0
            assert node.change(Transition.TRANSITION_ACTIVATE) and node.state() == "active"
            for transition in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE, 255):
                assert not node.change(transition), "it is active already"
            assert node.state() == "active"
            optimizer = Optimizer(process, weights, probe, "/managed")
            drive = optimizer.drive()
            optimizer.pose_after(*drive.steps(1, 10))
            # Deactivated it listens no more; what it has missed is a gap that the odometry bridges.
            assert node.change(Transition.TRANSITION_DEACTIVATE) and node.state() == "inactive"
            probe.spin_until(lambda: optimizer.publisher.get_subscription_count() == 0, "ngo_node to stop listening")
            optimizer.publish(*drive.steps(11, 15))
            assert node.change(Transition.TRANSITION_ACTIVATE)
            probe.spin_until(lambda: optimizer.publisher.get_subscription_count() == 1, "ngo_node to listen again")
            pose = optimizer.pose_after(*drive.steps(16, 17))
            assert_pose_is(pose, optimizer.expected([*drive.steps(1, 10), *drive.steps(16, 17)]))
            probe.spin_until(lambda: transforms, "a transform on a topic of its own")
            # Cleaned up it has forgotten everything.
            assert node.change(Transition.TRANSITION_DEACTIVATE) and node.change(Transition.TRANSITION_CLEANUP)
            assert node.state() == "unconfigured"
            probe.spin_until(lambda: optimizer.publisher.get_subscription_count() == 0, "ngo_node to stop listening")
            assert node.change(Transition.TRANSITION_CONFIGURE) and node.change(Transition.TRANSITION_ACTIVATE)
            optimizer.connect()
            drive = optimizer.drive()
            assert_pose_is(optimizer.pose_after(*drive.steps(1, 5)), optimizer.expected(drive.steps(1, 5)))
            assert node.change(Transition.TRANSITION_ACTIVE_SHUTDOWN) and node.state() == "finalized"
            end(process)


# ---- several robots


def test_two_nodes_of_one_name_are_told() -> None:
    namespace = ("-r", "__ns:=/twins")
    with (
        Probe("midwife") as probe,
        NodeProcess(
            "ngo_estimator", "ngo_node", {"world": "scan", "diagnostics_period_s": 0.1}, namespace
        ) as estimator,
        NodeProcess("ngo_sim", "maze2d", {"rate": 1.0}, (*namespace, "-r", "__node:=ngo_node")) as simulator,
    ):
        for process in (estimator, simulator):
            process.wait_for_log("WARN.*two nodes are named /twins/ngo_node")
        statuses = probe.collect(DiagnosticArray, "/diagnostics")
        problem = "two nodes are named /twins/ngo_node"
        probe.spin_until(lambda: any(problem in array.status[0].message for array in statuses), "diagnostics")
