"""The corrected trajectory in the forms that cost more the longer it is."""

from typing import TYPE_CHECKING

from nav_msgs.msg import Path
from ngo_msgs.msg import Trajectory
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node
from rclpy.publisher import Publisher
from visualization_msgs.msg import MarkerArray

from ngo_estimator.nodes.messages import loop_markers, trajectory_message
from ngo_estimator.nodes.path_message import PathWriter

if TYPE_CHECKING:
    from ngo_estimator.online_trajectory import OnlineTrajectory, TrajectoryUpdate

_DEPTH = 10
_FIRST_POSES = 2


class TrajectoryPublishers:
    """Publishes a path, a flat trajectory and the loops, each made only while somebody subscribes to it.

    A subscriber that comes later gets the newest ones at once.
    """

    def __init__(self, node: Node, frame_id: str, path_topic: str, trajectory_topic: str, loops_topic: str) -> None:
        """Publish on the three topics, with poses in ``frame_id``."""
        self._node = node
        self._frame_id = frame_id
        self._writer = PathWriter(frame_id)
        self._core: OnlineTrajectory | None = None
        self._path = self._create(Path, path_topic)
        self._trajectory = self._create(Trajectory, trajectory_topic)
        self._loops = self._create(MarkerArray, loops_topic)

    def publish(self, core: "OnlineTrajectory", update: "TrajectoryUpdate | None") -> None:
        """Publish the trajectory of ``core`` after ``update`` to those who listen or come before the next one."""
        self._core = core
        # Loops only move when the optimizer ran; the first poses of a trajectory delete those of the last
        # one.
        loops_changed = update is not None and (update.optimized or update.frames == _FIRST_POSES)
        for publisher in (self._path, self._trajectory, *((self._loops,) if loops_changed else ())):
            if publisher.get_subscription_count():
                self._send_latest(publisher)

    def _create(self, message_type: type, name: str) -> Publisher:
        def on_matched(info: QoSPublisherMatchedInfo) -> None:
            if info.current_count_change > 0:
                self._send_latest(publisher)

        events = PublisherEventCallbacks(matched=on_matched)
        publisher = self._node.create_publisher(message_type, name, _DEPTH, event_callbacks=events)
        return publisher

    def _send_latest(self, publisher: Publisher) -> None:
        trajectory = None if self._core is None else self._core.trajectory()
        if trajectory is None:
            return
        if publisher is self._path:
            stamps_ns = trajectory.stamps_ns
            publisher.publish(self._writer.write(int(stamps_ns[-1]), stamps_ns, trajectory.poses_xyyaw))
        elif publisher is self._trajectory:
            publisher.publish(trajectory_message(trajectory, self._frame_id))
        else:
            publisher.publish(loop_markers(trajectory, self._frame_id))
