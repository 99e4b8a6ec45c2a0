"""What arrives broken at local_node, and what becomes of it at the end of the chain: real processes over DDS.

Lost, doubled, late and unusable images are in `test_estimator_nodes.py`; here are those who publish them.
"""

import itertools
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
import rclpy
import torch
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import DiscreteAction, RelativePose
from ngo_msgs.srv import Reset
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.frontend.camera.frame_pairing import FramePairing, PairedFrame
from ngo_estimator.nodes.image_input import ImageInput
from ngo_estimator.nodes.local_node import LocalNode
from ngo_estimator.nodes.messages import to_ns, to_time

from .estimator_graph import RUN_NS, STEP_NS, Graph, image_message, scan
from .processes import Diagnostics, NodeProcess, Probe

pytestmark = pytest.mark.processes

SOURCE_TIMEOUT_S = 0.5


@pytest.fixture(scope="module")
def parameters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    torch.set_num_threads(1)
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("weights")
    write_untrained(folder, "maze2d")
    return {
        "world": "maze2d",
        "weights": str(folder),
        "diagnostics_period_s": 0.1,
        "source_timeout_s": SOURCE_TIMEOUT_S,
    }


@pytest.fixture(scope="module")
def graph(parameters: dict[str, Any]) -> Iterator[Graph]:
    """A running, connected pair of estimators."""
    with Probe() as probe:
        local = {**parameters, "image_reliability": "reliable", "image_depth": 1000}
        with (
            NodeProcess("ngo_estimator", "local_node", local) as local_node,
            NodeProcess("ngo_estimator", "ngo_node", {**parameters, "path_rate_hz": 0.0}) as ngo_node,
        ):
            graph = Graph(local_node, ngo_node, Path(parameters["weights"]), probe)
            graph.connect()
            yield graph
            for process in (local_node, ngo_node):
                assert process.running and "Traceback" not in process.log, process.log


def test_a_burst_of_images_is_taken_whole(graph: Graph) -> None:
    graph.start_run()
    graph.play(*range(300))
    graph.wait_for_step(299)
    assert graph.steps() == [(step, step + 1) for step in range(299)]
    assert len(graph.out.trajectories[-1].x) == 300


def test_images_of_200_hz_are_taken_as_they_come(graph: Graph) -> None:
    """What a shared machine does not get done in time waits, and none is lost."""
    graph.start_run()
    begin = time.monotonic()
    for step in range(200):
        graph.probe.spin_until(lambda due=begin + step / 200: time.monotonic() >= due, "the time")
        graph.play(step)
    graph.wait_for_step(199)
    assert graph.steps() == [(step, step + 1) for step in range(199)]


def test_a_camera_that_was_away_leaves_a_gap_with_a_large_covariance(graph: Graph) -> None:
    """Killed and back half a minute later: the odometry goes on, and says how little it knows of the time between."""
    graph.diagnostics.clear()
    graph.start_run()
    graph.play(*range(6))
    graph.action(299)
    graph.play(*range(300, 305))
    graph.wait_for_step(304)
    assert graph.steps() == [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 4),
        (4, 5),
        (5, 300),
        (300, 301),
        (301, 302),
        (302, 303),
        (303, 304),
    ]
    std = [np.sqrt(np.array(message.covariance).reshape(3, 3).diagonal()) for message in graph.out.relative_poses]
    assert (std[5] > 100 * np.array([0.1, 0.02, 0.05])).all(), "294 frames are missing"
    assert (std[5] > 10 * std[4]).all()
    corrected = [np.sqrt(pose.pose.covariance[0]) for pose in graph.out.poses]
    assert corrected[5] > 20.0 > corrected[4]
    graph.diagnostics.wait_for_problem("/local_node", "294 frames missing between images")
    graph.diagnostics.wait_for_problem("/ngo_node", "lost: the standard deviation of the position is")


class Wire:
    """An input whose messages wait until they are taken; ``then`` comes to pass while they are."""

    def __init__(self, take: Callable[[int], None], then: Callable[[], None] = lambda: None) -> None:
        self.waiting: list[int] = []
        self._take, self._then = take, then

    def take_waiting(self, most: int) -> None:
        self._then()
        taken, self.waiting = self.waiting[:most], self.waiting[most:]
        for step in taken:
            self._take(step)


def test_an_action_that_comes_while_images_are_taken_is_not_lost() -> None:
    """The action was published before its image, and is read before any later image calls it lost."""
    second, pairing = 10**9, FramePairing(needs_action=True, timeout_ns=10**9, capacity=8)
    node, seen = object.__new__(ImageInput), []

    def publish_two_images() -> None:
        actions.waiting += [0, 299]
        images.waiting += [1, 300]

    actions = Wire(lambda step: pairing.add_action(step * second, 0))
    images = Wire(lambda step: pairing.add_frame(step * second, np.zeros(1)), publish_two_images)
    core = SimpleNamespace(
        restarts=0, update_all=lambda pairs: seen.extend(pair.stamp_ns // second for pair in pairs) or []
    )
    vars(node).update(
        _pairing=pairing,
        _core=core,
        _sensor="image",
        _status=MagicMock(),
        _taking=False,
        _most_at_once=0,
        _sensor_and_side=(images, [actions]),
    )
    pairing.add_frame(0, np.zeros(1))
    node._update()
    assert seen == [0, 1, 300] and pairing.dropped == 0


def test_gaps_in_a_burst_cost_no_frame(graph: Graph) -> None:
    """Each frame is far beyond the timeout of the one before, so an action that is read after both seems lost."""
    graph.start_run()
    steps = list(range(0, 60_000, 300))
    for step in steps:
        if step > 0:
            graph.action(step - 1)
        graph.frame(step)
    graph.wait_for_step(steps[-1])
    assert graph.steps() == list(itertools.pairwise(steps))


def test_reset_of_local_node_is_a_new_origin(graph: Graph) -> None:
    graph.finish_run(frames=4)
    response = graph.probe.call(Reset, "local_node/reset", Reset.Request())
    assert (response.success, response.message) == (True, "the next image is the new origin of the odometry")
    graph.play(4, 5, 6)
    graph.wait_for_step(6)
    assert graph.steps()[-2:] == [(4, 5), (5, 6)]
    assert to_ns(graph.out.relative_poses[-1].origin_stamp) == graph.stamp_ns(4)


def test_of_two_cameras_on_one_topic_the_first_is_held_and_both_are_named(graph: Graph) -> None:
    graph.diagnostics.clear()
    graph.start_run()
    graph.play(*range(3))
    graph.wait_for_step(2)
    second = Probe("second_camera")
    images = second.node.create_publisher(Image, "image", 100)
    try:
        second.spin_until(lambda: images.get_subscription_count() == 1, "a match")
        with graph.probe.patient("local_node", SOURCE_TIMEOUT_S):
            step, both = 2, "/probe and /second_camera publish on '/image'"

            def named() -> bool:
                nonlocal step
                step += 1
                graph.play(step)
                images.publish(image_message(scan(1000 + step), graph.stamp_ns(step) + 1 - RUN_NS * (step % 2)))
                graph.wait_for_step(step)
                # The node may hear of a publisher before it hears of its name.
                return step >= 19 and f"dropped message on image: {both}" in graph.local.log

            graph.probe.spin_until(named, "a warning that names both")
        assert graph.steps() == [(k, k + 1) for k in range(step)]
        for estimate, message in zip(graph.expected(*range(step + 1)), graph.out.relative_poses, strict=True):
            np.testing.assert_allclose(message.odom_x, estimate.odom_xyyaw[0], atol=1e-6)
        graph.diagnostics.wait_for_problem("/local_node", both)
    finally:
        second.node.destroy_publisher(images)
        second.close()


def test_an_image_publisher_of_another_qos_is_named(graph: Graph) -> None:
    other = Probe("careless_camera")
    best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = other.node.create_publisher(Image, "image", best_effort)
    try:
        misfit = "QoS does not fit, best effort publisher and reliable subscription"
        graph.local.wait_for_log(f"nothing comes from /careless_camera on '/image': {misfit}")
    finally:
        other.node.destroy_publisher(publisher)
        other.close()
    graph.finish_run(frames=3)


def test_of_two_local_nodes_the_first_is_held_and_both_are_named(graph: Graph, parameters: dict[str, Any]) -> None:
    """Started twice by mistake: ngo_node used to begin anew with every message."""
    graph.diagnostics.clear()
    graph.start_run()
    graph.play(0, 1, 2)
    graph.wait_for_step(2)
    restarts = graph.ngo.log.count("restarted, so")
    twin = {**parameters, "image_reliability": "reliable", "image_depth": 1000, "publish_odometry": False}
    with NodeProcess("ngo_estimator", "local_node", {**twin, "publish_tf": False}, ("-r", "__node:=twin")) as process:
        process.wait_for_log("ready")
        graph.probe.spin_until(
            lambda: graph.images.get_subscription_count() == 2 and graph.actions.get_subscription_count() == 2,
            "the twin's subscriptions",
        )
        # The twin listens to images, and ngo_node's subscription knows the twin.
        step = 3

        def refused() -> bool:
            nonlocal step
            graph.play(step)
            graph.probe.spin_until(
                lambda: to_ns(graph.out.poses[-1].header.stamp) == graph.stamp_ns(step), f"the pose of step {step}"
            )
            step += 1
            return "/local_node and /twin publish on '/relative_pose'" in graph.ngo.log

        with graph.probe.patient("ngo_node", SOURCE_TIMEOUT_S):
            graph.probe.spin_until(refused, "a warning that names both")
        graph.diagnostics.wait_for_problem("/ngo_node", "/local_node and /twin publish on '/relative_pose'")
    assert graph.ngo.log.count("restarted, so") == restarts
    assert [to_ns(pose.header.stamp) for pose in graph.out.poses] == [graph.stamp_ns(k) for k in range(1, step)]


def test_an_error_of_the_node_itself_drops_one_frame_and_the_node_lives(
    parameters: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this process, where the core can be made to fail once."""
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    reliable = ("-p", "image_reliability:=reliable", "-p", "image_depth:=100")
    rclpy.init(args=["--ros-args", "-r", "__ns:=/broken", *given, *reliable])
    node, executor = LocalNode(), SingleThreadedExecutor()
    executor.add_node(node)
    assert isinstance(node._input, ImageInput)
    core = node._input._core
    update_all, broken_ns = core.update_all, RUN_NS + 2 * STEP_NS

    def update_or_fail(pairs: list[PairedFrame]) -> Any:
        if broken_ns in {pair.stamp_ns for pair in pairs}:
            raise RuntimeError("of two\nlines")
        return update_all(pairs)

    monkeypatch.setattr(core, "update_all", update_or_fail)
    try:
        with Probe("broken") as probe:
            images = probe.node.create_publisher(Image, "/broken/image", 100)
            actions = probe.node.create_publisher(DiscreteAction, "/broken/action", 100)
            relative_poses = probe.collect(RelativePose, "/broken/relative_pose")
            diagnostics = Diagnostics(probe)

            def spin_until(condition: Callable[[], object], what: str) -> None:
                probe.spin_until(lambda: executor.spin_once(timeout_sec=0.01) or condition(), what)

            ends = images, actions, node._relative_pose
            spin_until(lambda: all(end.get_subscription_count() for end in ends), "both sides' subscriptions")
            for step in range(6):
                action = DiscreteAction(action=0)
                action.header.stamp = to_time(RUN_NS + step * STEP_NS)
                actions.publish(action)
                images.publish(image_message(scan(step), RUN_NS + step * STEP_NS))
            last_ns = RUN_NS + 5 * STEP_NS
            spin_until(lambda: relative_poses and to_ns(relative_poses[-1].header.stamp) == last_ns, "the last step")
            assert broken_ns not in {to_ns(message.header.stamp) for message in relative_poses}

            dropped = "dropped: message on 'image'"
            spin_until(lambda: diagnostics.values("/broken/local_node").get(dropped) == "1", "the frame in diagnostics")
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def test_a_killed_local_node_that_comes_back_begins_a_new_odometry(parameters: dict[str, Any]) -> None:
    """What moved meanwhile is unknown, and nothing is made up for it."""
    with Probe("returning") as probe:
        local = {**parameters, "image_reliability": "reliable", "image_depth": 1000}
        arguments = ("-r", "__ns:=/returning")
        with ExitStack() as stack:
            ngo = stack.enter_context(NodeProcess("ngo_estimator", "ngo_node", parameters, arguments))
            images = probe.node.create_publisher(Image, "/returning/image", 1000)
            actions = probe.node.create_publisher(DiscreteAction, "/returning/action", 1000)
            relative_poses = probe.collect(RelativePose, "/returning/relative_pose")
            poses = probe.collect(PoseWithCovarianceStamped, "/returning/ngo/pose")
            ngo.wait_for_log("ready")
            step = 0

            def drive_until_heard(after_ns: int) -> int:
                """Until there are poses of an odometry that began later; returns when it did."""

                def origin_ns() -> int:
                    return to_ns(relative_poses[-1].origin_stamp) if relative_poses else 0

                def heard() -> bool:
                    nonlocal step
                    stamp = to_time(RUN_NS + step * STEP_NS)
                    actions.publish(DiscreteAction(header=Image().header.__class__(stamp=stamp), action=0))
                    step += 1
                    images.publish(image_message(scan(step), RUN_NS + step * STEP_NS))
                    return origin_ns() > after_ns and bool(poses) and to_ns(poses[-1].header.stamp) > origin_ns()

                probe.spin_until(heard, "relative poses")
                return origin_ns()

            with NodeProcess("ngo_estimator", "local_node", local, arguments) as process:
                first_ns = drive_until_heard(0)
                process.send(signal.SIGKILL)
                process.wait()
            stack.enter_context(NodeProcess("ngo_estimator", "local_node", local, arguments))
            assert drive_until_heard(first_ns) > first_ns
            ngo.wait_for_log("the relative poses have a new origin: their source restarted")
            assert "only the first that was heard" not in ngo.log
