"""The corrected trajectory as messages whose cost grows with its length."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from nav_msgs.msg import Path
from ngo_msgs.msg import Trajectory
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher
from rclpy.timer import Timer
from visualization_msgs.msg import MarkerArray

from ngo_common.nodes.qos import overridable
from ngo_estimator.nodes.loop_message import LoopMarkerWriter
from ngo_estimator.nodes.messages import trajectory_message
from ngo_estimator.nodes.path_message import PathWriter
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.slam.publication_pace import PublicationPace

if TYPE_CHECKING:
    from ngo_estimator.slam.trajectory_update import Trajectory as WholeTrajectory

_DEPTH = 10


class TrajectoryPublishers:
    """Publishes a path, a flat trajectory and the loops, each only while it has subscribers.

    A change is published at once, or after the period of the highest rate. A subscriber that comes later gets the
    newest messages at once.
    """

    def __init__(
        self,
        node: LifecycleNode,
        settings: NgoNodeSettings,
        snapshot: Callable[[], "WholeTrajectory | None"],
        robots: int = 1,
    ) -> None:
        """Publish ``snapshot()`` on the three topics of ``settings``; it is that of one of so many ``robots``."""
        self._node, self._robots = node, robots
        self._snapshot = snapshot
        self.use_map(settings.framed(settings.map_frame))
        self._path = self._create(Path, settings.path_topic)
        self._trajectory = self._create(Trajectory, settings.trajectory_topic)
        self._loops = self._create(MarkerArray, settings.loops_topic)
        self._outdated: set[LifecyclePublisher] = set()
        self.paths = 0
        """How many paths were published."""
        self._timer: Timer | None = None
        self.set_rate(settings.path_rate_hz)

    def use_map(self, frame: str) -> None:
        """Publish in a map's frame from now on."""
        self._frame_id = frame
        self._writer, self._loop_writer = PathWriter(frame), LoopMarkerWriter(frame)

    def close(self) -> None:
        """Publish no more."""
        self._end_timer()
        for publisher in (self._path, self._trajectory, self._loops):
            self._node.destroy_lifecycle_publisher(publisher)

    def set_rate(self, rate_hz: float) -> None:
        """Set the highest rate; 0: after every change."""
        self._end_timer()
        self._pace = PublicationPace(rate_hz, self._robots)
        if rate_hz > 0.0:
            steady = Clock(clock_type=ClockType.STEADY_TIME)
            self._timer = self._node.create_timer(1.0 / rate_hz, self._publish_if_due, clock=steady)

    def changed(self, loops: bool) -> None:
        """The trajectory has changed, and with it the loops, or not."""
        self._outdated |= {self._path, self._trajectory, *((self._loops,) if loops else ())}
        self._publish_if_due()

    def _publish_if_due(self) -> None:
        if not self._outdated or not self._pace.is_due(time.monotonic()):
            return
        started = time.monotonic()
        wanted = [publisher for publisher in self._outdated if publisher.get_subscription_count()]
        self._outdated.clear()
        self._send(wanted)
        self._pace.published(started, time.monotonic())

    def _create(self, message_type: type, name: str) -> LifecyclePublisher:
        def on_matched(info: QoSPublisherMatchedInfo) -> None:
            if info.current_count_change > 0:
                self._send([publisher])

        events = PublisherEventCallbacks(matched=on_matched)
        publisher = self._node.create_lifecycle_publisher(
            message_type, name, _DEPTH, event_callbacks=events, qos_overriding_options=overridable()
        )
        return publisher

    def _send(self, publishers: list[LifecyclePublisher]) -> None:
        trajectory = self._snapshot() if publishers else None
        if trajectory is None:
            return
        stamps_ns = trajectory.stamps_ns
        for publisher in publishers:
            if publisher is self._path:
                self.paths += 1
                publisher.publish(self._writer.write(int(stamps_ns[-1]), stamps_ns, trajectory.poses_xyyaw))
            elif publisher is self._trajectory:
                publisher.publish(trajectory_message(trajectory, self._frame_id))
            else:
                publisher.publish(self._loop_writer.write(trajectory))

    def _end_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None
