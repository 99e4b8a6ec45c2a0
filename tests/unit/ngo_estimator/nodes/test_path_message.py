"""The fast path writer says the same as a Path built pose by pose."""

import numpy as np
import pytest
from nav_msgs.msg import Path
from rclpy.serialization import deserialize_message

from ngo_estimator.nodes.path_message import PathWriter, plain_path


def trajectory(frames: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Stamps over several seconds and days, and poses, of `frames` frames."""
    stamps_ns = np.cumsum(rng.integers(1, 10**14, frames)).astype(np.int64)
    return stamps_ns, rng.normal(0.0, 10.0, (frames, 3))


@pytest.mark.parametrize("frame_id", ["map", "m", "mapp", "a_long_frame/of_many_parts", "käfig"])
def test_equals_the_plain_message_for_every_length_in_any_order(frame_id: str) -> None:
    rng = np.random.default_rng(0)
    writer = PathWriter(frame_id)
    for frames in [*range(51), 2000, 2, 50, 0, 1, 777]:
        stamps_ns, poses_xyyaw = trajectory(frames, rng)
        read = deserialize_message(writer.write(10**18 + 5, stamps_ns, poses_xyyaw), Path)
        assert read == plain_path(frame_id, 10**18 + 5, stamps_ns, poses_xyyaw), frames


def test_two_messages_share_no_memory() -> None:
    rng = np.random.default_rng(1)
    writer = PathWriter("map")
    stamps_ns, poses_xyyaw = trajectory(5, rng)
    first = writer.write(1, stamps_ns, poses_xyyaw)
    writer.write(2, stamps_ns + 7, poses_xyyaw + 1.0)
    assert deserialize_message(first, Path) == plain_path("map", 1, stamps_ns, poses_xyyaw)
