"""Node that re-optimises the whole trajectory with every relative pose, and publishes it corrected."""

import contextlib
import sys
import traceback
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import RemoveLoop, Reset
from rclpy.clock import Clock, ClockType
from std_srvs.srv import SetBool

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import StartError, run_node
from ngo_common.nodes.qos import checked_overrides, overridable
from ngo_common.settings import usage
from ngo_estimator.geometry.planar_covariance import position_std
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.code_memory import release_code
from ngo_estimator.nodes.file_services import StateServices
from ngo_estimator.nodes.inputs import Input, relative_poses
from ngo_estimator.nodes.loop_removal import remove_loops
from ngo_estimator.nodes.managed_node import ManagedNode
from ngo_estimator.nodes.pose_publisher import PosePublisher
from ngo_estimator.nodes.pose_search import PoseSearch
from ngo_estimator.nodes.robot_fleet import RobotFleet
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.trajectory_publishers import TrajectoryPublishers
from ngo_estimator.nodes.trajectory_report import TrajectoryReport
from ngo_estimator.nodes.weights import load_trajectory

if TYPE_CHECKING:
    from ngo_estimator.data.relative_step import RelativeStep
    from ngo_estimator.nodes.file_services import Loaded
    from ngo_estimator.slam.joining import Joining
    from ngo_estimator.slam.map_localisation import LocalisedStep, MapLocalisation
    from ngo_estimator.slam.session import Session
    from ngo_estimator.slam.tf_smoothing import SmoothedCorrection
    from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
    from ngo_estimator.trajectory.g2o import PlanarGraph

NAME = "ngo_node"
_DEPTH = 100
_PENDING_S = 1.0
_SEARCH_LINE_S = 10.0
_STARTS = 80  # relative poses until compiled functions are loaded
_SUMMARY = "Publishes the corrected trajectory and map -> odom from relative poses."


class NgoNode(ManagedNode):
    """Subscribes relative poses; publishes the corrected trajectory in several forms, and map -> odom.

    With ``mode`` localization the trajectory is the one that was saved: it is the map in which the robot's pose is
    looked for. It stays so, or with ``map_changes`` learn until the robot is found, as a session that goes on from
    another start.

    With ``robots`` there are several streams of relative poses, and one trajectory (``RobotFleet``).

    A managed node: configured it has its networks, its topics and its services, active it takes relative poses.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._search: PoseSearch | None = None  # in a saved map
        self._live = LiveSettings(self, NgoNodeSettings)
        self._live.on_change(self._on_settings)
        self._inputs: list[Input] = []
        self._fleet: RobotFleet | None = None
        self._configured = False
        if not self._settings.autostart:
            name = self.get_fully_qualified_name()
            self.get_logger().info(f"unconfigured: waits for `ros2 lifecycle set {name} configure`")

    @property
    def _settings(self) -> NgoNodeSettings:
        return self._live.values

    def start(self) -> "NgoNode":
        """Configure and activate if ``autostart`` is set; raises the error that keeps the node from starting."""
        if self._settings.autostart:
            self._start()
        return self

    def _configure(self) -> None:
        settings, built = self._settings, self._built
        if settings.robots:
            self._live.lock()
            built.callback(self._live.lock, False)
            self._fleet = RobotFleet(self, settings, built)
            built.callback(setattr, self, "_fleet", None)
            return
        # Imported here because torch takes seconds: a bad parameter is said at once.
        from ngo_estimator.slam.map_origin import MapOrigin
        from ngo_estimator.slam.session import Session
        from ngo_estimator.slam.tf_smoothing import SmoothedCorrection

        self._core = load_trajectory(settings, self.get_logger())
        self._origin_of, self._session_of = MapOrigin, Session
        self._paused = False
        self._report = TrajectoryReport()
        self._live.lock()
        built.callback(self._live.lock, False)
        with checked_overrides():
            self._create_outputs(settings, SmoothedCorrection(settings.tf_smoothing_s))
        self._begin_anew()
        self._configured = True
        built.callback(setattr, self, "_configured", False)
        self._files = files = StateServices(self, settings, self._trajectories, self._graph, self._session, self._take)
        if settings.state:
            try:
                files.load_at_start(settings.state, settings.relocalises)
            except ValueError as error:
                raise StartError(f"state: {error}") from error
        files.open(
            built,
            (Reset, "~/reset", self._on_reset),
            (SetBool, "~/pause", self._on_pause),
            (RemoveLoop, "~/remove_loop", self._on_remove_loop),
        )

    def _create_outputs(self, settings: NgoNodeSettings, smoothing: "SmoothedCorrection") -> None:
        self._status = NodeStatus(self, settings, self._details, self._problems)
        self._status.idle = "inactive"
        self._built.callback(self._status.close)
        self._out = PosePublisher(self, lambda: self._settings, smoothing, self._built)
        self._whole = TrajectoryPublishers(self, settings, self._trajectory)
        self._built.callback(self._whole.close)

    def _listen(self) -> None:
        settings, listening = self._settings, self._listening
        if self._fleet is not None:
            self._fleet.listen(listening)
            return
        with checked_overrides():
            steps = relative_poses(self, self._status, settings, self._on_relative_pose)
            listening.callback(steps.close)
            initial = self.create_subscription(
                PoseWithCovarianceStamped,
                settings.initial_pose_topic,
                self._on_initial_pose,
                _DEPTH,
                qos_overriding_options=overridable(),
            )
            listening.callback(self.destroy_subscription, initial)
        # When no more relative poses come, nothing else would publish the last correction.
        self._pending = self.create_timer(_PENDING_S, self._finish, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._pending.cancel()
        listening.callback(self.destroy_timer, self._pending)
        self._inputs = [steps]
        listening.callback(self._inputs.clear)
        if self._latest is not None:  # what was loaded, or gone on with
            self._whole.changed(loops=True)
        self._status.idle = ""
        listening.callback(setattr, self._status, "idle", "inactive")
        self._starts = _STARTS
        release_code()
        name, topic = self.get_fully_qualified_name(), self.resolve_topic_name(settings.relative_pose_topic)
        self.get_logger().info(f"ready: {name}, {settings.world}, the last {settings.window_frames} of '{topic}'")

    def _session(self) -> "Session":
        return self._session_of(self._settings.world, self._core, self._origin, self._out.smoothing)

    def _begin_anew(self) -> None:
        """Reset the state that belongs to one trajectory."""
        self._latest: TrajectoryUpdate | None = None
        self._odom_xyyaw: np.ndarray | None = np.zeros(3)
        self._search = None
        self._covariance = np.zeros((3, 3))
        self._report.begin_anew()
        self._origin = self._origin_of.of_first_pose(np.array(self._settings.initial_pose))
        self._out.smoothing.reset()

    def _on_relative_pose(self, message: RelativePose) -> None:
        found: LocalisedStep | None = None
        try:
            step = messages.relative_step(message)
            with self._status.timed("time an update"):
                self._relocalise(step)
                if self._search is not None:
                    found = self._search.update(step)
                    update = found.joined
                else:
                    update = self._core.update(step, optimize=not self._paused)
        except ValueError as error:
            self._status.dropped("relative pose", error)
            return
        except Exception:
            self._on_internal_error()
            return
        self._status.received(step.stamp_ns)
        self._starts -= 1
        if self._starts == 0:
            release_code()
        odom_xyyaw = step.tf_odom_xyyaw if step.tf_odom_known else None
        if found is not None:
            self._on_found(found, odom_xyyaw, publish=update is None)
        if update is not None:
            self._on_update(update, odom_xyyaw)
            self._correct()

    def _on_internal_error(self) -> None:
        """Begin anew: a fault of ours, and a robot is better off with a new map than without the node.

        A saved map that is to grow is loaded again: what failed may have spoilt the present one.
        """
        log, fault = self.get_logger().error, traceback.format_exc()
        if self._settings.keeps_map:
            log(f"internal error, the pose is looked for anew:\n{fault}")
            self._forget()
        elif self._search is None and self._settings.mode == "mapping":
            log(f"internal error, the map starts anew:\n{fault}")
            self._forget()
        else:
            log(f"internal error, the saved map is loaded again:\n{fault}")
            try:
                self._files.reload()
            except ValueError as error:
                log(f"the map starts anew: {error}")
                self._search = None
                self._forget()
        self._status.dropped("relative pose", "internal error", warn=False)

    def _correct(self) -> None:
        """Do what the newest relative pose made due: its pose is published, and the next one is still to come."""
        try:
            with self._status.timed("time a correction"):
                update = self._core.correct()
        except Exception:
            self._on_internal_error()
            return
        if update is not None:
            self._on_correction(update)
        if self._core.unfinished or (update is not None and update.optimized):
            self._pending.reset()
        else:
            self._pending.cancel()

    def _relocalise(self, step: "RelativeStep") -> None:
        """Keep the map where the odometry begins anew, if the robot is to be found in it."""
        if not self._settings.relocalises or self._search is not None or not self._core.begins_anew(step):
            return
        with contextlib.suppress(ValueError):  # a map that shows no places yet
            self._look_for_the_robot()
            self.get_logger().info("the relative poses have a new origin: looks for the robot in the map, which stays")

    def _look_for_the_robot(self) -> None:
        """Finish the map, and look for the robot in it; raises ``ValueError`` where it shows no places."""
        if not self._paused and (update := self._core.finish()) is not None:
            self._on_correction(update)
        self._begin_search(self._session().joining())

    def _begin_search(self, search: "MapLocalisation | Joining") -> None:
        self._search, self._covariance = PoseSearch(search), np.zeros((3, 3))
        self._out.smoothing.reset()

    def _on_update(self, update: "TrajectoryUpdate", odom_xyyaw: np.ndarray | None) -> None:
        """Publish what a step changed in the trajectory."""
        if self._search is not None:
            self._search = None
            self.get_logger().info("the loaded map grows from here")
        if update.restarted:
            self._begin_anew()
            self.get_logger().info(
                "the relative poses have a new origin: their source restarted, so the map starts anew"
            )
        self._report.count(update.gap, update.restarted)
        self._report.updated(update)
        if update.optimized:
            self._status.took("time an optimisation", self._core.optimization_s)
        begins = self._latest is None
        self._latest = update
        pose, map_from_odom = self._origin.poses(update.pose_xyyaw), self._origin.poses(update.map_from_odom_xyyaw)
        self._covariance = self._origin.covariance_of(pose, update.covariance)
        self._out.publish(update.stamp_ns, pose, self._covariance, map_from_odom, odom_xyyaw)
        # Loops only move when the optimizer ran; the first poses of a trajectory delete those of the last one.
        self._whole.changed(loops=update.optimized or begins)
        self._odom_xyyaw = odom_xyyaw

    def _on_found(self, step: "LocalisedStep", odom_xyyaw: np.ndarray | None, publish: bool) -> None:
        """Tell what is new about the pose in the saved map, and publish it where it is known."""
        found = step.found
        self._report.count(step.gap, step.restarted)
        if step.restarted:
            self.get_logger().info("the relative poses have a new origin: the pose in the map is looked for anew")
        if found.claimed:
            self._out.smoothing.reset()
            self.get_logger().info("localised: several frames agree on the pose in the map")
        if found.lost:
            self.get_logger().warning("not localised: the pose in the map is lost")
        self._covariance = np.zeros((3, 3)) if found.covariance is None else found.covariance
        if found.pose_xyyaw is None and self._search is not None:
            self.get_logger().info("; ".join(self._search.problems()), throttle_duration_sec=_SEARCH_LINE_S)
        if found.pose_xyyaw is None or found.covariance is None or step.map_from_odom_xyyaw is None:
            return
        if publish:
            pose, covariance = found.pose_xyyaw, found.covariance
            self._out.publish(found.stamp_ns, pose, covariance, step.map_from_odom_xyyaw, odom_xyyaw)

    def _finish(self) -> None:
        """Optimise what waits for relative poses that do not come, and publish map -> odom as it is since the last."""
        self._pending.cancel()
        if self._search is not None:  # it has the map as it is, and the pose is forgotten
            return
        if not self._paused and (update := self._core.finish()) is not None:
            self._on_correction(update)
        if self._latest is not None:
            map_from_odom = self._origin.poses(self._latest.map_from_odom_xyyaw)
            self._out.send_transform(self._latest.stamp_ns, map_from_odom, self._odom_xyyaw)

    def _on_correction(self, update: "TrajectoryUpdate") -> None:
        """Publish the trajectory that was corrected behind the newest pose; map -> odom follows with the next pose."""
        self._latest = update
        self._report.updated(update)
        if update.optimized:
            self._status.took("time an optimisation", self._core.optimization_s)
            self._whole.changed(loops=True)

    def _trajectory(self) -> "Trajectory | None":
        """The whole trajectory, with its poses in map."""
        trajectory = self._core.trajectory()
        return trajectory and replace(trajectory, poses_xyyaw=self._origin.poses(trajectory.poses_xyyaw))

    def _trajectories(self) -> "dict[str, Trajectory]":
        trajectory = self._trajectory()
        return {} if trajectory is None else {"": trajectory}

    def _graph(self) -> "PlanarGraph | None":
        """The graph, with its poses in map."""
        graph = self._core.planar_graph()
        return graph and replace(graph, poses=self._origin.poses(graph.poses))

    def _on_remove_loop(self, request: RemoveLoop.Request, response: RemoveLoop.Response) -> RemoveLoop.Response:
        if self._search is not None:
            response.message = "the robot is looked for in the map, which stays as it is; no loop was taken out"
        elif remove_loops(self._core, self._files.written, request, response, self.get_logger()):
            self._on_correction(self._core.newest())
            if self._inputs:
                self._pending.reset()
        return response

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            given = messages.planar_estimate(message, self._settings.framed(self._settings.map_frame))
            if self._search is None and self._settings.mode == "localization":
                self._look_for_the_robot()
        except ValueError as error:
            self._status.dropped("initial pose", error)
            return
        x, y, yaw = given[0].tolist()
        there = f"the robot is at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad"
        if self._search is not None:
            self._search.set_pose(*given)
            self._out.smoothing.reset()
            self.get_logger().info(f"{there}, as it was told")
            return
        own = np.zeros(3) if self._latest is None else self._latest.pose_xyyaw
        self._origin = self._origin_of.of_pose(own, *given)
        self._out.smoothing.reset()
        self.get_logger().info(f"{there}: the map moves with it")
        if self._latest is not None:
            self._whole.changed(loops=True)

    def _take(self, loaded: "Loaded") -> None:
        """Go on with a session that was loaded. Nothing is known of the robot's pose before the next relative pose."""
        if not self._configured:
            raise ValueError("the node was cleaned up meanwhile; nothing was loaded")
        session, search = loaded
        self._core, self._origin, self._out.smoothing = session.core, session.origin, session.smoothing
        self._latest = update = session.core.newest()
        pose = self._origin.poses(update.pose_xyyaw)
        self._covariance = self._origin.covariance_of(pose, update.covariance)
        self._report.begin_anew()
        self._search = None
        if search is not None:
            self._begin_search(search)
        if self._inputs:
            self._pending.cancel()
        self._whole.changed(loops=True)
        where = "goes on from" if search is None else "looks for the robot in"
        self.get_logger().info(f"{where} a saved state of {update.frames} poses")

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        frames = 0 if self._latest is None else self._latest.frames
        in_map = self._settings.mode == "localization"
        if not in_map:
            self._search = None
        if in_map and self._search is None:
            try:
                self._look_for_the_robot()
            except ValueError as error:
                response.message = str(error)
                return response
        else:
            self._forget()
        response.success, response.message = True, "forgot the pose in the map" if in_map else f"forgot {frames} poses"
        return response

    def _forget(self) -> None:
        """Begin a new trajectory; where the robot is looked for, forget its pose alone."""
        if self._search is None:
            self._core.reset()
            self._begin_anew()
        else:
            self._search.reset()
            self._out.smoothing.reset()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._settings.keeps_map:
            response.message = "mode is localization, where nothing is corrected that could pause"
            return response
        self._paused = request.data
        response.success = True
        response.message = "paused: poses follow the odometry" if self._paused else "corrections go on"
        return response

    def _on_settings(self, settings: NgoNodeSettings) -> None:
        if self._fleet is not None:
            self._fleet.change(settings)
        if not self._configured:
            return
        self._status.set_period(settings.diagnostics_period_s)
        self._whole.set_rate(settings.path_rate_hz)
        self._out.smoothing.time_constant_s = settings.tf_smoothing_s
        for entry in self._inputs:
            entry.set_timeout(settings.source_timeout_s)

    def _details(self) -> dict[str, str]:
        values = {
            "paused": str(self._paused).lower(),
            "paths published": str(self._whole.paths),
            **self._report.counts(),
        }
        if self._search is not None:
            return values | self._search.details()
        if self._latest is None:
            return values
        map_from_odom = self._origin.poses(self._latest.map_from_odom_xyyaw)
        return values | self._report.details(self._latest, self._core.loop_report(), map_from_odom, self._covariance)

    def _problems(self) -> list[str]:
        found = [line for entry in self._inputs for line in entry.problems()]
        found += self._report.problems()
        if self._latest is not None and self._odom_xyyaw is None:
            found.append("no map -> odom: the robot's own odometry is not known at the scans' stamps, see local_node")
        if self._search is not None:
            found += self._search.problems()
        if (std_m := position_std(self._covariance)) >= self._settings.lost_position_std_m:
            found.append(f"lost: the standard deviation of the position is {std_m:.3g} m")
        return found


def main() -> None:
    """Run the node."""
    text = usage("ngo_estimator", NAME, _SUMMARY, NgoNodeSettings)
    sys.exit(run_node(NAME, lambda: NgoNode().start(), text))


if __name__ == "__main__":
    main()
