"""A map as messages: the whole of it, or the part that changed where that is enough."""

from array import array
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import Point, Pose, Quaternion
from map_msgs.msg import OccupancyGridUpdate
from nav_msgs.msg import MapMetaData, OccupancyGrid
from rclpy.event_handler import PublisherEventCallbacks, QoSPublisherMatchedInfo
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header

from ngo_common.nodes.qos import overridable
from ngo_estimator.nodes.messages import to_time

if TYPE_CHECKING:
    from ngo_estimator.mapping.occupancy_grid import OccupancyMap

_UPDATES = "_updates"
_LARGEST_PART = 0.5  # of the whole map: a larger part is sent as the whole


class MapPublisher:
    """Publishes a map, latched, and its changes.

    A small change goes to the topic of updates alone if every subscriber of the map is one of the updates as well. A
    subscriber that comes later gets the newest map at once.
    """

    def __init__(self, node: Node, topic: str, frame: str) -> None:
        self._node, self._frame = node, frame
        self._newest: OccupancyMap | None = None
        self._stamp_ns = 0
        self._outdated = False  # whether the latched map is older than the newest
        self.wholes = 0
        """Whole maps that were published."""
        self.parts = 0
        """Parts of maps that were published."""
        events = PublisherEventCallbacks(matched=self._on_matched)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._map = node.create_publisher(
            OccupancyGrid, topic, latched, event_callbacks=events, qos_overriding_options=overridable()
        )
        self._updates = node.create_publisher(
            OccupancyGridUpdate, topic + _UPDATES, 10, event_callbacks=events, qos_overriding_options=overridable()
        )

    @property
    def topic(self) -> str:
        """The whole name of the map's topic."""
        return str(self._map.topic_name)

    def publish(self, stamp_ns: int, trinary: "OccupancyMap") -> None:
        """Publish what has changed since the last map, if anything has."""
        before, self._newest, self._stamp_ns = self._newest, trinary, stamp_ns
        part = None if before is None else changed_part(before, trinary)
        if part is None:
            self._publish_whole()
            return
        rows, columns = part
        changed = (rows.stop - rows.start) * (columns.stop - columns.start)
        if changed > _LARGEST_PART * trinary.values.size or (changed and not self._all_take_updates()):
            self._publish_whole()
        elif changed:
            self._updates.publish(update_message(stamp_ns, self._frame, trinary, part))
            self._outdated = True
            self.parts += 1

    def _publish_whole(self) -> None:
        if self._newest is not None:
            self._map.publish(grid_message(self._stamp_ns, self._frame, self._newest))
            self._outdated = False
            self.wholes += 1

    def _all_take_updates(self) -> bool:
        """Whether somebody listens to updates, and nobody to maps alone."""
        nodes = [
            {(info.node_namespace, info.node_name) for info in self._node.get_subscriptions_info_by_topic(topic)}
            for topic in (self.topic, self._updates.topic_name)
        ]
        return bool(nodes[1]) and nodes[0] <= nodes[1]

    def _on_matched(self, info: QoSPublisherMatchedInfo) -> None:
        if info.current_count_change > 0 and self._outdated:
            self._publish_whole()


def changed_part(before: "OccupancyMap", after: "OccupancyMap") -> tuple[slice, slice] | None:
    """Rows and columns of the part that differs, empty where none does; None where the extent is another."""
    extents = [(each.resolution_m, *each.values.shape, *each.origin_xy.tolist()) for each in (before, after)]
    if extents[0] != extents[1]:
        return None
    differs = before.values != after.values
    rows, columns = (np.flatnonzero(differs.any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return slice(0, 0), slice(0, 0)
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)


def grid_message(stamp_ns: int, frame: str, whole: "OccupancyMap") -> OccupancyGrid:
    """A whole map in ``frame``."""
    x, y = whole.origin_xy.tolist()
    rows, columns = whole.values.shape
    info = MapMetaData(
        map_load_time=to_time(stamp_ns),
        resolution=whole.resolution_m,
        width=columns,
        height=rows,
        origin=Pose(position=Point(x=x, y=y), orientation=Quaternion(w=1.0)),
    )
    header = Header(stamp=to_time(stamp_ns), frame_id=frame)
    return OccupancyGrid(header=header, info=info, data=array("b", whole.values.tobytes()))


def update_message(stamp_ns: int, frame: str, whole: "OccupancyMap", part: tuple[slice, slice]) -> OccupancyGridUpdate:
    """A part of a map in ``frame``: its rows and columns."""
    rows, columns = part
    return OccupancyGridUpdate(
        header=Header(stamp=to_time(stamp_ns), frame_id=frame),
        x=columns.start,
        y=rows.start,
        width=columns.stop - columns.start,
        height=rows.stop - rows.start,
        data=array("b", whole.values[part].tobytes()),
    )
