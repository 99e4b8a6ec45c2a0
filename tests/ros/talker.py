"""A node with known topics and parameters, run as its own process by the tests of the `ros2` stand-in."""

import contextlib
import sys

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Path
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image
from std_msgs.msg import Header
from std_srvs.srv import SetBool

RATE_HZ = 20.0


class Talker(LifecycleNode):
    """Publishes a header 20 times a second, and an image, a path and a status once, latched."""

    def __init__(self) -> None:
        super().__init__("talker", namespace="test")
        self.declare_parameter("speed", 7)
        self.declare_parameter("gain", 0.5)
        self.declare_parameter("frame", "base_link")
        self.declare_parameter("enabled", True)
        self.declare_parameter("steps", [1, 2, 3])
        self.declare_parameter("names", ["a", "b"])
        self.add_on_set_parameters_callback(self._check)
        best_effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._headers = self.create_publisher(Header, "header", best_effort)
        self._hidden = self.create_publisher(Header, "_secret", best_effort)
        self._image = self.create_publisher(Image, "image", latched)
        self._path = self.create_publisher(Path, "path", latched)
        self._status = self.create_publisher(DiagnosticStatus, "status", latched)
        image = Image(height=2, width=100, encoding="mono8", step=100, data=bytes(range(200)))
        self._image.publish(image)
        self._path.publish(Path(header=Header(frame_id="map")))
        self._status.publish(DiagnosticStatus(level=DiagnosticStatus.WARN, name="größe", message="x" * 200))
        self._count = 0
        self.create_service(SetBool, "mute", self._mute)
        self.create_timer(1.0 / RATE_HZ, self._tick)

    def _tick(self) -> None:
        header = Header(frame_id="odom")
        header.stamp.sec, header.stamp.nanosec = 12, self._count
        self._count += 1
        self._headers.publish(header)

    def _mute(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "as you wish"
        return response

    def _check(self, parameters: list[Parameter]) -> SetParametersResult:
        if any(parameter.name == "gain" and parameter.value > 1.0 for parameter in parameters):
            return SetParametersResult(successful=False, reason="gain is at most 1")
        return SetParametersResult(successful=True)


def main() -> None:
    """Run until told to end."""
    rclpy.init(args=sys.argv)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(Talker())
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
