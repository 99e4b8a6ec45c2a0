"""Two robots and one ngo_node over DDS: each has its own map until they meet, then there is one map."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import RemoveLoop, Reset, SaveGraph
from rclpy.qos import DurabilityPolicy, QoSProfile
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes.messages import relative_pose_message
from ngo_estimator.slam.fleet import Fleet
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.trajectory.g2o import read_g2o
from tests.golden.drives import WEIGHTS
from tests.unit.ngo_estimator.slam.test_fleet import robots

from .processes import Diagnostics, NodeProcess, Probe

pytestmark = pytest.mark.processes

LATCHED = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
NAMES = ("red", "blue")
MOST = 45
"""Relative poses of each robot until they have met, at most."""


@contextmanager
def nodes(probe: Probe, folder: Path) -> Iterator[None]:
    both = {"world": "scan", "robots": list(NAMES)}
    with (
        NodeProcess("ngo_estimator", "ngo_node", {**both, "save_directory": str(folder)}),
        NodeProcess("ngo_estimator", "ngo_map", {**both, "map_update_interval": 0.05, "diagnostics_period_s": 0.2}),
    ):
        probe.meet("/ngo_node", "/ngo_map")
        yield


def frames(message: TFMessage) -> tuple[str, str]:
    (transform,) = message.transforms
    return transform.header.frame_id, transform.child_frame_id


def check_graph_of(probe: Probe, core: Fleet, path: Path) -> None:
    """The graph of both is saved with the way of each, and without the loops that join them blue has its own map."""
    answer = probe.call(SaveGraph, "ngo_node/save_graph", SaveGraph.Request(path=str(path)))
    assert answer.success, answer.message
    saved, graph = read_g2o(path), core.planar_graph()
    assert graph is not None
    np.testing.assert_array_equal(saved.edges, graph.edges)
    np.testing.assert_allclose(saved.poses, graph.poses, atol=1e-4)
    for name in NAMES:
        own, whole = file_interface.read_tum_trajectory_file(path.with_name(f"fleet_{name}.tum")), core.trajectory(name)
        assert whole is not None
        np.testing.assert_allclose(own.positions_xyz[:, :2], whole.poses_xyyaw[:, :2], atol=1e-4)
    of_blue = np.isin(graph.ids, np.flatnonzero(core.core.back_end.graph.stream_of(graph.ids)))
    ends = of_blue[graph.edges]
    between = graph.edges[graph.is_loop & (ends[:, 0] != ends[:, 1])].tolist()
    assert between and between == saved.edges[saved.is_loop & (ends[:, 0] != ends[:, 1])].tolist()
    for first, second in sorted(set(map(tuple, between))):
        request = RemoveLoop.Request(first_id=first, second_id=second)
        answer = probe.call(RemoveLoop, "ngo_node/remove_loop", request)
        assert answer.success, answer.message
    assert not probe.call(RemoveLoop, "ngo_node/remove_loop", request).success
    ids = {"first_id": 0, "second_id": int(graph.ids[-1])}
    answer = probe.call(RemoveLoop, "ngo_node/remove_loop", RemoveLoop.Request(what=RemoveLoop.Request.STRETCH, **ids))
    assert "ends in another" in answer.message


def test_robots_that_meet_are_in_one_map_frame_and_on_one_map_until_a_reset(tmp_path: Path) -> None:
    core = Fleet(ScanTrajectory.load(WEIGHTS / "scan", "scan", iterations_per_step=1), NAMES)  # as ngo_node by default
    with Probe() as probe:
        poses = {name: probe.collect(PoseWithCovarianceStamped, f"/{name}/ngo/pose", 1000) for name in NAMES}
        transforms = probe.collect(TFMessage, "/tf", 1000)
        diagnostics = Diagnostics(probe)
        maps = probe.collect(OccupancyGrid, "/map", LATCHED)
        steps = {name: probe.node.create_publisher(RelativePose, f"/{name}/relative_pose", 2000) for name in NAMES}
        with nodes(probe, tmp_path):
            probe.spin_until(
                lambda: all(publisher.get_subscription_count() == 2 for publisher in steps.values()), "both nodes"
            )
            for k in range(MOST):
                for name in NAMES:
                    step = robots()[name][k]
                    steps[name].publish(relative_pose_message(step, "base_link"))
                    probe.spin_until(lambda name=name, k=k: len(poses[name]) > k, "the pose of a step")  # type: ignore[misc]
                    expected = core.update(name, step)
                    core.correct()
                    frame = "map" if expected.map_of is None else f"{expected.map_of}/map"
                    assert poses[name][k].header.frame_id == frame
                    at = poses[name][k].pose.pose.position
                    np.testing.assert_allclose((at.x, at.y), expected.update.pose_xyyaw[:2], atol=1e-4)
                if frame == "map":  # of both
                    break
            assert poses["blue"][0].header.frame_id == "blue/map" and poses["blue"][-1].header.frame_id == "map"
            expected_frames = {("map", "red/odom"), ("blue/map", "blue/odom"), ("map", "blue/odom")}
            probe.spin_until(lambda: set(map(frames, transforms)) == expected_frames, "the transforms of both")
            # A burst behind a silence, of which three steps were lost, costs nothing but the time.
            burst = robots()["blue"][k + 4 : k + 10]
            for step in burst:
                steps["blue"].publish(relative_pose_message(step, "base_link"))
                expected = core.update("blue", step)
                core.correct()
            probe.spin_until(lambda: len(poses["blue"]) == k + 1 + len(burst), "the poses of a burst")
            assert poses["blue"][-1].header.frame_id == "map"
            at = poses["blue"][-1].pose.pose.position
            np.testing.assert_allclose((at.x, at.y), expected.update.pose_xyyaw[:2], atol=1e-2)
            # What blue saw before is on the map as well.
            diagnostics.wait_for_value("/ngo_map", "scans that wait for their poses", lambda value: value == "0")
            assert maps[-1].header.frame_id == "map"
            assert int(diagnostics.values("/ngo_map")["scans in the map"]) > 1.5 * k
            transforms.clear()
            check_graph_of(probe, core, tmp_path / "fleet.g2o")
            probe.spin_until(lambda: ("blue/map", "blue/odom") in map(frames, transforms), "blue in its own map")
            assert probe.set_parameter("/ngo_node", "initial_pose", [5.0, 0.0, 0.0]) == ""
            assert probe.call(Reset, "ngo_node/reset", Reset.Request()).success
            first = robots()["red"][k + 1]
            for step in (first, robots()["red"][k + 2]):
                steps["red"].publish(relative_pose_message(step, "base_link"))
            probe.spin_until(lambda: len(poses["red"]) == k + 3, "the poses after the reset")
            assert poses["red"][k + 1].pose.pose.position.x == pytest.approx(5.0 + first.relative_xyyaw[0], abs=1e-3)
            diagnostics.wait_for_value("/ngo_map", "scans in the map", lambda value: value == "3")
