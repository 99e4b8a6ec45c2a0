"""Two whole robots in one domain: simulator, local_node and ngo_node each, in a namespace of their own."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import torch
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import RelativePose
from tf2_msgs.msg import TFMessage

from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.nodes.messages import relative_step, to_ns
from ngo_estimator.slam.online_trajectory import OnlineTrajectory

from .processes import NodeProcess, Probe

pytestmark = [pytest.mark.processes, pytest.mark.slow]

FRAMES = 30
ROBOTS = ("red", "blue")


def placed(message: TFMessage) -> tuple[str, str, int]:
    """The two frames of a transform, and its stamp in ns."""
    (transform,) = message.transforms
    return transform.header.frame_id, transform.child_frame_id, to_ns(transform.header.stamp)


def test_two_robots_drive_at_once(tmp_path: Path) -> None:
    """Each pose is what the core makes of that robot's own relative poses; on /tf the prefix tells them apart."""
    torch.manual_seed(0)
    write_untrained(tmp_path, "maze2d")
    with Probe() as probe:
        steps = {name: probe.collect(RelativePose, f"/{name}/relative_pose", 5000) for name in ROBOTS}
        poses = {name: probe.collect(PoseWithCovarianceStamped, f"/{name}/ngo/pose", 5000) for name in ROBOTS}
        transforms = probe.collect(TFMessage, "/tf", 5000)
        mazes: dict[str, dict[str, object]] = {}
        with ExitStack() as stack:
            for seed, name in enumerate(ROBOTS):
                shared = {"world": "maze2d", "weights": str(tmp_path), "frame_prefix": f"{name}/"}
                local = {**shared, "image_reliability": "reliable", "image_depth": 100}
                # At rate 0 it waits for its own two estimators, and publishes no frame that they do not take.
                maze = {
                    "frame_prefix": f"{name}/",
                    "seed": seed,
                    "frames": FRAMES,
                    "rate": 0.0,
                    "wait_for_subscribers": 1,
                    "wait_for_flow_control": True,
                }
                for executable, parameters in (("ngo_node", shared), ("local_node", local)):
                    stack.enter_context(NodeProcess("ngo_estimator", executable, parameters, ("-r", f"__ns:=/{name}")))
                mazes[name] = maze
            # Simulators wait for their own estimators alone: these and the probe must have found each other before.
            probe.meet(*(f"/{name}/{node}" for name in ROBOTS for node in ("local_node", "ngo_node")))
            for name, maze in mazes.items():
                stack.enter_context(NodeProcess("ngo_sim", "maze2d", maze, ("-r", f"__ns:=/{name}")))
            each = (*poses.values(), *steps.values())
            probe.spin_until(lambda: all(len(found) == FRAMES - 1 for found in each), "every pose of both")
            # Another one of the same frame comes where an optimisation ends by itself.
            probe.spin_until(lambda: len(set(map(placed, transforms))) == 4 * (FRAMES - 1), "every transform of both")
        core = OnlineTrajectory.load(tmp_path, iterations_per_step=1)  # as ngo_node by default
        for name in ROBOTS:
            core.reset()
            for message, pose in zip(steps[name], poses[name], strict=True):
                update = core.update(relative_step(message))
                assert (to_ns(pose.header.stamp), pose.header.frame_id) == (update.stamp_ns, f"{name}/map")
                position = pose.pose.pose.position
                np.testing.assert_allclose((position.x, position.y), update.pose_xyyaw[:2], atol=1e-5)
            frames = {placed(message)[:2] for message in transforms}
            assert {(f"{name}/map", f"{name}/odom"), (f"{name}/odom", f"{name}/base_link")} <= frames
        assert len(frames) == 4
        red, blue = (np.array([[m.x, m.y, m.yaw] for m in steps[name]]) for name in ROBOTS)
        assert np.abs(red - blue).max() > 1e-6, "they see different mazes"
