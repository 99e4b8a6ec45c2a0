"""What `local_node` says of frames that repeat while the robot is told to move: a real process over DDS."""

from pathlib import Path

import pytest
import torch
from ngo_msgs.msg import DiscreteAction, RelativePose
from sensor_msgs.msg import Image

from ngo_estimator.checkpoint import FAMILIARITY, LOCAL, PLACE, load_local, load_place, save_checkpoint, write_untrained
from ngo_estimator.data.weights_file import load_description
from ngo_estimator.networks.familiarity import Familiarity, FamiliarityConfig, look_size
from ngo_estimator.nodes.messages import to_time

from .estimator_graph import FIRST_RUN_NS, STEP_NS, image_message, scan
from .processes import Diagnostics, NodeProcess, Probe

pytestmark = pytest.mark.processes


def test_frames_that_repeat_are_named_in_diagnostics_and_have_a_large_covariance(tmp_path: Path) -> None:
    torch.manual_seed(0)
    write_untrained(tmp_path, "maze2d")
    encoder, motion_size = load_place(tmp_path)[0].encoder, load_local(tmp_path)[0].config.feature_size
    config = FamiliarityConfig(look_size(encoder), motion_size, actions=3, told_std=(0.01, 0.01, 0.01))
    familiarity = Familiarity(config)
    familiarity.told[-1, 0] = 0.3  # m, whatever is done
    described = {kind: load_description(tmp_path / f"{kind}.safetensors", kind) for kind in (LOCAL, PLACE)}
    hashes = {f"{kind}_sha256": description["sha256"] for kind, description in described.items()}
    save_checkpoint(tmp_path / f"{FAMILIARITY}.safetensors", familiarity, FAMILIARITY, "maze2d", hashes)
    settings = {
        "world": "maze2d",
        "weights": str(tmp_path),
        "diagnostics_period_s": 0.1,
        "image_reliability": "reliable",
        "image_depth": 100,
    }
    with Probe() as probe, NodeProcess("ngo_estimator", "local_node", settings) as node:
        images = probe.node.create_publisher(Image, "image", 100)
        actions = probe.node.create_publisher(DiscreteAction, "action", 100)
        steps = probe.collect(RelativePose, "relative_pose")
        diagnostics = Diagnostics(probe)
        ends = images.get_subscription_count, actions.get_subscription_count
        probe.spin_until(lambda: all(end() for end in ends), "subscriptions")
        probe.meet("local_node")
        for number in range(8):
            stamp = FIRST_RUN_NS + number * STEP_NS
            action = DiscreteAction(action=0)
            action.header.stamp = to_time(stamp)
            actions.publish(action)
            images.publish(image_message(scan(min(number, 4)), stamp))
        probe.spin_until(lambda: len(steps) == 7, "all steps")
        assert [step.unlikeness > 1.0 for step in steps] == [False] * 4 + [True] * 3
        assert min(step.covariance[0] for step in steps[4:]) > 0.1**2
        diagnostics.wait_for_problem("/local_node", "repeat the one before")
        diagnostics.wait_for_value("/local_node", "repeated frames", "3".__eq__)
        assert node.running and "Traceback" not in node.log
