"""Node that re-optimises the whole trajectory with every relative pose, and publishes it corrected."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import Reset, SaveTrajectory
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from ngo_estimator.nodes import messages
from ngo_estimator.nodes.parameters import declare_settings
from ngo_estimator.nodes.process import run_node
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.trajectory_publishers import TrajectoryPublishers
from ngo_estimator.nodes.weights import load_core
from ngo_estimator.trajectory_file import write_tum

if TYPE_CHECKING:
    from ngo_estimator.online_trajectory import TrajectoryUpdate

NAME = "ngo_node"
_DEPTH = 100


class NgoNode(Node):
    """Subscribes relative poses; publishes the corrected trajectory in several forms, and map -> odom."""

    def __init__(self) -> None:
        super().__init__(NAME, automatically_declare_parameters_from_overrides=True)
        self._settings = settings = declare_settings(self, NgoNodeSettings)
        # Imported here because torch takes seconds: a bad parameter is said at once.
        from ngo_estimator.online_trajectory import OnlineTrajectory

        self._core = load_core(
            lambda folder, world: OnlineTrajectory.load(folder, settings.window_frames, world), settings
        )
        self._latest: TrajectoryUpdate | None = None
        self._gaps = 0
        self._status = NodeStatus(self, settings.diagnostics_topic, settings.diagnostics_period_s, self._details)
        self._pose = self.create_publisher(PoseWithCovarianceStamped, settings.pose_topic, _DEPTH)
        self._whole = TrajectoryPublishers(
            self, settings.map_frame, settings.path_topic, settings.trajectory_topic, settings.loops_topic
        )
        if settings.publish_tf:
            self._tf = self.create_publisher(TFMessage, settings.tf_topic, _DEPTH)
        self.create_service(SaveTrajectory, "~/save_trajectory", self._on_save)
        self.create_service(Reset, "~/reset", self._on_reset)
        self.create_subscription(
            RelativePose, settings.relative_pose_topic, self._on_relative_pose, settings.relative_pose_depth
        )
        self.get_logger().info(f"ready: {settings.world}, the last {settings.window_frames} frames")

    def _on_relative_pose(self, message: RelativePose) -> None:
        try:
            step = messages.relative_step(message)
            with self._status.timed():
                update = self._core.update(step)
        except ValueError as error:
            self._status.dropped("relative pose", error)
            return
        self._status.received(step.stamp_ns)
        if update.restarted:
            self.get_logger().info(
                "the relative poses have a new origin: their source restarted, so the map starts anew "
                "(again and again: two local estimators publish on one topic)"
            )
        self._gaps += update.gap
        self._latest = update
        self._publish(update)

    def _publish(self, update: "TrajectoryUpdate") -> None:
        settings = self._settings
        if settings.publish_tf:
            stamped = (update.stamp_ns, settings.map_frame, settings.odom_frame, update.map_from_odom_xyyaw)
            self._tf.publish(messages.transform_message(*stamped))
        self._whole.publish(self._core, update)
        self._pose.publish(
            messages.pose_message(update.stamp_ns, settings.map_frame, update.pose_xyyaw, update.covariance)
        )

    def _on_save(self, request: SaveTrajectory.Request, response: SaveTrajectory.Response) -> SaveTrajectory.Response:
        path = Path(request.path).expanduser().absolute()
        stamps_ns, poses_xyyaw = np.zeros(0, np.int64), np.zeros((0, 3))
        if (trajectory := self._core.trajectory()) is not None:
            stamps_ns, poses_xyyaw = trajectory.stamps_ns, trajectory.poses_xyyaw
        try:
            write_tum(path, stamps_ns, poses_xyyaw)
        except (ValueError, OSError) as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, f"wrote {len(stamps_ns)} poses to {path}"
        return response

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        frames = 0 if self._latest is None else self._latest.frames
        self._core.reset()
        self._latest = None
        self._whole.publish(self._core, None)
        response.success, response.message = True, f"forgot {frames} poses"
        return response

    def _details(self) -> dict[str, str]:
        if self._latest is None:
            return {}
        update = self._latest
        x, y, yaw = update.map_from_odom_xyyaw.tolist()
        return {
            "frames": str(update.frames),
            "window fill": f"{update.window_fill:.3f}",
            "gaps": str(self._gaps),
            "loops": str(update.closed_loops),
            "largest move in the last update (m)": f"{update.largest_move_m:.3f}",
            "map_from_odom (x m, y m, yaw rad)": f"{x:.3f} {y:.3f} {yaw:.4f}",
        }


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, NgoNode))


if __name__ == "__main__":
    main()
