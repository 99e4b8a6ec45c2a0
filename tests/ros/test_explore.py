"""The explorer as a real process: the test is its world, which sees a map drawn by hand, and moves by `cmd_vel`."""

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point32, Polygon, TransformStamped, Twist
from map_msgs.msg import OccupancyGridUpdate
from nav2_msgs.action import NavigateToPose
from nav_msgs.msg import MapMetaData, OccupancyGrid
from ngo_msgs.action import Explore
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.task import Future
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Bool
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from tests.unit.ngo_explorer.drawn_maps import RESOLUTION_M, drawn, seen_from

from .processes import NodeProcess, Probe

pytestmark = pytest.mark.processes

TRUTH = drawn("########", "#...#..#", "#......#", "#...#..#", "########", cells=10)
START = np.array((2.0, 2.5, 0.3))
FAST = {
    "speed_mps": 2.0,
    "turn_rate_rps": 4.0,
    "acceleration_mps2": 4.0,
    "turn_acceleration_rps2": 20.0,
    "control_rate": 50.0,
    "settle_s": 0.4,
    "replan_s": 0.5,
    "radius_m": 0.2,
}
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MAP_S, _TF_S = 0.15, 0.02


class World:
    """A robot in TRUTH: takes velocities, publishes map, changes of the map and transforms.

    ``off`` is where odom lies in the map: a loop that closes moves it. ``shift`` cells are cut off the map's left
    side, so that its origin is another.
    """

    def __init__(self, probe: Probe) -> None:
        self.probe, self.pose, self.known = probe, START.copy(), np.full_like(TRUTH, -1)
        self.twist, self.heard, self.moved_m, self.shift, self.silent = (0.0, 0.0), 0, 0.0, 0, False
        self.clients: list[ActionClient] = []
        self.off = np.zeros(2)
        node = probe.node
        self._map = node.create_publisher(OccupancyGrid, "map", LATCHED)
        self._updates = node.create_publisher(OccupancyGridUpdate, "map_updates", 10)
        self.scan_m: float | None = 5.0
        """What a scan shows all around, where there is one."""
        self.scans = node.create_publisher(LaserScan, "scan", 1)
        self._tf = node.create_publisher(TFMessage, "/tf", 100)
        node.create_subscription(Twist, "cmd_vel", self._on_velocity, 10)
        self._stepped_s = self._mapped_s = time.monotonic()

    def _on_velocity(self, message: Twist) -> None:
        self.twist, self.heard = (message.linear.x, message.angular.z), self.heard + 1

    def step(self) -> bool:
        """Let the time since the last step pass; False, so that it can be waited on."""
        now_s = time.monotonic()
        if now_s - self._stepped_s >= _TF_S:
            period_s, self._stepped_s = min(0.1, now_s - self._stepped_s), now_s
            speed, turn_rate = self.twist
            heading = self.pose[2] + turn_rate * period_s / 2
            self.pose += period_s * np.array((speed * math.cos(heading), speed * math.sin(heading), turn_rate))
            self.moved_m += abs(speed) * period_s
            row, column = (self.pose[1::-1] / RESOLUTION_M).astype(int)
            assert TRUTH[row, column] == 0, "the robot drove into a wall"
            if not self.silent:
                odom = placed("map", "odom", np.array((*self.off, 0.0)))
                self._tf.publish(TFMessage(transforms=[odom, placed("odom", "base_link", self.pose)]))
            if self.scan_m is not None:
                rays = {"angle_min": -3.0, "angle_max": 3.0, "angle_increment": 0.1, "range_max": 9.0}
                scan = LaserScan(ranges=[self.scan_m] * 61, **rays)
                scan.header.frame_id, scan.header.stamp = "base_link", self.probe.node.get_clock().now().to_msg()
                self.scans.publish(scan)
        if now_s - self._mapped_s >= _MAP_S and not self.silent:
            self._mapped_s = now_s
            seen_from(TRUTH, self.known, *self.pose[:2])
            self.publish_map()
        return False

    def publish_map(self) -> None:
        """Publish the part of the map that is not cut off."""
        values = self.known[:, self.shift :]
        info = MapMetaData(resolution=RESOLUTION_M, width=values.shape[1], height=values.shape[0])
        info.origin.position.x, info.origin.position.y = (self.off + (self.shift * RESOLUTION_M, 0.0)).tolist()
        info.origin.orientation.w = 1.0
        message = OccupancyGrid(info=info, data=values.ravel().tolist())
        message.header.frame_id = "map"
        self._map.publish(message)

    def until(self, condition: Any, what: str) -> Any:
        """Let time pass until ``condition()`` is true."""
        return self.probe.spin_until(lambda: self.step() or condition(), what)


def placed(frame: str, child: str, pose: np.ndarray) -> TransformStamped:
    found = TransformStamped(child_frame_id=child)
    found.header.frame_id = frame
    found.transform.translation.x, found.transform.translation.y = float(pose[0]), float(pose[1])
    found.transform.rotation.z, found.transform.rotation.w = math.sin(pose[2] / 2), math.cos(pose[2] / 2)
    return found


@pytest.fixture
def world() -> Iterator[World]:
    with Probe() as probe:
        world = World(probe)
        yield world
        for client in world.clients:
            client.destroy()  # it would keep the node, and other tests would see it


def ready(world: World, node: NodeProcess) -> ActionClient:
    client = ActionClient(world.probe.node, Explore, "explore")
    world.clients.append(client)
    world.until(lambda: "ready: " in node.log or not node.running, "the explorer")
    assert node.running, node.log
    world.until(client.server_is_ready, "the action server")
    return client


def start(world: World, client: ActionClient, goal: Explore.Goal, feedback: list[Any] | None = None) -> Any:
    listener = None if feedback is None else feedback.append
    future = client.send_goal_async(goal, feedback_callback=listener)
    world.until(future.done, "an answer to the goal")
    return future.result()


def finish(world: World, handle: Any) -> Any:
    future = handle.get_result_async()
    world.until(future.done, "the result")
    return future.result()


def test_it_explores_a_building_to_its_end_and_comes_home_while_the_map_grows(world: World) -> None:
    markers = world.probe.collect(MarkerArray, "explore/frontiers", LATCHED)
    feedback: list[Any] = []
    with NodeProcess("ngo_explorer", "explore", {**FAST, "drive": "own"}) as node:
        client = ready(world, node)
        assert not start(world, client, Explore.Goal(mode="careful")).accepted and "'careful'" in node.log
        handle = start(world, client, Explore.Goal(return_to_start=True, mode=Explore.Goal.ACCURATE), feedback)
        assert handle.accepted
        world.until(lambda: world.moved_m > 0.3, "a motion")
        world.shift = 5  # origin and size of the map change
        world.off = np.array((0.34, -0.22))  # a loop closes: frame and map jump
        refused = start(world, client, Explore.Goal())
        assert not refused.accepted, "one at a time"
        world.until(lambda: world.moved_m > 1.5, "some way")
        world.pose[:] = START  # somebody carries it back
        answer = finish(world, handle)
        assert (answer.status, answer.result.ended) == (GoalStatus.STATUS_SUCCEEDED, "complete"), node.log
        assert (world.known[:, 10:][TRUTH[:, 10:] == 0] == 0).mean() > 0.98
        assert np.hypot(*(world.pose - START)[:2] + world.off) < 0.5, "it came home, where that was on the map"
        assert 10.0 < answer.result.area < 33.0 and answer.result.path_length > 2.0
        assert feedback and feedback[-1].feedback.deviation == -1.0
        assert any(message.feedback.goal.header.frame_id == "map" for message in feedback)
        assert any(len(message.markers) > 1 for message in markers)


def test_cancel_time_limit_boundary_pause_and_a_robot_that_is_lost(world: World) -> None:
    said = world.probe.node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    resume = world.probe.node.create_publisher(Bool, "explore/resume", 10)
    with NodeProcess("ngo_explorer", "explore", {**FAST, "drive": "own", "lost_timeout_s": 1.5}) as node:
        client = ready(world, node)
        handle = start(world, client, Explore.Goal())
        world.until(lambda: world.moved_m > 0.1, "a motion")
        resume.publish(Bool(data=False))
        world.until(lambda: world.twist == (0.0, 0.0), "a pause")
        heard = world.heard
        world.until(lambda: world.heard > heard + 5, "some velocities")
        assert world.twist == (0.0, 0.0)
        resume.publish(Bool(data=True))
        world.until(lambda: world.twist != (0.0, 0.0), "going on")
        canceled = handle.cancel_goal_async()
        world.until(canceled.done, "the cancel")
        assert finish(world, handle).status == GoalStatus.STATUS_CANCELED
        world.until(lambda: world.twist == (0.0, 0.0), "a robot that stands")

        limited = Explore.Goal(time_limit=Duration(nanosec=200_000_000))
        assert finish(world, start(world, client, limited)).result.ended == "time_limit"

        corners = [Point32(x=x, y=y) for x, y in ((1.0, 1.0), (3.0, 1.0), (3.0, 4.0), (1.0, 4.0))]
        bounded = finish(world, start(world, client, Explore.Goal(boundary=Polygon(points=corners)))).result
        assert bounded.ended == "complete" and bounded.area <= 6.1
        two = Explore.Goal(boundary=Polygon(points=corners[:2]))
        assert not start(world, client, two).accepted and "three or more" in node.log

        world.scan_m = 0.24  # the robot's radius is 0.2 m
        world.until(lambda: world.scans.get_subscription_count() == 1, "who hears the scans")
        handle, moved_m, heard = start(world, client, Explore.Goal()), world.moved_m, world.heard
        world.until(lambda: world.heard > heard + 30, "some velocities")
        assert world.moved_m < moved_m + 0.05, "the map is free ahead, but the scan is not"
        world.scan_m = 5.0
        world.until(lambda: world.moved_m > moved_m + 0.1, "going on")
        world.scan_m = None
        world.until(lambda: "there is no new scan on scan" in node.log, "doubt")
        world.until(lambda: world.twist == (0.0, 0.0), "a robot that stands")
        world.until(handle.cancel_goal_async().done, "the cancel")
        finish(world, handle)
        world.scan_m = 5.0

        handle = start(world, client, Explore.Goal())
        world.until(lambda: world.twist[0] > 0.0, "a motion")
        lost = DiagnosticStatus(level=DiagnosticStatus.WARN, name="/ngo_node", message="lost: the deviation is 9 m")
        found = DiagnosticStatus(level=DiagnosticStatus.OK, name="/ngo_node", message="corrects the trajectory")
        said.publish(DiagnosticArray(status=[lost]))
        world.until(lambda: world.twist[0] == 0.0 and world.twist[1] > 0.0, "a turn on the spot")
        said.publish(DiagnosticArray(status=[found]))
        world.until(lambda: world.twist[0] > 0.0, "going on")
        where = world.pose.copy()
        said.publish(DiagnosticArray(status=[lost]))
        answer = finish(world, handle)
        assert answer.result.ended == "lost" and answer.status == GoalStatus.STATUS_ABORTED, node.log
        assert np.hypot(*(world.pose - where)[:2]) < 0.5, "it did not drive on blindly"


class Nav2:
    """A stand-in for Nav2's server: accepts or refuses goals; those accepted are reached, aborted, or hang for ever."""

    def __init__(self, world: World) -> None:
        self.world, self.goals, self.refuse, self.abort, self.hang = world, [], 0, 0, 0
        self.server = ActionServer(
            world.probe.node,
            NavigateToPose,
            "navigate_to_pose",
            self._execute,
            goal_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def _on_goal(self, goal: NavigateToPose.Goal) -> GoalResponse:
        self.goals.append(goal)
        self.refuse -= 1
        return GoalResponse.REJECT if self.refuse >= 0 else GoalResponse.ACCEPT

    async def _execute(self, handle: Any) -> NavigateToPose.Result:
        self.hang -= 1
        if self.hang >= 0:
            await Future()
        self.abort -= 1
        if self.abort >= 0:
            handle.abort()
            return NavigateToPose.Result()
        pose = handle.request.pose.pose
        yaw = 2 * math.atan2(pose.orientation.z, pose.orientation.w)
        self.world.pose[:] = pose.position.x, pose.position.y, yaw
        handle.succeed()
        return NavigateToPose.Result()


def test_nav2_drives_and_its_refusals_aborts_silence_and_death_end_nothing(world: World) -> None:
    nav2 = Nav2(world)
    parameters = {**FAST, "drive": "nav2", "nav2_timeout_s": 1.0, "progress_s": 1.5}
    with NodeProcess("ngo_explorer", "explore", parameters) as node:
        client = ready(world, node)
        nav2.refuse, nav2.abort, nav2.hang = 1, 1, 1
        handle = start(world, client, Explore.Goal())
        world.until(lambda: len(nav2.goals) >= 4, "goals after a refusal, an abort and silence")
        answer = finish(world, handle)
        assert answer.result.ended == "complete"
        assert (world.known[TRUTH == 0] == 0).mean() > 0.95
        assert {goal.pose.header.frame_id for goal in nav2.goals} == {"map"}

        nav2.server.destroy()
        world.pose[:], world.known[:] = START, -1
        handle = start(world, client, Explore.Goal())
        answer = finish(world, handle)
        assert answer.result.ended == "complete" and answer.result.reasons, "all is put aside, and said"
        assert any("did not get there" in reason for reason in answer.result.reasons)
