"""The estimator nodes as real processes over DDS, fed by a publisher of the test.

The expensive part is to start a node, so most tests share one pair. Each plays a run of its own: its stamps
start long before those of the run before it, which is what a restarted simulator looks like.
"""

import re
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import torch
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Path as PathMessage
from ngo_msgs.msg import DiscreteAction, RelativePose
from ngo_msgs.srv import Reset, SaveTrajectory
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.frontend.camera.local_odometry import AT_ONCE
from ngo_estimator.nodes.messages import relative_step, to_ns, to_time
from ngo_estimator.nodes.path_message import plain_path
from ngo_estimator.slam.online_trajectory import OnlineTrajectory

from .estimator_graph import FIRST_RUN_NS, STEP_NS, Graph, image_message, scan
from .processes import NodeProcess, Probe, end, wait_until

pytestmark = pytest.mark.processes


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Untrained weights for both worlds: what these tests say does not depend on what was learned."""
    folder = tmp_path_factory.mktemp("weights")
    for world in ("maze2d", "maze3d"):
        torch.manual_seed(0)
        write_untrained(folder / world, world)
    return folder


@pytest.fixture(scope="module")
def graph(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    """A running, connected pair of estimators."""
    own = {"path_rate_hz": 0.0, "save_directory": str(tmp_path_factory.getbasetemp())}
    shared = {
        "world": "maze2d",
        "weights": str(weights / "maze2d"),
        "diagnostics_period_s": 0.1,
    }
    # A node that fell behind finds 4 s of images, and their actions may come after them: none of these is lost.
    local_own = {"image_reliability": "reliable", "image_depth": 1000, "action_timeout_s": 10.0}
    with (
        Probe() as probe,
        NodeProcess("ngo_estimator", "local_node", {**shared, **local_own}) as local,
        NodeProcess("ngo_estimator", "ngo_node", {**shared, **own}) as ngo,
    ):
        graph = Graph(local, ngo, weights / "maze2d", probe)
        graph.connect()
        yield graph


def test_nodes_equal_their_cores(graph: Graph) -> None:
    graph.finish_run(frames=30)
    out, expected = graph.out, graph.expected(*range(30))
    trajectory = OnlineTrajectory.load(graph.weights, iterations_per_step=1)
    assert [len(messages) for messages in (out.relative_poses, out.odometry, out.poses)] == [29, 29, 29]
    for estimate, message, odometry, pose in zip(expected, out.relative_poses, out.odometry, out.poses, strict=True):
        step = relative_step(message)
        assert (step.stamp_ns, step.from_stamp_ns) == (estimate.stamp_ns, estimate.from_stamp_ns)
        np.testing.assert_allclose(step.relative_xyyaw, estimate.relative_xyyaw, atol=1e-6)
        np.testing.assert_allclose(step.covariance, estimate.covariance, rtol=1e-5)
        np.testing.assert_allclose(step.odom_xyyaw, estimate.odom_xyyaw, atol=1e-6)
        np.testing.assert_allclose(step.motion_feature, estimate.motion_feature, atol=1e-5)
        np.testing.assert_allclose(step.place_code, estimate.place_code, atol=1e-5)
        # The first frame's place code comes with the first step, and never again.
        assert (step.from_place_code is not None) == (message is out.relative_poses[0])
        if step.from_place_code is not None and estimate.from_place_code is not None:
            np.testing.assert_allclose(step.from_place_code, estimate.from_place_code, atol=1e-5)
        assert message.header.frame_id == odometry.child_frame_id == "base_link"
        assert odometry.header.frame_id == "odom"
        assert odometry.pose.pose.position.x == message.odom_x
        assert odometry.twist.twist.linear.x == pytest.approx(message.x / 0.1)
        update = trajectory.update(step)
        assert to_ns(pose.header.stamp) == step.stamp_ns
        newest = tuple(update.pose_xyyaw[:2])
        assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == pytest.approx(newest, abs=1e-6)
        assert pose.pose.covariance[35] == pytest.approx(update.covariance[2, 2], rel=1e-4)


def test_path_trajectory_and_pose_are_one(graph: Graph) -> None:
    graph.finish_run(frames=12)
    path, trajectory, pose = graph.out.paths[-1], graph.out.trajectories[-1], graph.out.poses[-1]
    stamps_ns = np.array(trajectory.stamps_ns)
    poses_xyyaw = np.column_stack((trajectory.x, trajectory.y, trajectory.yaw))
    assert stamps_ns.tolist() == [graph.stamp_ns(step) for step in range(12)]
    assert path == plain_path("map", graph.stamp_ns(11), stamps_ns, poses_xyyaw)
    assert trajectory.header.frame_id == pose.header.frame_id == "map"
    newest, last = pose.pose.pose, path.poses[-1].pose
    assert (newest.position.x, newest.position.y) == pytest.approx((last.position.x, last.position.y), abs=1e-9)
    assert newest.orientation.z == pytest.approx(last.orientation.z, abs=1e-9)
    assert poses_xyyaw[0].tolist() == [0.0, 0.0, 0.0]


def test_transforms_connect_map_to_base_link(graph: Graph) -> None:
    graph.finish_run(frames=6)
    by_frames = {}
    for message in graph.out.transforms:
        (transform,) = message.transforms
        by_frames[transform.header.frame_id, transform.child_frame_id] = transform
    assert set(by_frames) == {("odom", "base_link"), ("map", "odom")}
    odom_from_base = by_frames["odom", "base_link"].transform
    assert odom_from_base.translation.x == graph.out.odometry[-1].pose.pose.position.x
    assert odom_from_base.rotation == graph.out.odometry[-1].pose.pose.orientation


def unusable_images() -> list[Image]:
    """Images of the wrong size, encoding or length, or with colours that are not finite."""
    with_nan = scan(2)
    with_nan[0, 100, 1] = np.nan
    wrong_encoding, short = image_message(scan(2), 0), image_message(scan(2), 0)
    wrong_encoding.encoding = "rgb8"
    short.data = short.data[:-16]
    return [image_message(scan(2)[:, :240], 0), wrong_encoding, short, image_message(with_nan, 0)]


def test_unusable_images_are_dropped_and_counted(graph: Graph) -> None:
    graph.diagnostics.clear()
    graph.start_run()
    graph.play(0, 1)
    graph.action(1)
    images = unusable_images()
    for message in images:
        message.header.stamp = to_time(graph.stamp_ns(2))
        graph.images.publish(message)
    graph.play(3)
    graph.wait_for_step(3)
    assert graph.steps() == [(0, 1), (1, 3)]

    def dropped() -> int:
        values = graph.diagnostics.values("/local_node")
        return sum(int(value) for key, value in values.items() if key.startswith("dropped: image"))

    graph.probe.spin_until(lambda: dropped() >= len(images), "a count of the dropped images")
    assert graph.local.running


def test_a_node_that_fell_behind_takes_several_frames_at_once_in_order(graph: Graph) -> None:
    graph.start_run()
    graph.play(0, 1)
    graph.wait_for_step(1)
    graph.local.send(signal.SIGSTOP)
    graph.play(*range(2, 42))
    graph.local.send(signal.SIGCONT)
    graph.wait_for_step(41)
    assert graph.steps() == [(k, k + 1) for k in range(41)]
    for estimate, message in zip(graph.expected(*range(42)), graph.out.relative_poses, strict=True):
        np.testing.assert_allclose(relative_step(message).relative_xyyaw, estimate.relative_xyyaw, atol=1e-6)
    graph.diagnostics.wait_for_value("/local_node", "most images at once", lambda most: int(most) == AT_ONCE)


def test_a_restarted_source_starts_both_anew_with_one_line_each(graph: Graph) -> None:
    graph.finish_run(frames=8)
    before = {process: process.log.count("restarted, so") for process in (graph.local, graph.ngo)}
    graph.finish_run(frames=4)
    assert graph.steps() == [(0, 1), (1, 2), (2, 3)]
    np.testing.assert_allclose(
        graph.out.relative_poses[-1].odom_x, graph.expected(0, 1, 2, 3)[-1].odom_xyyaw[0], atol=1e-6
    )
    assert len(graph.out.trajectories[-1].x) == 4
    assert graph.out.odometry[0].pose.covariance[0] == pytest.approx(graph.out.relative_poses[0].covariance[0])
    for process, count in before.items():
        wait_until(lambda: process.log.count("restarted, so") == count + 1, f"one line of {process.name}")  # noqa: B023


def test_reset_forgets_the_trajectory(graph: Graph, tmp_path: Path) -> None:
    graph.finish_run(frames=5)
    response = graph.probe.call(Reset, "ngo_node/reset", Reset.Request())
    assert (response.success, response.message) == (True, "forgot 5 poses")
    request = SaveTrajectory.Request(path=str(tmp_path / "path.tum"))
    response = graph.probe.call(SaveTrajectory, "ngo_node/save_trajectory", request)
    assert (response.success, response.message) == (False, "the trajectory is empty; nothing was written")
    graph.play(5)
    graph.wait_for_step(5)
    assert len(graph.out.trajectories[-1].x) == 2


def test_who_comes_late_gets_the_newest_path_at_once(graph: Graph) -> None:
    graph.finish_run(frames=5)
    with Probe("late_probe") as late:
        paths = late.collect(PathMessage, "ngo/path")
        late.spin_until(lambda: paths, "a path without new frames")
        assert paths[0] == graph.out.paths[-1]


def test_diagnostics_tell_rates_times_and_the_window(graph: Graph) -> None:
    graph.diagnostics.clear()
    graph.finish_run(frames=7)

    def said(name: str) -> set[str]:
        return {entry.key for status in graph.diagnostics.statuses(name) for entry in status.values}

    graph.diagnostics.wait_for_value("/ngo_node", "frames", "7".__eq__)
    assert {
        "input rate (Hz)", "received", "dropped", "time an update, mean (ms)", "time an update, max (ms)",
        "window fill", "gaps", "loops", "last correction, largest move (m)", "paused", "restarts",
        "standard deviation of the position (m)", "map_from_odom (x m, y m, yaw rad)",
    } <= said("/ngo_node")  # fmt: skip
    graph.probe.spin_until(
        lambda: {"input rate (Hz)", "images waiting for actions", "missed frames", "restarts"} <= said("/local_node"),
        "local_node's diagnostics",
    )
    newest = graph.diagnostics.arrays("/ngo_node")[-1]
    assert to_ns(newest.header.stamp) == graph.stamp_ns(6)


def test_sigint_ends_both_with_code_zero_and_no_traceback(graph: Graph) -> None:
    """Last of those that share the pair."""
    graph.start_run()
    graph.play(*range(100))  # signals come while they work
    end(graph.local, graph.ngo)


def test_switches_names_and_the_3d_world(weights: Path) -> None:
    """In a namespace, without TF, with other frames and topics, images best effort; ended by SIGTERM."""
    shared = {
        "world": "maze3d",
        "weights": str(weights / "maze3d"),
        "publish_tf": False,
        "odom_frame": "drift",
    }
    with Probe("probe_3d") as probe, ExitStack() as stack:
        local = stack.enter_context(
            NodeProcess(
                "ngo_estimator",
                "local_node",
                {**shared, "base_frame": "robot", "image_topic": "camera/image", "publish_odometry": False},
                ("-r", "__ns:=/red"),
            )
        )
        ngo = stack.enter_context(
            NodeProcess("ngo_estimator", "ngo_node", {**shared, "map_frame": "world"}, ("-r", "__ns:=/red"))
        )
        best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        images = probe.node.create_publisher(Image, "/red/camera/image", best_effort)
        actions = probe.node.create_publisher(DiscreteAction, "/red/action", 10)
        poses = probe.collect(PoseWithCovarianceStamped, "/red/ngo/pose")
        relative_poses = probe.collect(RelativePose, "/red/relative_pose")
        probe.spin_until(
            lambda: images.get_subscription_count() and actions.get_subscription_count(),
            "local_node's subscriptions",
        )
        step = 0

        def pose_arrived() -> bool:
            nonlocal step
            action = DiscreteAction(action=0)
            action.header.stamp = to_time(FIRST_RUN_NS + step * STEP_NS)
            actions.publish(action)
            step += 1
            pixels = np.random.default_rng(step).integers(0, 256, (60, 80, 3), dtype=np.uint8)
            images.publish(image_message(pixels, FIRST_RUN_NS + step * STEP_NS))
            return bool(poses and relative_poses)

        probe.spin_until(pose_arrived, "a pose")
        assert poses[0].header.frame_id == "world"
        assert relative_poses[0].header.frame_id == "robot"
        for name, topic in (("local_node", "/red/relative_pose"), ("ngo_node", "/red/ngo/pose")):

            def published(name: str = name) -> set[str]:
                if (name, "/red") not in probe.node.get_node_names_and_namespaces():
                    return set()
                return {topic for topic, _ in probe.node.get_publisher_names_and_types_by_node(name, "/red")}

            probe.spin_until(lambda topic=topic, published=published: topic in published(), f"{name} in the graph")
            assert not {"/tf", "/red/odom"} & published()
        (info,) = probe.node.get_subscriptions_info_by_topic("/red/camera/image")
        assert info.qos_profile.reliability == ReliabilityPolicy.BEST_EFFORT
        end(local, ngo, by=signal.SIGTERM)


def test_a_signal_while_a_node_starts_ends_it_cleanly(weights: Path) -> None:
    """The node is in the graph before it loads its networks, which takes long."""
    with Probe("start_probe") as probe:
        parameters = {"world": "maze2d", "weights": str(weights / "maze2d")}
        with NodeProcess("ngo_estimator", "ngo_node", parameters, ("-r", "__ns:=/early"), fresh=True) as process:
            probe.spin_until(
                lambda: ("ngo_node", "/early") in probe.node.get_node_names_and_namespaces(),
                "the node",
            )
            end(process)


def assert_refused(process: NodeProcess, pattern: str) -> None:
    """The node ends with exit code 2 and with one line, which matches the pattern."""
    assert process.wait() == 2, process.log
    assert len(process.lines) == 1 and re.search(pattern, process.log), process.log


def test_a_bad_parameter_ends_the_start_with_one_line_and_code_two() -> None:
    with NodeProcess("ngo_estimator", "local_node", {"wrld": "maze2d"}) as process:
        assert_refused(process, "parameter 'wrld' is 'maze2d', but unknown; did you mean world")


def test_bad_weights_end_the_start_with_one_line_and_code_two(weights: Path, tmp_path: Path) -> None:
    write_untrained(tmp_path, "maze2d")
    file = tmp_path / "local_pose_network.safetensors"
    file.write_bytes(file.read_bytes()[:-100])
    cases = {
        ("local_node", "maze2d", tmp_path): "local_pose_network.safetensors: is damaged",
        ("ngo_node", "maze3d", weights): "cannot be read",
    }
    with ExitStack() as stack:
        started = [
            (
                stack.enter_context(NodeProcess("ngo_estimator", executable, {"world": world, "weights": str(folder)})),
                pattern,
            )
            for (executable, world, folder), pattern in cases.items()
        ]
        for process, pattern in started:
            assert_refused(process, pattern)
