"""What arrives broken at local_node, and what becomes of it at the end of the chain: real processes over DDS.

Lost, doubled, late and unusable images are in `test_estimator_nodes.py`; here are those who publish them.
"""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import torch
from ngo_msgs.msg import DiscreteAction, RelativePose
from ngo_msgs.srv import Reset
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image

from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.frontend.camera.frame_pairing import PairedFrame
from ngo_estimator.nodes.image_input import ImageInput
from ngo_estimator.nodes.local_node import LocalNode
from ngo_estimator.nodes.messages import to_ns, to_time

from .estimator_graph import RUN_NS, STEP_NS, Graph, image_message, scan
from .processes import Diagnostics, NodeProcess, Probe

pytestmark = pytest.mark.processes

SOURCE_TIMEOUT_S = 0.5


@pytest.fixture(scope="module")
def parameters(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
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


def test_a_camera_that_was_away_leaves_a_gap_with_a_large_covariance(graph: Graph) -> None:
    """Killed and back half a minute later: the odometry goes on, and says how little it knows of the time between."""
    graph.diagnostics.clear()
    graph.start_run()
    graph.play(*range(6))
    graph.action(299)
    graph.play(*range(300, 305))
    graph.wait_for_step(304)
    frames = [*range(6), *range(300, 305)]
    assert graph.steps() == list(itertools.pairwise(frames))
    std = [np.sqrt(np.array(message.covariance).reshape(3, 3).diagonal()) for message in graph.out.relative_poses]
    assert (std[5] > 100 * np.array([0.1, 0.02, 0.05])).all(), "294 frames are missing"
    assert (std[5] > 10 * std[4]).all()
    corrected = [np.sqrt(pose.pose.covariance[0]) for pose in graph.out.poses]
    assert corrected[5] > 20.0 > corrected[4]
    graph.diagnostics.wait_for_problem("/local_node", "294 frames missing between images")
    graph.diagnostics.wait_for_problem("/ngo_node", "lost: the standard deviation of the position is")


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
    with Probe("second_camera") as second:
        images = second.node.create_publisher(Image, "image", 100)
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
