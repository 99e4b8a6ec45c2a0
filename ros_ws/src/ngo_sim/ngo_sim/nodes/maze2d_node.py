"""Node `maze2d`: the 2D world as a row image of colour and depth, and as a laser scan."""

from __future__ import annotations

import array
import math
import sys

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image, LaserScan

from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.nodes.process import run_simulator
from ngo_sim.nodes.simulator_node import SimulatorNode
from ngo_sim.simulation import Frame, World
from ngo_sim.simulator_config import SimulatorConfig


class Maze2DNode(SimulatorNode):
    """Publishes `image` (32FC4, one row: red, green, blue in [0, 1] and depth in m, leftmost ray first) and `scan`.

    A LaserScan runs counter-clockwise, so its index 0 is the rightmost ray. There is no camera_info: 300 degrees are
    no pinhole camera, and the scan's angle_min and angle_increment say where every column looks.
    """

    world_config_type = Maze2DConfig
    defaults = {"rate": 10.0}

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._scan = self.outputs.create(LaserScan, "scan")
        self._image = self.outputs.create(Image, "image")
        self.sensor = self._image.publisher

    def make_world(self) -> World:
        """The world of the parameters."""
        self._world = Maze2D(self.world_config)
        return self._world

    def publish_sensors(self, frame: Frame, stamp: Time) -> None:
        """Publish the scan and the image of a frame."""
        angles = self._world.ray_angles_rad
        scan = LaserScan(
            angle_min=angles[-1],
            angle_max=angles[0],
            angle_increment=angles[0] - angles[1],
            scan_time=self._world.period_s,
            range_max=math.hypot(*self._world.maze.size_m),
        )
        scan.header.stamp, scan.header.frame_id = stamp, self.framed(self.config.base_frame)
        scan.ranges = array.array("f", frame.observation[::-1, 3].tobytes())
        self._scan.publish(scan)
        rays, channels = frame.observation.shape
        image = Image(
            height=1, width=rays, encoding="32FC4", step=rays * channels * 4, is_bigendian=sys.byteorder == "big"
        )
        image.header.stamp, image.header.frame_id = stamp, self.framed(self.config.camera_frame)
        image.data = array.array("B", frame.observation.tobytes())
        self._image.publish(image)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_simulator(Maze2DNode, "maze2d", (SimulatorConfig, Maze2DConfig), args, **Maze2DNode.defaults)


if __name__ == "__main__":
    sys.exit(main())
