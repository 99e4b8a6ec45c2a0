"""How far map -> odom is off where the robot's odometry comes on TF: through a chain, late, or by another clock.

    python -m benchmarks.lidar_tf

Both estimators run live, and a robot drives through a simulated building by wheels that have a bias. The error is that
of the robot's place as others look it up: map -> odom, times the robot's own transforms at its stamp. The last line is
a JSON object of the same numbers.
"""

import json
import math
import sys
import tempfile
import time
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import tyro
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from benchmarks.lidar_depth import WHEELS
from demo.graph import Graph, NodeSpec
from ngo_estimator.geometry.planar_motion import Array, between, compose
from ngo_estimator.nodes.messages import to_ns, to_time, transform_message
from ngo_sim.building2d import Building2d, BuildingDrive
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig

CASES = {
    "in time": (0.0, 0.0),
    "0.4 s late": (0.4, 0.0),
    "2 s late": (2.0, 0.0),
    "clock 0.9 s behind": (0.0, -0.9),
    "clock 5 s ahead": (0.0, 5.0),
    "clock 1.7e9 s ahead": (0.0, 1.7e9),
}
"""How late transforms come, and how far their clock is ahead (s)."""

_SAID = "no map -> odom"
BEGIN_NS = 10**12
_START_S = 180.0
_LIFT = np.array((0.1, 0.0, 0.2))
_LASER = np.array((0.05, 0.05, 0.3))


@dataclass(frozen=True)
class Arguments:
    """What is driven."""

    seed: int = 12  # Building.
    scans: int = 300  # Scans at 10 Hz.


def main(arguments: Arguments) -> int:
    """Print the errors of each case, and after how long it was said that nothing can be known."""
    mounted = compose(_LIFT, _LASER)
    scanner = ScannerConfig(
        rays=720, field_of_view_deg=360.0, range_max_m=12.0,
        laser_x_m=float(mounted[0]), laser_y_m=float(mounted[1]), laser_yaw_deg=math.degrees(mounted[2]),
    )  # fmt: skip
    drive = Building2d(FloorPlanConfig(), scanner, WHEELS).record(arguments.seed, 10_000.0, arguments.scans)
    found = {}
    for name, (late_s, ahead_s) in CASES.items():
        with tempfile.TemporaryDirectory() as logs:
            found[name] = played(drive, late_s, ahead_s, Path(logs))
        print(name, found[name], flush=True)
    print(json.dumps(found))
    return 0


def played(drive: BuildingDrive, late_s: float, ahead_s: float, logs: Path) -> dict[str, Any]:
    """One case live: how many corrections came, their mean and largest error (m), and when their lack was said (s)."""
    events: list[tuple[float, str, Any]] = []
    for k, at_s in enumerate(drive.stamps_s):
        stamp_ns = BEGIN_NS + round(at_s * 1e9)
        tf_ns = stamp_ns + round(ahead_s * 1e9)
        pose = drive.wheel_poses_xyyaw[k]
        events.append((at_s + 0.1, "scan", _scan(drive, k, stamp_ns)))
        events.append((at_s + late_s, "tf", transform_message(tf_ns, "odom", "foot", pose)))
        if k % 2 == 0:  # at 5 Hz
            events.append((at_s + late_s, "tf", transform_message(tf_ns, "base_link", "lift", _LIFT)))
    parameters = {"world": "scan", "image_reliability": "reliable", "robot_odometry": "tf", "base_frame": "base_link"}
    heard: list[tuple[int, Array]] = []
    said_s = None
    with Graph(logs) as graph, Listener(graph, heard) as listener:
        graph.start(NodeSpec("ngo_estimator", "local_node", parameters))
        graph.start(NodeSpec("ngo_estimator", "ngo_node", {"world": "scan", "tf_ahead_s": 0.0}))
        graph.wait_for(listener.is_heard, "both nodes", _START_S, listener.spin)
        begin = time.monotonic()
        for due_s, topic, message in sorted(events, key=lambda event: event[0]):
            while (left := begin + due_s - time.monotonic()) > 0.0:
                listener.spin(left)
            listener.publishers[topic].publish(message)
            if said_s is None and _SAID in (logs / "local_node.log").read_text():
                said_s = round(time.monotonic() - begin, 1)
        until = time.monotonic() + 3.0
        while time.monotonic() < until:
            listener.spin()
    off = [error(drive, stamp_ns, correction, ahead_s) for stamp_ns, correction in heard]
    off = [each for each in off if math.isfinite(each)]
    return {
        "corrections": len(heard),
        "mean_m": round(float(np.mean(off)), 4) if off else None,
        "largest_m": round(max(off), 4) if off else None,
        "said_after_s": said_s,
    }


def error(drive: BuildingDrive, stamp_ns: int, map_from_odom: Array, ahead_s: float) -> float:
    """How far the robot's place by a correction is off (m); no number where its transforms do not reach."""
    at_s, wheels = (stamp_ns - BEGIN_NS) * 1e-9, drive.wheel_poses_xyyaw
    tf_s = at_s - ahead_s
    if not drive.stamps_s[0] <= tf_s <= drive.stamps_s[-1]:
        return math.nan
    odom = np.array([np.interp(tf_s, drive.stamps_s, values) for values in np.unwrap(wheels, axis=0).T])
    true = between(drive.true_poses_xyyaw[0], drive.true_poses_xyyaw[round(at_s * 10.0)])
    return float(np.hypot(*(compose(map_from_odom, odom) - true)[:2]))


class Listener:
    """A node that publishes what a robot does, and takes up map -> odom."""

    def __init__(self, graph: Graph, heard: list[tuple[int, Array]]) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context, domain_id=graph.domain_id)
        self._node = rclpy.create_node("robot", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._heard = heard
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        static = self._node.create_publisher(TFMessage, "/tf_static", latched)
        chain = ("foot", "base_link", np.zeros(3)), ("lift", "laser", _LASER)
        static.publish(TFMessage(transforms=[transform_message(0, *each).transforms[0] for each in chain]))
        self.publishers = {
            "scan": self._node.create_publisher(LaserScan, "scan", 1000),
            "tf": self._node.create_publisher(TFMessage, "/tf", 1000),
        }
        self._node.create_subscription(TFMessage, "/tf", self._on_tf, 1000)

    def __enter__(self) -> "Listener":
        return self

    def __exit__(self, *raised: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def is_heard(self) -> bool:
        """Whether both estimators listen."""
        return self.publishers["scan"].get_subscription_count() == 1 and self._node.count_publishers("ngo/pose") == 1

    def spin(self, timeout_s: float = 0.05) -> None:
        """Take what comes."""
        self._executor.spin_once(timeout_sec=timeout_s)

    def _on_tf(self, message: TFMessage) -> None:
        for each in message.transforms:
            if each.header.frame_id == "map":
                moved, q = each.transform.translation, each.transform.rotation
                pose = np.array((moved.x, moved.y, 2.0 * math.atan2(q.z, q.w)))
                self._heard.append((to_ns(each.header.stamp), pose))


def _scan(drive: BuildingDrive, k: int, stamp_ns: int) -> LaserScan:
    scanner = drive.scanner
    message = LaserScan(angle_increment=scanner.increment_rad, scan_time=scanner.scan_period_s)
    message.header.stamp, message.header.frame_id = to_time(stamp_ns), "laser"
    message.angle_min, message.angle_max = float(scanner.angles_rad[0]), float(scanner.angles_rad[-1])
    message.range_min, message.range_max = scanner.range_min_m, scanner.range_max_m
    message.ranges = array("f", drive.ranges_m[k].astype(np.float32).tobytes())
    return message


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
