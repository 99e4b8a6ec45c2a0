"""The part of ``ngo_node`` that takes the relative poses of several robots into one map."""

import traceback
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import RemoveLoop, Reset
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode
from std_srvs.srv import SetBool

from ngo_common.nodes.process import StartError
from ngo_common.nodes.qos import checked_overrides
from ngo_estimator.geometry.planar_covariance import position_std
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.file_services import FileServices
from ngo_estimator.nodes.inputs import Input, relative_poses
from ngo_estimator.nodes.loop_removal import remove_loops
from ngo_estimator.nodes.pose_publisher import PosePublisher
from ngo_estimator.nodes.settings import TOPICS_OF_ROBOTS, NgoNodeSettings, of_robot
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.trajectory_publishers import TrajectoryPublishers
from ngo_estimator.nodes.weights import load_trajectory

if TYPE_CHECKING:  # torch takes seconds: a bad parameter is said at once
    from ngo_estimator.data.relative_step import RelativeStep
    from ngo_estimator.slam.fleet import FleetUpdate
    from ngo_estimator.slam.map_origin import MapOrigin
    from ngo_estimator.slam.trajectory_update import Trajectory
    from ngo_estimator.trajectory.g2o import PlanarGraph

_PENDING_S = 1.0


class _Robot:
    """What is published of one robot, in its namespace: in the map of all, or in its own."""

    def __init__(self, fleet: "RobotFleet", name: str, built: ExitStack) -> None:
        from ngo_estimator.slam.tf_smoothing import SmoothedCorrection

        self.name = name
        self.newest: FleetUpdate | None = None
        self.odom_xyyaw: np.ndarray | None = None
        smoothing = SmoothedCorrection(fleet.settings.tf_smoothing_s)
        self.out = PosePublisher(fleet.node, lambda: self.own_settings(fleet.settings), smoothing, built)
        own = self.own_settings(fleet.settings)
        self.whole = TrajectoryPublishers(fleet.node, own, partial(fleet.trajectory, name), len(fleet.settings.robots))
        built.callback(self.whole.close)

    def own_settings(self, settings: NgoNodeSettings) -> NgoNodeSettings:
        """The settings of a node for this robot alone."""
        topics: dict[str, Any] = {topic: of_robot(self.name, getattr(settings, topic)) for topic in TOPICS_OF_ROBOTS}
        return replace(settings, robots=(), frame_prefix=f"{self.name}/", **topics)


class RobotFleet:
    """Takes the relative poses of all robots, and publishes the pose and the trajectory of each.

    Args:
        node: gets topics and services, until ``built`` is closed.

    Raises:
        StartError: the weights cannot be used, or are not a lidar's.
    """

    def __init__(self, node: LifecycleNode, settings: NgoNodeSettings, built: ExitStack) -> None:
        from ngo_estimator.slam.fleet import Fleet
        from ngo_estimator.slam.map_origin import MapOrigin
        from ngo_estimator.slam.scan_trajectory import ScanTrajectory

        self.node, self.settings = node, settings
        core = load_trajectory(settings, node.get_logger())
        if not isinstance(core, ScanTrajectory):
            raise StartError(f"robots: world is '{settings.world}'; expected one of a lidar, as scan")
        self._fleet = Fleet(core, settings.robots)
        self._origin = MapOrigin.of_first_pose(np.array(settings.initial_pose))
        self._paused = False
        self._inputs: list[Input] = []
        with checked_overrides():
            self._status = NodeStatus(node, settings, self._details, self._problems)
            built.callback(self._status.close)
            self._robots = {name: _Robot(self, name, built) for name in settings.robots}
        self._status.idle = "inactive"
        self._files = FileServices(node, settings, self._trajectories, self._graph)
        self._files.open(
            built,
            (Reset, "~/reset", self._on_reset),
            (SetBool, "~/pause", self._on_pause),
            (RemoveLoop, "~/remove_loop", self._on_remove_loop),
        )

    def listen(self, listening: ExitStack) -> None:
        """Take relative poses until ``listening`` is closed."""
        with checked_overrides():
            for robot in self._robots.values():
                own, take = robot.own_settings(self.settings), partial(self._on_relative_pose, robot)
                entry = relative_poses(self.node, self._status, own, take)
                listening.callback(entry.close)
                self._inputs.append(entry)
        listening.callback(self._inputs.clear)
        # When no more relative poses come, nothing else would publish the last correction.
        self._pending = self.node.create_timer(_PENDING_S, self._finish, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._pending.cancel()
        listening.callback(self.node.destroy_timer, self._pending)
        self._status.idle = ""
        listening.callback(setattr, self._status, "idle", "inactive")
        name, settings = self.node.get_fully_qualified_name(), self.settings
        self.node.get_logger().info(f"ready: {name}, {settings.world}, robots {', '.join(settings.robots)}")

    def change(self, settings: NgoNodeSettings) -> None:
        """Take settings that may change while the node runs."""
        self.settings = settings
        self._status.set_period(settings.diagnostics_period_s)
        for robot in self._robots.values():
            robot.whole.set_rate(settings.path_rate_hz)
            robot.out.smoothing.time_constant_s = settings.tf_smoothing_s
        for entry in self._inputs:
            entry.set_timeout(settings.source_timeout_s)

    def trajectory(self, name: str) -> "Trajectory | None":
        """The trajectory of a robot, in its map."""
        whole, robot = self._fleet.trajectory(name), self._robots[name]
        if whole is None or robot.newest is None:
            return None
        self._use_map(robot, self._fleet.map_of(name))
        return replace(whole, poses_xyyaw=self._origin_of(robot).poses(whole.poses_xyyaw))

    def _trajectories(self) -> "dict[str, Trajectory]":
        """The trajectories of the robots that have begun."""
        found = {name: self.trajectory(name) for name in self._robots}
        return {name: trajectory for name, trajectory in found.items() if trajectory is not None}

    def _graph(self) -> "PlanarGraph | None":
        """The graph of all robots, with its poses in the map of all."""
        graph = self._fleet.planar_graph()
        return graph and replace(graph, poses=self._origin.poses(graph.poses))

    def _on_remove_loop(self, request: RemoveLoop.Request, response: RemoveLoop.Response) -> RemoveLoop.Response:
        written, log = self._files.written, self.node.get_logger()
        if remove_loops(self._fleet.core, written, request, response, log):
            self._on_correction()
            if self._inputs:
                self._pending.reset()
        return response

    def _origin_of(self, robot: _Robot) -> "MapOrigin":
        """Where the robot's map lies in its frame: that of all may begin elsewhere."""
        common = robot.out.map_frame == self._common
        return self._origin if common else type(self._origin).of_first_pose(np.zeros(3))

    @property
    def _common(self) -> str:
        return self.settings.framed(self.settings.map_frame)

    def _use_map(self, robot: _Robot, owner: str | None) -> None:
        """Publish a robot in the map of all (None), or in the own one of a robot."""
        frame = self._common if owner is None else f"{owner}/{self.settings.map_frame}"
        if frame != robot.out.map_frame:
            robot.out.use_map(frame)
            robot.whole.use_map(frame)
            self.node.get_logger().info(f"{robot.name} is in the frame {frame}")

    def _on_relative_pose(self, robot: _Robot, message: RelativePose) -> None:
        try:
            step = messages.relative_step(message)
            with self._status.timed("time an update"):
                update = self._fleet.update(robot.name, step, optimize=not self._paused)
        except ValueError as error:
            self._status.dropped(f"relative pose of {robot.name}", error)
            return
        except Exception:
            self._on_internal_error()
            return
        self._status.received(step.stamp_ns)
        self._publish(robot, step, update)
        self._correct()

    def _publish(self, robot: _Robot, step: "RelativeStep", update: "FleetUpdate") -> None:
        if update.begins and robot.newest is not None:
            what = "so does the map of all" if update.map_of is None else "looks for it in the map, which stays"
            self.node.get_logger().info(f"the odometry of {robot.name} began anew: {what}")
        robot.newest = update
        robot.odom_xyyaw = step.tf_odom_xyyaw if step.tf_odom_known else None
        if update.begins:  # another odometry has another map -> odom
            robot.out.smoothing.reset()
        self._send(robot, with_pose=True)
        robot.whole.changed(loops=update.begins)
        if update.update.optimized:
            self._on_correction()
            self._pending.reset()

    def _send(self, robot: _Robot, with_pose: bool) -> None:
        """Publish map -> odom of a robot, and its newest pose."""
        assert robot.newest is not None
        self._use_map(robot, robot.newest.map_of)
        update, origin = robot.newest.update, self._origin_of(robot)
        pose, map_from_odom = origin.poses(update.pose_xyyaw), origin.poses(update.map_from_odom_xyyaw)
        if with_pose:
            covariance = origin.covariance_of(pose, update.covariance)
            robot.out.publish(update.stamp_ns, pose, covariance, map_from_odom, robot.odom_xyyaw)
        else:
            robot.out.send_transform(update.stamp_ns, map_from_odom, robot.odom_xyyaw)

    def _correct(self) -> None:
        """Do what the newest relative pose made due: its pose is published, and the next one is still to come."""
        try:
            with self._status.timed("time a correction"):
                changed = self._fleet.correct()
        except Exception:
            self._on_internal_error()
            return
        if changed:
            self._on_correction()
        if changed or self._fleet.core.unfinished:
            self._pending.reset()

    def _on_correction(self) -> None:
        self._status.took("time an optimisation", self._fleet.core.optimization_s)
        for robot in self._robots.values():
            if robot.newest is not None:
                robot.whole.changed(loops=True)

    def _finish(self) -> None:
        """Optimise what waits for relative poses that do not come, and publish each map -> odom as it is since."""
        self._pending.cancel()
        if not self._paused and self._fleet.finish():
            self._on_correction()
        for robot in self._robots.values():
            if robot.newest is not None:
                robot.newest = self._fleet.again(robot.name, robot.newest)
                self._send(robot, with_pose=False)

    def _on_internal_error(self) -> None:
        """Begin anew: a fault of ours, and robots are better off with a new map than without the node."""
        self.node.get_logger().error(f"internal error, the map starts anew:\n{traceback.format_exc()}")
        self._forget()
        self._status.dropped("relative pose", "internal error", warn=False)

    def _forget(self) -> None:
        self._fleet.reset()
        self._origin = type(self._origin).of_first_pose(np.array(self.settings.initial_pose))
        for robot in self._robots.values():
            robot.newest = None
            robot.out.smoothing.reset()

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        self._forget()
        response.success, response.message = True, f"forgot the poses of {', '.join(self._robots)}"
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        response.success = True
        response.message = "paused: poses follow the odometry" if self._paused else "corrections go on"
        return response

    def _details(self) -> dict[str, str]:
        values = {"paused": str(self._paused).lower()}
        for name, robot in self._robots.items():
            values[f"{name}, map"] = "none yet" if robot.newest is None else robot.out.map_frame
            if robot.newest is not None:
                std_m = position_std(robot.newest.update.covariance)
                values[f"{name}, standard deviation of the position (m)"] = f"{std_m:.3g}"
        return values

    def _problems(self) -> list[str]:
        found = [line for entry in self._inputs for line in entry.problems()]
        if self._fleet.core.fault:
            found.append(f"internal fault, robots go on by odometry: {self._fleet.core.fault}")
        for name, robot in self._robots.items():
            if robot.newest is None:
                continue
            if (std_m := position_std(robot.newest.update.covariance)) >= self.settings.lost_position_std_m:
                found.append(f"{name} is lost: the standard deviation of its position is {std_m:.3g} m")
            if robot.newest.map_of is not None:
                found.append(f"{name} is not localised in {self._common}: it is in {robot.out.map_frame}")
            if robot.odom_xyyaw is None:
                found.append(f"no map -> odom of {name}: its own odometry is not known at the scans' stamps")
        return found
