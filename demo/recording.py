"""What the demo records, and when the messages of a topic came."""

from __future__ import annotations

from ngo_sim.flow_control import header_stamp_ns

# Every topic of the graph; the image last, because the simulator waits for its subscribers: by then all others are
# matched.
ALL_TOPICS = {
    "action": "ngo_msgs/msg/DiscreteAction",
    "action_command": "ngo_msgs/msg/DiscreteAction",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "scan": "sensor_msgs/msg/LaserScan",
    "ground_truth": "nav_msgs/msg/Odometry",
    "relative_pose": "ngo_msgs/msg/RelativePose",
    "odom": "nav_msgs/msg/Odometry",
    "ngo/path": "nav_msgs/msg/Path",
    "ngo/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "ngo/trajectory": "ngo_msgs/msg/Trajectory",
    "map": "nav_msgs/msg/OccupancyGrid",
    "ngo/loops": "visualization_msgs/msg/MarkerArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/clock": "rosgraph_msgs/msg/Clock",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
    "/rosout": "rcl_interfaces/msg/Log",
    "image": "sensor_msgs/msg/Image",
}


class StampTimes:
    """Remembers for each header stamp of a topic when its message was published and received: a listener."""

    def __init__(self) -> None:
        self.published_ns: dict[int, int] = {}
        self.received_ns: dict[int, int] = {}
        self.newest_ns = -1

    def __call__(self, cdr: bytes, published_ns: int, received_ns: int) -> None:
        self.newest_ns = header_stamp_ns(cdr)
        self.published_ns[self.newest_ns] = published_ns
        self.received_ns[self.newest_ns] = received_ns
