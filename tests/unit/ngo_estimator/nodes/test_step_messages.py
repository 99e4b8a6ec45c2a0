"""The fast messages of a step are those made object by object, to the last byte."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.nodes.step_messages import TYPES, StepMessages
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate


@pytest.mark.parametrize("frames", [("base_link", "odom", "map"), ("b", "my_robot/odom", "käfig")])
def test_equal_the_plain_messages_for_each_step(frames: tuple[str, str, str]) -> None:
    store, rng, nothing = get_typestore(Stores.ROS2_JAZZY), np.random.default_rng(20000), np.zeros(0, np.float32)

    def serialised(message: object, type_name: str) -> bytes:
        return bytes(store.serialize_cdr(message, type_name))

    writer = StepMessages(*frames, serialised)
    for number in range(20):
        begin_ns, end_ns = np.sort(rng.integers(1, 2 * 10**18, 2)).tolist()
        root, poses = rng.normal(size=(3, 3, 3)), rng.normal(0.0, 10.0, (5, 3))
        odometry, step_covariance, covariance = root @ root.mT
        robot = poses[4] if number % 2 else None
        step = RelativeStep(
            end_ns, begin_ns, poses[0], step_covariance, 0, poses[1], nothing, nothing, robot_odom_xyyaw=robot
        )
        update = TrajectoryUpdate(end_ns, poses[2], covariance, poses[3], 2, False, False, False, 0.0, 0, 0.0, "")
        plain = writer.plain(step, odometry, update)
        assert writer.of(step, odometry, update) == {
            topic: serialised(message, TYPES[topic]) for topic, message in plain.items()
        }
