"""Node that draws an occupancy grid from the ranges in relative poses, at the corrected poses of their frames."""

import math
import sys
import traceback
from pathlib import Path

import numpy as np
from nav2_msgs.srv import SaveMap
from ngo_msgs.msg import RelativePose, Trajectory
from ngo_msgs.srv import LoadState, SaveState
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from ngo_common.nodes.parameters import LiveSettings
from ngo_common.nodes.process import StartError, run_node
from ngo_common.nodes.qos import checked_overrides
from ngo_common.settings import usage
from ngo_estimator.mapping.map_files import FREE, OCCUPIED, write_map
from ngo_estimator.mapping.scan_map import ScanMap, ScanMapConfig, warm_up
from ngo_estimator.mapping.scan_source import ScanSource, scan_source
from ngo_estimator.nodes.inputs import OnDemand
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.map_publisher import MapPublisher
from ngo_estimator.nodes.messages import relative_step
from ngo_estimator.nodes.settings import MapNodeSettings
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import weights_folder
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.trajectory.files import seconds
from ngo_estimator.trajectory.save_path import folder_inside, path_inside

NAME = "ngo_map"
_SUMMARY = "Publishes a map from the ranges in relative poses, at their corrected poses."
_AT_ONCE = 8  # relative poses that are taken where the node fell behind
_BUDGET_S = 0.35  # of an update, for scans that the trajectory moved; the rest is moved by the next one


class NgoMap(Node):
    """Subscribes relative poses and the corrected trajectory; publishes the map, and writes it to files."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._live = LiveSettings(self, MapNodeSettings)
        self._settings = settings = self._live.values
        self._source = self._open_source(settings)
        warm_up()
        self._map = ScanMap(ScanMapConfig(resolution_m=settings.resolution))
        self._said_m = settings.resolution
        self._identity = {"map": settings.world, "max_range": settings.max_range}
        if settings.state:
            self._load(Path(settings.save_directory).expanduser() / Path(settings.state).expanduser())
        self._trajectory: Trajectory | None = None
        self._due = False  # whether the map does not follow the trajectory yet
        self._begun = False
        self._missed = ""
        with checked_overrides():
            self._create_topics(settings)
        self.create_service(SaveMap, "~/save_map", self._on_save)
        self.create_service(SaveState, "~/save_state", self._on_save_state)
        self.create_service(LoadState, "~/load_state", self._on_load_state)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(settings.map_update_interval, self._follow, clock=steady)
        self._live.on_change(self._on_settings)
        self._live.lock()
        self.get_logger().info(f"ready: {self.get_fully_qualified_name()}, {settings.world}")

    def _open_source(self, settings: MapNodeSettings) -> ScanSource:
        folder = weights_folder(settings)
        try:
            source = scan_source(folder, settings.world, settings.max_range)
        except ValueError as error:
            raise StartError(str(error)) from error
        if source is None:
            raise StartError(
                f"{folder}: its place codes hold no ranges; a map needs a lidar, or networks that see ranges"
            )
        return source

    def _load(self, folder: Path) -> None:
        try:
            self._map.restore(read_state(folder, self._identity))
        except ValueError as error:
            raise StartError(str(error)) from error
        self.get_logger().info(f"loaded {self._map.waiting} scans from {folder}: they wait for their trajectory")

    def _create_topics(self, settings: MapNodeSettings) -> None:
        self._status = NodeStatus(
            self, settings.diagnostics_topic, settings.diagnostics_period_s, self._details, self._problems
        )
        self._publisher = MapPublisher(self, settings.map_topic, settings.framed(settings.map_frame))
        self._listening = Listening(self, self._status, settings.source_timeout_s)
        steps = QoSProfile(depth=settings.relative_pose_depth)
        self._listening.to(RelativePose, settings.relative_pose_topic, self._on_relative_pose, steps, at_once=_AT_ONCE)
        # The newest trajectory says all that those before it said.
        # It is taken when the map follows it, and not at each of its changes.
        newest = QoSProfile(depth=1)
        self._newest = self._listening.to(
            Trajectory, settings.trajectory_topic, self._on_trajectory, newest, OnDemand()
        )

    def _on_relative_pose(self, message: RelativePose) -> None:
        try:
            step = relative_step(message)
            self._map.take(step, self._source.scans(step))
        except ValueError as error:
            self._status.dropped("relative pose", error)
            return
        self._status.received(step.stamp_ns)
        if not self._begun and step.from_stamp_ns != step.origin_stamp_ns:
            self._missed = f"the map lacks what was seen before {seconds(step.stamp_ns)} s: this node started later"
            self.get_logger().warning(self._missed)
        self._begun = True
        self._due = self._trajectory is not None  # the trajectory may have come before this step

    def _on_trajectory(self, message: Trajectory) -> None:
        expected = self._settings.framed(self._settings.map_frame)
        lengths = {len(values) for values in (message.stamps_ns, message.x, message.y, message.yaw)}
        if message.header.frame_id != expected:
            reason = f"it is in the frame '{message.header.frame_id}'; expected '{expected}'"
        elif len(lengths) != 1 or 0 in lengths:
            reason = "its arrays are empty or of several lengths; expected one, of at least one pose"
        elif not (np.diff(np.array(message.stamps_ns)) > 0).all():
            reason = "its stamps do not increase"
        else:
            self._trajectory, self._due = message, True
            return
        self._status.dropped("trajectory", reason)

    def _follow(self) -> None:
        """Let the map follow the newest trajectory, and publish it if it has changed."""
        self._newest.take_waiting(1)
        if self._trajectory is None or not self._due:
            return
        try:
            self._draw(self._trajectory, _BUDGET_S)
        except Exception:
            # A fault of ours: a robot is better off with an old map than without the node.
            self._due = False
            self.get_logger().error(f"internal error, the map stays as it is:\n{traceback.format_exc()}")

    def _draw(self, trajectory: Trajectory, budget_s: float) -> None:
        stamps_ns = np.array(trajectory.stamps_ns)
        poses = np.column_stack((trajectory.x, trajectory.y, trajectory.yaw))
        with self._status.timed("time an update"):
            update = self._map.update(stamps_ns, poses, budget_s)
            if update.changed:
                free, occupied = self._map.config.occupancy.free, self._map.config.occupancy.occupied
                self._publisher.publish(int(stamps_ns[-1]), self._map.cells().trinary(free, occupied))
        self._due = update.left > 0
        if update.restarted:
            self._missed = ""
            self.get_logger().info("the trajectory began anew, and so does the map")
        if self._map.resolution_m > self._said_m:
            self._said_m = self._map.resolution_m
            self.get_logger().warning(f"the map is too large for smaller cells: they are {self._said_m:g} m now")
        if update.too_large:
            self._status.dropped("scans", update.too_large)

    def _on_save(self, request: SaveMap.Request, response: SaveMap.Response) -> SaveMap.Response:
        try:
            written = self._saved(request)
        except Exception as error:  # the caller of the service gets an answer in any case
            self.get_logger().error(f"save_map: {' '.join(str(error).split()) or repr(error)}")
            response.result = False
            return response
        self.get_logger().info(f"wrote {' and '.join(map(str, written))}")
        response.result = True
        return response

    def _saved(self, request: SaveMap.Request) -> list[Path]:
        own = self._publisher.topic
        if request.map_topic and self.resolve_topic_name(request.map_topic) != own:
            raise ValueError(f"map_topic is '{request.map_topic}'; expected '{own}', or nothing")
        if not request.map_url:
            raise ValueError("map_url is empty; expected the path of the files, without an ending")
        self._newest.take_waiting(1)
        if self._trajectory is not None and self._due:  # a file holds all that is known by now
            self._draw(self._trajectory, math.inf)
        folder = Path(self._settings.save_directory)
        *_, described = (path_inside(folder, request.map_url + ending) for ending in (".pgm", ".png", ".yaml"))
        return write_map(
            described.with_name(described.name.removesuffix(".yaml")),
            self._map.cells(),
            request.image_format,
            request.map_mode or "trinary",
            # As Nav2's own server does: 0 is one that was not given.
            round(request.free_thresh, 6) or FREE,
            round(request.occupied_thresh, 6) or OCCUPIED,
        )

    def _on_save_state(self, request: SaveState.Request, response: SaveState.Response) -> SaveState.Response:
        """Save the scans of the map, from which it is drawn again once the trajectory is loaded."""
        try:
            arrays = self._map.state()
            folder = folder_inside(Path(self._settings.save_directory), request.path)
            write_state(folder, self._identity, arrays)
        except Exception as error:  # the caller of the service gets an answer in any case
            response.message = " ".join(str(error).split()) or repr(error)
            return response
        response.success, response.message = True, f"wrote {len(arrays['stamps_ns'])} scans to {folder}"
        return response

    def _on_load_state(self, request: LoadState.Request, response: LoadState.Response) -> LoadState.Response:
        """Take saved scans in place of the map; the mode says nothing here: the trajectory decides where they lie."""
        try:
            folder = folder_inside(Path(self._settings.save_directory), request.path)
            self._map.restore(read_state(folder, self._identity))
        except Exception as error:  # the caller of the service gets an answer in any case
            response.message = " ".join(str(error).split()) or repr(error)
            return response
        self._due = self._trajectory is not None
        response.success, response.message = True, f"loaded {self._map.waiting} scans from {folder}"
        return response

    def _on_settings(self, settings: MapNodeSettings) -> None:
        self._status.set_period(settings.diagnostics_period_s)
        self._listening.set_timeout(settings.source_timeout_s)
        self._timer.timer_period_ns = int(settings.map_update_interval * 1e9)

    def _details(self) -> dict[str, str]:
        return {
            "scans in the map": str(len(self._map)),
            "scans that wait for their poses": str(self._map.waiting),
            "maps published": str(self._publisher.wholes),
            "parts of maps published": str(self._publisher.parts),
        }

    def _problems(self) -> list[str]:
        found = self._listening.problems()
        if self._missed:
            found.append(self._missed)
        if self._map.lost:
            found.append(f"{self._map.lost} scans are not in the map: no trajectory has their stamps")
        return found


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, NgoMap, usage("ngo_estimator", NAME, _SUMMARY, MapNodeSettings)))


if __name__ == "__main__":
    main()
