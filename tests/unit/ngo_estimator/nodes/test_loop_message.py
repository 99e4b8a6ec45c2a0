"""The fast writer of loops says the same as a MarkerArray built point by point."""

import numpy as np
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from visualization_msgs.msg import Marker, MarkerArray

from ngo_estimator.nodes.loop_message import LoopMarkerWriter, loop_colors, plain_loops
from ngo_estimator.slam.trajectory_update import Trajectory


def trajectory(loops: int, frames: int = 500) -> Trajectory:
    """A trajectory with so many loops, some of them with weights beyond 0 and 1."""
    rng = np.random.default_rng(loops)
    return Trajectory(
        stamps_ns=np.arange(1, frames + 1) * 1_500_000_001,
        poses_xyyaw=rng.normal(0.0, 10.0, (frames, 3)),
        odometry_xyyaw=rng.normal(size=(frames, 3)),
        online_xyyaw=rng.normal(size=(frames, 3)),
        moved_m=rng.random(frames),
        loops=rng.integers(0, frames, (loops, 2)),
        odometry_std=rng.random((frames - 1, 3)),
        loop_weights=rng.uniform(-0.5, 1.5, loops),
        loop_relative_xyyaw=rng.normal(size=(loops, 3)),
        loop_std=rng.random((loops, 3)),
    )


@pytest.mark.parametrize("frame_id", ["map", "m", "mapp", "a_long_frame/of_many_parts", "käfig"])
def test_equals_the_plain_message_for_any_number_of_loops(frame_id: str) -> None:
    writer = LoopMarkerWriter(frame_id)
    for loops in (3, 1, 512, 0, 2):
        given = trajectory(loops)
        read = deserialize_message(writer.write(given), MarkerArray)
        ends, stamp_ns = given.poses_xyyaw[given.loops.reshape(-1), :2], int(given.stamps_ns[-1])
        plain = plain_loops(frame_id, stamp_ns, ends, np.repeat(loop_colors(given.loop_weights), 2, axis=0))
        assert read == deserialize_message(serialize_message(plain), MarkerArray), loops
        (marker,) = read.markers
        assert marker.action == (Marker.ADD if loops else Marker.DELETE)
        assert (marker.type, marker.header.frame_id) == (Marker.LINE_LIST, frame_id)
        assert [(point.x, point.y) for point in marker.points] == [tuple(end) for end in ends.tolist()]


def test_what_is_thought_of_a_loop_shows_in_its_color() -> None:
    believed, faint, doubted, refused = loop_colors(np.array((1.0, 0.6, 0.3, 0.0)))
    assert believed[2] == faint[2] == max(believed[:3]) and (believed[3], faint[3]) == (1.0, 0.6)  # blue
    assert doubted[0] == max(doubted[:3]) and doubted[1] > 0.5 > refused[1]  # orange and red
    assert refused[0] == max(refused[:3]) and doubted[3] == refused[3] > 0.0
