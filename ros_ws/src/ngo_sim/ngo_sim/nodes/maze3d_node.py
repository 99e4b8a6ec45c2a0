"""Node `maze3d`: the 3D world, a maze or a Doom map, as colour pictures of a pinhole camera."""

from __future__ import annotations

import array
import contextlib
import os
import sys

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, Transform, TransformStamped
from sensor_msgs.msg import CameraInfo, Image

from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.nodes.process import run_simulator
from ngo_sim.nodes.simulator_node import SimulatorNode
from ngo_sim.simulation import Frame, World
from ngo_sim.simulator_config import SimulatorConfig

# An optical frame looks along z, with x to the right and y down (REP-103).
_BASE_FROM_OPTICAL = Quaternion(x=-0.5, y=0.5, z=-0.5, w=0.5)


class Maze3DNode(SimulatorNode):
    """Publishes `image` (rgb8) and `camera_info`: a pinhole at the middle of the robot, without distortion.

    The two focal lengths differ: Doom's pixels are higher than wide. The camera's pose on the robot is on `/tf_static`.
    """

    world_config_type = Maze3DConfig
    defaults = {"rate": 17.5, "camera_frame": "camera_optical_frame"}

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._camera_info = self.outputs.create(CameraInfo, "camera_info")
        self._image = self.outputs.create(Image, "image")
        self.sensor = self._image.publisher
        config: Maze3DConfig = self.world_config
        focal_x, focal_y = config.focal_lengths_px
        # The middle of the picture, where the centre of pixel 0 is 0.
        center_x, center_y = (config.width - 1) / 2, (config.height - 1) / 2
        self._camera = CameraInfo(
            width=config.width,
            height=config.height,
            distortion_model="plumb_bob",
            d=[0.0] * 5,
            k=[focal_x, 0.0, center_x, 0.0, focal_y, center_y, 0.0, 0.0, 1.0],
            r=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p=[focal_x, 0.0, center_x, 0.0, 0.0, focal_y, center_y, 0.0, 0.0, 0.0, 1.0, 0.0],
        )

    def make_world(self) -> World:
        """The world of the parameters."""
        # The engine is a child process. An engine that outlives a killed node must not keep the lock files of DDS,
        # which would disturb every later process.
        for descriptor in map(int, os.listdir("/proc/self/fd")):
            if descriptor > 2:
                with contextlib.suppress(OSError):  # the listing's own is closed by now
                    os.set_inheritable(descriptor, False)
        return Maze3D(self.world_config)

    def static_transforms(self) -> list[TransformStamped]:
        """The camera on the robot, beside those of every simulator."""
        transforms = super().static_transforms()
        if self.config.camera_frame != self.config.base_frame:
            mounted = TransformStamped(child_frame_id=self.framed(self.config.camera_frame))
            mounted.header.frame_id = self.framed(self.config.base_frame)
            mounted.transform = Transform(rotation=_BASE_FROM_OPTICAL)
            transforms.append(mounted)
        return transforms

    def publish_sensors(self, frame: Frame, stamp: Time) -> None:
        """Publish the camera's description and the picture of a frame."""
        self._camera.header.stamp, self._camera.header.frame_id = stamp, self.framed(self.config.camera_frame)
        self._camera_info.publish(self._camera)
        height, width, channels = frame.observation.shape
        image = Image(header=self._camera.header, height=height, width=width, encoding="rgb8", step=width * channels)
        image.data = array.array("B", frame.observation.tobytes())
        self._image.publish(image)


def main(args: list[str] | None = None) -> int:
    """Run the node; returns the exit code."""
    return run_simulator(Maze3DNode, "maze3d", (SimulatorConfig, Maze3DConfig), args, **Maze3DNode.defaults)


if __name__ == "__main__":
    sys.exit(main())
