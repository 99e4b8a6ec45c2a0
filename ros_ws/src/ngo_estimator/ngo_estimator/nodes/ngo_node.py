"""Node that re-optimises the whole trajectory with every relative pose, and publishes it corrected."""

import sys
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from ngo_msgs.msg import RelativePose
from ngo_msgs.srv import LoadState, Reset, SaveState, SaveTrajectory
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecyclePublisher, LifecycleState, TransitionCallbackReturn
from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_srvs.srv import SetBool
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import StartError, run_node
from ngo_common.nodes.qos import checked_overrides, overridable
from ngo_common.settings import usage
from ngo_estimator.data.lidar_file import is_lidar
from ngo_estimator.geometry.planar_covariance import position_std
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.inputs import Input
from ngo_estimator.nodes.localisation_report import localisation_details, localisation_problems
from ngo_estimator.nodes.settings import NgoNodeSettings
from ngo_estimator.nodes.state_services import StateServices
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.trajectory_publishers import TrajectoryPublishers
from ngo_estimator.nodes.weights import load_core
from ngo_estimator.trajectory.files import edges_of, write_trajectory
from ngo_estimator.trajectory.save_path import path_inside

if TYPE_CHECKING:
    from ngo_estimator.online.corrected_trajectory import CorrectedTrajectory, Trajectory, TrajectoryUpdate
    from ngo_estimator.online.map_localisation import LocalisedStep, MapLocalisation
    from ngo_estimator.online.session import Session

NAME = "ngo_node"
_DEPTH = 100
_SERVICES = QoSProfile(depth=1000)  # every call is answered, many at once as well
_PENDING_S = 0.3
_SUMMARY = "Publishes the corrected trajectory and map -> odom from relative poses."
Result = TypeVar("Result")
_SUCCESS, _FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE


class NgoNode(LifecycleNode):
    """Subscribes relative poses; publishes the corrected trajectory in several forms, and map -> odom.

    With ``mode`` localization the trajectory is the one that was saved and stays so: it is the map in which the robot's
    pose is looked for.

    A managed node: configured it has its networks, its topics and its services, active it takes relative poses.
    """

    def __init__(self) -> None:
        super().__init__(NAME)
        self._live = LiveSettings(self, NgoNodeSettings)
        self._live.on_change(self._on_settings)
        self._built, self._listening = ExitStack(), ExitStack()  # undone by cleanup and deactivate
        self._failure: Exception | None = None
        self._starting = False
        self._inputs: list[Input] = []
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
            self._starting = True
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != _SUCCESS and self._failure is not None:
                    raise self._failure
            self._starting = False
        return self

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load the networks, make topics and services."""
        return self._attempt(self._configure, self._built)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Begin to take relative poses."""
        super().on_activate(state)
        return self._attempt(self._listen, self._listening)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop taking relative poses. The odometry bridges the gap after the next activation."""
        self._listening.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Drop the trajectory and the networks."""
        self._built.close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End everything."""
        self._listening.close()
        self._built.close()
        return super().on_shutdown(state)

    def _attempt(self, work: Callable[[], None], undo: ExitStack) -> TransitionCallbackReturn:
        """Do the work of a transition; one that fails is undone, and its reason said in one line."""
        try:
            work()
        except Exception as error:  # rclpy itself would say nothing about it
            undo.close()
            self._failure = error
            if not self._starting:  # the caller of start() reports it
                self.get_logger().error(" ".join(str(error).split()) or repr(error))
            return _FAILURE
        return _SUCCESS

    def _configure(self) -> None:
        settings, built = self._settings, self._built
        # Imported here because torch takes seconds: a bad parameter is said at once.
        from ngo_estimator.offline.warm_up import warm_up
        from ngo_estimator.online.map_origin import MapOrigin
        from ngo_estimator.online.online_trajectory import OnlineTrajectory
        from ngo_estimator.online.scan_trajectory import ScanTrajectory
        from ngo_estimator.online.session import Session
        from ngo_estimator.online.tf_smoothing import SmoothedCorrection

        def load(folder: Path, world: str) -> OnlineTrajectory | ScanTrajectory:
            if is_lidar(folder):
                warm_up()
                return ScanTrajectory.load(folder, world, settings.iterations_per_step)
            return OnlineTrajectory.load(
                folder, settings.window_frames, world, settings.key_frames, settings.iterations_per_step
            )

        self._core: CorrectedTrajectory = load_core(load, settings)
        self._origin_of = MapOrigin
        self._smoothing = SmoothedCorrection(settings.tf_smoothing_s)
        self._paused = False
        self._gaps = self._restarts = self._new_gaps = 0
        self._fault = ""
        self._begin_anew()
        self._live.lock()
        built.callback(self._live.lock, False)
        with checked_overrides():
            self._create_outputs(settings)
        self._files = built.enter_context(ThreadPoolExecutor(1))
        state = StateServices(
            settings.save_directory,
            self._aside,
            lambda: Session(settings.world, self._core, self._origin, self._smoothing),
            self._take,
        )
        self._configured = True
        built.callback(setattr, self, "_configured", False)
        if settings.state:
            try:
                state.load_at_start(settings.state)
            except ValueError as error:
                raise StartError(f"state: {error}") from error
        for kind, name, callback, group in (
            # One of its own: while a file is written, the others go on.
            (SaveTrajectory, "~/save_trajectory", self._on_save, MutuallyExclusiveCallbackGroup()),
            (SaveState, "~/save_state", state.on_save, MutuallyExclusiveCallbackGroup()),
            (LoadState, "~/load_state", state.on_load, MutuallyExclusiveCallbackGroup()),
            (Reset, "~/reset", self._on_reset, None),
            (SetBool, "~/pause", self._on_pause, None),
        ):
            service = self.create_service(kind, name, callback, qos_profile=_SERVICES, callback_group=group)
            built.callback(self.destroy_service, service)

    def _create_outputs(self, settings: NgoNodeSettings) -> None:
        self._status = NodeStatus(
            self, settings.diagnostics_topic, settings.diagnostics_period_s, self._details, self._problems
        )
        self._status.idle = "inactive"
        self._built.callback(self._status.close)
        self._pose = self._publisher(PoseWithCovarianceStamped, settings.pose_topic)
        self._whole = TrajectoryPublishers(self, settings, self._trajectory)
        self._built.callback(self._whole.close)
        if settings.publish_tf:
            self._tf = self._publisher(TFMessage, settings.tf_topic)

    def _publisher(self, message_type: type, topic: str) -> LifecyclePublisher:
        publisher = self.create_lifecycle_publisher(message_type, topic, _DEPTH, qos_overriding_options=overridable())
        self._built.callback(self.destroy_lifecycle_publisher, publisher)
        return publisher

    def _listen(self) -> None:
        settings, listening = self._settings, self._listening
        with checked_overrides():
            steps = Input(
                self,
                self._status,
                RelativePose,
                settings.relative_pose_topic,
                settings.relative_pose_depth,
                self._on_relative_pose,
                lambda message: messages.to_ns(message.origin_stamp),
                settings.source_timeout_s,
            )
            listening.callback(steps.close)
            initial = self.create_subscription(
                PoseWithCovarianceStamped,
                settings.initial_pose_topic,
                self._on_initial_pose,
                _DEPTH,
                qos_overriding_options=overridable(),
            )
            listening.callback(self.destroy_subscription, initial)
        # When no more relative poses come, nothing else would end an optimisation that is spread over them.
        self._pending = self.create_timer(_PENDING_S, self._finish, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._pending.cancel()
        listening.callback(self.destroy_timer, self._pending)
        self._inputs = [steps]
        listening.callback(self._inputs.clear)
        if self._latest is not None:  # what was loaded, or gone on with
            self._whole.changed(loops=True)
        self._status.idle = ""
        listening.callback(setattr, self._status, "idle", "inactive")
        name, topic = self.get_fully_qualified_name(), self.resolve_topic_name(settings.relative_pose_topic)
        self.get_logger().info(f"ready: {name}, {settings.world}, the last {settings.window_frames} of '{topic}'")

    def _begin_anew(self) -> None:
        """Reset the state that belongs to one trajectory."""
        self._latest: TrajectoryUpdate | None = None
        self._localisation: MapLocalisation | None = None
        self._found: LocalisedStep | None = None
        self._covariance = np.zeros((3, 3))
        self._last_correction_m = 0.0
        self._origin = self._origin_of.of_first_pose(np.array(self._settings.initial_pose))
        self._smoothing.reset()

    def _on_relative_pose(self, message: RelativePose) -> None:
        try:
            step = messages.relative_step(message)
            with self._status.timed("time an update"):
                if self._localisation is not None:
                    found = self._localisation.update(step)
                else:
                    update = self._core.update(step, optimize=not self._paused)
        except ValueError as error:
            self._status.dropped("relative pose", error)
            return
        except Exception:
            # A fault of ours, not of the message: a robot is better off with a new map than without the node.
            forgotten = "the map starts anew" if self._localisation is None else "the pose is looked for anew"
            self.get_logger().error(f"internal error, {forgotten}:\n{traceback.format_exc()}")
            self._forget()
            self._status.dropped("relative pose", "internal error", warn=False)
            return
        self._status.received(step.stamp_ns)
        if self._localisation is not None:
            self._on_found(found, step.tf_odom_xyyaw)
            return
        if update.restarted:
            self._begin_anew()
            self._restarts += 1
            self.get_logger().info(
                "the relative poses have a new origin: their source restarted, so the map starts anew"
            )
        self._gaps += update.gap
        self._new_gaps += update.gap
        self._fault = update.fault or self._fault
        if update.optimized:
            self._last_correction_m = update.largest_move_m
            self._status.took("time an optimisation", self._core.optimization_s)
        begins = self._latest is None
        self._latest = update
        self._publish(update, step.tf_odom_xyyaw)
        # Loops only move when the optimizer ran; the first poses of a trajectory delete those of the last one.
        self._whole.changed(loops=update.optimized or begins)
        self._odom_xyyaw = step.tf_odom_xyyaw
        if self._core.unfinished:
            self._pending.reset()
        else:
            self._pending.cancel()

    def _on_found(self, step: "LocalisedStep", odom_xyyaw: np.ndarray) -> None:
        """Publish the pose in the saved map, where it is known."""
        found, self._found = step.found, step
        self._gaps += step.gap
        self._new_gaps += step.gap
        self._restarts += step.restarted
        if step.restarted:
            self.get_logger().info("the relative poses have a new origin: the pose in the map is looked for anew")
        if found.claimed:
            self._smoothing.reset()
            self.get_logger().info("localised: several frames agree on the pose in the map")
        if found.lost:
            self.get_logger().warning("not localised: the pose in the map is lost")
        self._covariance = np.zeros((3, 3)) if found.covariance is None else found.covariance
        if found.pose_xyyaw is None or found.covariance is None or step.map_from_odom_xyyaw is None:
            return
        map_frame = self._settings.framed(self._settings.map_frame)
        self._send_transform(found.stamp_ns, step.map_from_odom_xyyaw, odom_xyyaw)
        self._pose.publish(messages.pose_message(found.stamp_ns, map_frame, found.pose_xyyaw, found.covariance))

    def _finish(self) -> None:
        """End the optimisation that has begun."""
        self._pending.cancel()
        if self._paused or (update := self._core.finish()) is None:
            return
        self._latest, self._last_correction_m = update, update.largest_move_m
        self._publish_transform(update, self._odom_xyyaw)
        self._whole.changed(loops=True)

    def _publish(self, update: "TrajectoryUpdate", odom_xyyaw: np.ndarray) -> None:
        self._publish_transform(update, odom_xyyaw)
        pose, map_frame = self._origin.poses(update.pose_xyyaw), self._settings.framed(self._settings.map_frame)
        self._covariance = self._origin.covariance_of(pose, update.covariance)
        self._pose.publish(messages.pose_message(update.stamp_ns, map_frame, pose, self._covariance))

    def _publish_transform(self, update: "TrajectoryUpdate", odom_xyyaw: np.ndarray) -> None:
        self._send_transform(update.stamp_ns, self._origin.poses(update.map_from_odom_xyyaw), odom_xyyaw)

    def _send_transform(self, stamp_ns: int, newest: np.ndarray, odom_xyyaw: np.ndarray) -> None:
        settings = self._settings
        if settings.publish_tf:
            map_frame, odom_frame = settings.framed(settings.map_frame), settings.framed(settings.odom_frame)
            map_from_odom = self._smoothing.update(stamp_ns, newest, odom_xyyaw)
            ahead_ns = round(1e9 * settings.tf_ahead_s)
            self._tf.publish(messages.transform_message(stamp_ns + ahead_ns, map_frame, odom_frame, map_from_odom))

    def _trajectory(self) -> "Trajectory | None":
        """The whole trajectory, with its poses in map."""
        trajectory = self._core.trajectory()
        return trajectory and replace(trajectory, poses_xyyaw=self._origin.poses(trajectory.poses_xyyaw))

    def _on_initial_pose(self, message: PoseWithCovarianceStamped) -> None:
        try:
            given = messages.planar_estimate(message, self._settings.framed(self._settings.map_frame))
        except ValueError as error:
            self._status.dropped("initial pose", error)
            return
        x, y, yaw = given[0].tolist()
        there = f"the robot is at x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad"
        if self._localisation is not None:
            self._localisation.tell(*given)
            self._smoothing.reset()
            self.get_logger().info(f"{there}, as it was told")
            return
        own = np.zeros(3) if self._latest is None else self._latest.pose_xyyaw
        self._origin = self._origin_of.of_pose(own, *given)
        self._smoothing.reset()
        self.get_logger().info(f"{there}: the map moves with it")
        if self._latest is not None:
            self._whole.changed(loops=True)

    async def _on_save(
        self, request: SaveTrajectory.Request, response: SaveTrajectory.Response
    ) -> SaveTrajectory.Response:
        """Write the file in a thread, so that relative poses are processed meanwhile."""
        trajectory, folder = self._trajectory(), Path(self._settings.save_directory)
        response.success, response.message = await self._aside(lambda: _written(request.path, folder, trajectory))
        return response

    async def _aside(self, work: Callable[[], Result]) -> Result:
        """The result of work that is done in a thread, or its error."""
        done, executor = Future(), self.executor

        def run() -> None:
            try:
                done.set_result(work())
            except Exception as error:
                done.set_exception(error)
            executor.wake()

        self._files.submit(run)
        result: Result = await done
        return result

    def _take(self, session: "Session") -> None:
        """Go on with a session that was loaded. Nothing is known of the robot's pose before the next relative pose."""
        if not self._configured:
            raise ValueError("the node was cleaned up meanwhile; nothing was loaded")
        self._core, self._origin, self._smoothing = session.core, session.origin, session.smoothing
        self._latest = update = session.core.newest()
        pose = self._origin.poses(update.pose_xyyaw)
        self._covariance = self._origin.covariance_of(pose, update.covariance)
        self._last_correction_m = 0.0
        self._found = None
        if self._settings.mode == "localization":
            self._localisation = session.core.localisation(session.origin)
            self._smoothing.reset()
        if self._inputs:
            self._pending.cancel()
        self._whole.changed(loops=True)
        self.get_logger().info(f"goes on from a saved state of {update.frames} poses")

    def _on_reset(self, _: Reset.Request, response: Reset.Response) -> Reset.Response:
        frames = 0 if self._latest is None else self._latest.frames
        in_map = self._localisation is not None
        self._forget()
        response.success, response.message = True, "forgot the pose in the map" if in_map else f"forgot {frames} poses"
        return response

    def _forget(self) -> None:
        """Begin a new trajectory; in a saved map, which stays, look for the pose anew."""
        if self._localisation is None:
            self._core.reset()
            self._begin_anew()
            return
        self._localisation.reset()
        self._found = None
        self._smoothing.reset()

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if self._localisation is not None:
            response.message = "mode is localization, where nothing is corrected that could pause"
            return response
        self._paused = request.data
        response.success = True
        response.message = "paused: poses follow the odometry" if self._paused else "corrections go on"
        return response

    def _on_settings(self, settings: NgoNodeSettings) -> None:
        if not self._configured:
            return
        self._status.set_period(settings.diagnostics_period_s)
        self._whole.set_rate(settings.path_rate_hz)
        self._smoothing.time_constant_s = settings.tf_smoothing_s
        for entry in self._inputs:
            entry.set_timeout(settings.source_timeout_s)

    def _details(self) -> dict[str, str]:
        values = {
            "paused": str(self._paused).lower(),
            "gaps": str(self._gaps),
            "restarts": str(self._restarts),
            "paths published": str(self._whole.paths),
        }
        if self._localisation is not None:
            return values | localisation_details(self._found)
        if self._latest is None:
            return values
        update = self._latest
        x, y, yaw = self._origin.poses(update.map_from_odom_xyyaw).tolist()
        return values | {
            "frames": str(update.frames),
            "window fill": f"{update.window_fill:.3f}",
            "loops": str(update.closed_loops),
            "last correction, largest move (m)": f"{self._last_correction_m:.3f}",
            "standard deviation of the position (m)": f"{position_std(self._covariance):.3g}",
            "map_from_odom (x m, y m, yaw rad)": f"{x:.3f} {y:.3f} {yaw:.4f}",
        }

    def _problems(self) -> list[str]:
        found = [line for entry in self._inputs for line in entry.problems()]
        if self._new_gaps:
            found.append(f"{self._new_gaps} gaps in the relative poses, bridged by the odometry")
            self._new_gaps = 0
        if self._fault:
            found.append(f"internal fault, the trajectory goes on by odometry: {self._fault}")
            self._fault = ""
        if self._localisation is not None:
            found += localisation_problems(self._found)
        if (std_m := position_std(self._covariance)) >= self._settings.lost_position_std_m:
            found.append(f"lost: the standard deviation of the position is {std_m:.3g} m")
        return found


def _written(name: str, folder: Path, trajectory: "Trajectory | None") -> tuple[bool, str]:
    """Write a file in the folder; returns whether it succeeded, and a message for the user."""
    try:
        path = path_inside(folder, name)
        if trajectory is None:
            raise ValueError("the trajectory is empty; nothing was written")
        edges = edges_of(trajectory) if path.suffix == ".g2o" else ()
        write_trajectory(path, trajectory.stamps_ns, trajectory.poses_xyyaw, edges)
    except Exception as error:  # the caller of the service gets an answer in any case
        return False, " ".join(str(error).split()) or repr(error)
    return True, f"wrote {len(trajectory.stamps_ns)} poses to {path}"


def main() -> None:
    """Run the node."""
    text = usage("ngo_estimator", NAME, _SUMMARY, NgoNodeSettings)
    sys.exit(run_node(NAME, lambda: NgoNode().start(), text))


if __name__ == "__main__":
    main()
