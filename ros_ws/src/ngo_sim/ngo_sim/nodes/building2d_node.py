"""Node `building2d`: a robot with a 2D lidar and wheel odometry in a building."""

from __future__ import annotations

import array
import inspect
import math
import sys

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, TransformStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import run_node
from ngo_common.settings import BadParameter, SettingsType, usage
from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.building_node_config import BuildingNodeConfig
from ngo_sim.convex_shapes import Floats
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.nodes.paced_node import PacedNode
from ngo_sim.nodes.velocity_input import VelocityInput
from ngo_sim.simulation import yaw_quaternion_zw
from ngo_sim.wheels import WheelsConfig

_SETTINGS = (BuildingNodeConfig, FloorPlanConfig, BuildingDriverConfig, ScannerConfig, WheelsConfig)


class Building2dNode(PacedNode):
    """Publishes `scan`, wheel odometry, `ground_truth` and `/tf_static`, and on request `/tf` and `/clock`.

    Angles of a scan are in the laser's frame; one that hangs upside down is turned by `/tf_static`. With driver
    `cmd_vel` it takes `cmd_vel` and publishes `collision`.
    """

    published_are = "scans"
    sensor_is = "scan"

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._config = self._declared(BuildingNodeConfig)
        plan, driver = self._declared(FloorPlanConfig), self._declared(BuildingDriverConfig)
        scanner, wheels = self._declared(ScannerConfig), self._declared(WheelsConfig)
        drawn = self.config.draw_robot
        self._building = Building2d(plan, None if drawn else scanner, None if drawn else wheels, driver)
        try:
            self._building.reset(self.config.seed)
        except (ValueError, OSError) as error:  # what only the building, or the file of its plan, can say
            raise BadParameter(str(error)) from None
        config = self.config
        self.open_outputs(config.stamp_ns(0.0))
        self._truth = self.outputs.create(Odometry, "ground_truth")
        self._odometry = self.outputs.create(Odometry, config.wheel_odometry_topic)
        self._tf = self.outputs.create(TFMessage, "/tf") if config.publish_tf else None
        self._clock_out = self.outputs.create(Clock, "/clock") if config.publish_clock else None
        self._scan = self.outputs.create(LaserScan, "scan")
        self.sensor = self._scan.publisher
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._static_tf = self.outputs.create(TFMessage, "/tf_static", latched)
        self._static_tf.publish(TFMessage(transforms=[self._mounting()]))
        building, commanded = self._building, driver.driver == "cmd_vel"
        self._velocity = VelocityInput(self, self.outputs, building.command) if commanded else None

    @property
    def config(self) -> BuildingNodeConfig:
        """How the node runs."""
        return self._config

    def _declared(self, settings_type: type[SettingsType]) -> SettingsType:
        """Declare the parameters of one part; none changes while the node runs."""
        live = LiveSettings(self, settings_type, beside=_SETTINGS)
        live.lock()
        return live.values

    def publish_next(self, now_s: float) -> int:
        """Drive on, and publish the scan; returns its stamp in ns."""
        config, frame = self.config, self._building.step()
        stamp_ns = config.stamp_ns(frame.stamp_s)
        stamp, wheel_stamp = _time(stamp_ns), _time(config.stamp_ns(frame.wheel_stamp_s))
        self.outputs.set_time(stamp_ns)
        if self._clock_out is not None:
            self._clock_out.publish(Clock(clock=stamp))
        wheels = _odometry(
            frame.wheel_pose_xyyaw, wheel_stamp, config.framed(config.odom_frame), config.framed(config.base_frame)
        )
        self._odometry.publish(wheels)
        if self._tf is not None:
            moved = TransformStamped(header=wheels.header, child_frame_id=config.framed(config.base_frame))
            moved.transform.translation.x, moved.transform.translation.y = frame.wheel_pose_xyyaw[:2].tolist()
            moved.transform.rotation = wheels.pose.pose.orientation
            self._tf.publish(TFMessage(transforms=[moved]))
        true_pose, truth_frame = self._building.plan.in_file(frame.true_pose_xyyaw), config.ground_truth_frame
        truth = _odometry(true_pose, stamp, config.framed(truth_frame), config.framed(config.base_frame))
        truth.twist.twist.linear.x, truth.twist.twist.angular.z = frame.twist.tolist()
        self._truth.publish(truth)
        if self._velocity is not None:
            self._velocity.publish(self._building.blocked, true_pose, stamp, config.framed(truth_frame))
        scanner = self._building.scanner
        increment = scanner.increment_rad * (1.0 + scanner.increment_error)
        scan = LaserScan(
            angle_min=float(scanner.angles_rad[0]),
            angle_max=float(scanner.angles_rad[0]) + increment * (scanner.rays - 1),
            angle_increment=increment,
            time_increment=scanner.time_increment_s,
            scan_time=scanner.scan_period_s,
            range_min=scanner.range_min_m,
            range_max=scanner.range_max_m,
        )
        scan.header.stamp, scan.header.frame_id = stamp, config.framed(config.laser_frame)
        scan.ranges = array.array("f", frame.ranges_m.tobytes())
        self._scan.publish(scan)
        return stamp_ns

    def _mounting(self) -> TransformStamped:
        scanner, config = self._building.scanner, self.config
        mounted = TransformStamped(child_frame_id=config.framed(config.laser_frame))
        mounted.header.frame_id, mounted.header.stamp = config.framed(config.base_frame), _time(config.stamp_ns(0.0))
        mounted.transform.translation.x, mounted.transform.translation.y = scanner.laser_x_m, scanner.laser_y_m
        z, w = yaw_quaternion_zw(math.radians(scanner.laser_yaw_deg))
        # Turned over its own x axis first: the product of a turn about z and half a turn about x.
        rotation = Quaternion(x=w, y=z, z=0.0, w=0.0) if scanner.upside_down else Quaternion(z=z, w=w)
        mounted.transform.rotation = rotation
        return mounted


def _time(stamp_ns: int) -> Time:
    return Time(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)


def _odometry(pose_xyyaw: Floats, stamp: Time, frame: str, child: str) -> Odometry:
    message = Odometry(child_frame_id=child)
    message.header.stamp, message.header.frame_id = stamp, frame
    x, y, yaw = pose_xyyaw.tolist()
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.orientation.z, message.pose.pose.orientation.w = yaw_quaternion_zw(yaw)
    return message


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    summary = (inspect.getdoc(Building2dNode) or "").partition("\n\n")[0]
    text = usage("ngo_sim", "building2d", summary, *_SETTINGS)
    return run_node("building2d", lambda: Building2dNode("building2d"), text, lambda node, ended: node.run(ended), args)


if __name__ == "__main__":
    sys.exit(main())
