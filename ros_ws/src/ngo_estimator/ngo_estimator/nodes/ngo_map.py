"""Node that draws an occupancy grid from the ranges in relative poses, at the corrected poses of their frames."""

import math
import sys
import traceback
from functools import partial
from pathlib import Path

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
from ngo_estimator.mapping.occupancy_grid import MapTooLarge, OccupancyMap
from ngo_estimator.mapping.scan_map import ScanMap, ScanMapConfig, together, warm_up
from ngo_estimator.mapping.scan_source import ScanSource, scan_source
from ngo_estimator.nodes.inputs import AT_ONCE, Input, OnDemand
from ngo_estimator.nodes.listening import Listening
from ngo_estimator.nodes.map_layer import MapLayer
from ngo_estimator.nodes.map_publisher import MapPublisher
from ngo_estimator.nodes.messages import relative_step
from ngo_estimator.nodes.settings import MapNodeSettings, of_robot
from ngo_estimator.nodes.status import NodeStatus
from ngo_estimator.nodes.weights import weights_folder
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.trajectory.save_path import folder_inside, path_inside

NAME = "ngo_map"
_SUMMARY = "Publishes a map from the ranges in relative poses, at their corrected poses."
_BUDGET_S = 0.35  # of an update, for scans that the trajectory moved; the rest is moved by the next one


class NgoMap(Node):
    """Subscribes relative poses and the corrected trajectory; publishes the map, and writes it to files."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._live = LiveSettings(self, MapNodeSettings)
        self._settings = settings = self._live.values
        self._source = self._open_source(settings)
        warm_up()
        config, frame = ScanMapConfig(resolution_m=settings.resolution), settings.framed(settings.map_frame)
        self._layers = [MapLayer(config, frame, bool(settings.robots)) for _ in settings.robots or ("",)]
        self._said_m = settings.resolution
        self._identity = {"map": settings.world, "max_range": settings.max_range}
        if settings.state:
            self._load(Path(settings.save_directory).expanduser() / Path(settings.state).expanduser())
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
            self._only.restore(read_state(folder, self._identity))
        except ValueError as error:
            raise StartError(str(error)) from error
        self.get_logger().info(f"loaded {self._only.waiting} scans from {folder}: they wait for their trajectory")

    def _create_topics(self, settings: MapNodeSettings) -> None:
        self._status = NodeStatus(self, settings, self._details, self._problems)
        self._publisher = MapPublisher(self, settings.map_topic, settings.framed(settings.map_frame))
        self._listening = Listening(self, self._status, settings.source_timeout_s)
        steps = QoSProfile(depth=settings.relative_pose_depth)
        # The newest trajectory says all that those before it said.
        # It is taken when the map follows it, and not at each of its changes.
        newest = QoSProfile(depth=1)
        self._newest: list[Input] = []
        for layer, robot in zip(self._layers, settings.robots or ("",), strict=True):
            topics = settings.relative_pose_topic, settings.trajectory_topic
            poses, whole = (of_robot(robot, topic) if robot else topic for topic in topics)
            take, follow = partial(self._on_relative_pose, layer), partial(self._on_trajectory, layer)
            self._listening.to(RelativePose, poses, take, steps, at_once=AT_ONCE)
            self._newest.append(self._listening.to(Trajectory, whole, follow, newest, OnDemand()))

    @property
    def _only(self) -> ScanMap:
        """The map of the only robot; raises ``ValueError`` where there are several."""
        if self._settings.robots:
            raise ValueError("the map is of several robots; expected one robot for a saved state")
        return self._layers[0].map

    def _on_relative_pose(self, layer: MapLayer, message: RelativePose) -> None:
        try:
            step = relative_step(message)
            late = layer.take(step, self._source.scans(step))
        except ValueError as error:
            self._status.dropped("relative pose", error)
            return
        self._status.received(step.stamp_ns)
        if late:
            self.get_logger().warning(layer.missed)

    def _on_trajectory(self, layer: MapLayer, message: Trajectory) -> None:
        if reason := layer.follow(message):
            self._status.dropped("trajectory", reason)

    def _take_newest(self) -> bool:
        """Take the newest trajectories; returns whether there is anything to draw."""
        for entry in self._newest:
            entry.take_waiting(1)
        return any(layer.due for layer in self._layers)

    def _follow(self) -> None:
        """Let the map follow the newest trajectories, and publish it if it has changed."""
        if not self._take_newest():
            return
        try:
            self._draw(_BUDGET_S)
        except Exception:
            # A fault of ours: a robot is better off with an old map than without the node.
            for layer in self._layers:
                layer.due = False
            self.get_logger().error(f"internal error, the map stays as it is:\n{traceback.format_exc()}")

    def _draw(self, budget_s: float) -> None:
        with self._status.timed("time an update"):
            first, *others = self._layers
            updates = [first.draw(budget_s / len(self._layers))]
            if updates[0].restarted:  # what others saw comes again with their next trajectories in the new map
                first.missed = ""
                self.get_logger().info("the trajectory began anew, and so does the map")
                for layer in others:
                    layer.map.withdraw()
            updates += [layer.draw(budget_s / len(self._layers)) for layer in others]
            if any(update.changed for update in updates):
                self._publish()
        for update in updates:
            if update.too_large:
                self._status.dropped("scans", update.too_large)

    def _publish(self) -> None:
        occupancy = self._layers[0].map.config.occupancy
        try:
            trinary = self._cells().trinary(occupancy.free, occupancy.occupied)
        except MapTooLarge as error:  # of several robots far from each other
            self._status.dropped("scans", error)
            return
        self._publisher.publish(max(layer.stamp_ns for layer in self._layers), trinary)

    def _cells(self) -> OccupancyMap:
        """The whole map, of which all robots' parts have cells of one size."""
        whole = together([layer.map for layer in self._layers])
        if whole.resolution_m > self._said_m:
            self._said_m = whole.resolution_m
            self.get_logger().warning(f"the map is too large for smaller cells: they are {self._said_m:g} m now")
        return whole

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
        if self._take_newest():  # a file holds all that is known by now
            self._draw(math.inf)
        folder = Path(self._settings.save_directory)
        *_, described = (path_inside(folder, request.map_url + ending) for ending in (".pgm", ".png", ".yaml"))
        return write_map(
            described.with_name(described.name.removesuffix(".yaml")),
            self._cells(),
            request.image_format,
            request.map_mode or "trinary",
            # As Nav2's own server does: 0 is one that was not given.
            round(request.free_thresh, 6) or FREE,
            round(request.occupied_thresh, 6) or OCCUPIED,
        )

    def _on_save_state(self, request: SaveState.Request, response: SaveState.Response) -> SaveState.Response:
        """Save the scans of the map, from which it is drawn again once the trajectory is loaded."""
        try:
            arrays = self._only.state()
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
            self._only.restore(read_state(folder, self._identity))
        except Exception as error:  # the caller of the service gets an answer in any case
            response.message = " ".join(str(error).split()) or repr(error)
            return response
        self._layers[0].trajectory_may_know_more()
        response.success, response.message = True, f"loaded {self._only.waiting} scans from {folder}"
        return response

    def _on_settings(self, settings: MapNodeSettings) -> None:
        self._status.set_period(settings.diagnostics_period_s)
        self._listening.set_timeout(settings.source_timeout_s)
        self._timer.timer_period_ns = int(settings.map_update_interval * 1e9)

    def _details(self) -> dict[str, str]:
        return {
            "scans in the map": str(sum(len(layer.map) for layer in self._layers)),
            "scans that wait for their poses": str(sum(layer.map.waiting for layer in self._layers)),
            "maps published": str(self._publisher.wholes),
            "parts of maps published": str(self._publisher.parts),
        }

    def _problems(self) -> list[str]:
        found = self._listening.problems()
        found += [layer.missed for layer in self._layers if layer.missed]
        if lost := sum(layer.map.lost for layer in self._layers):
            found.append(f"{lost} scans are not in the map: no trajectory has their stamps")
        return found


def main() -> None:
    """Run the node."""
    sys.exit(run_node(NAME, NgoMap, usage("ngo_estimator", NAME, _SUMMARY, MapNodeSettings)))


if __name__ == "__main__":
    main()
