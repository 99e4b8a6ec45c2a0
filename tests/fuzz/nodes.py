"""Messages and service calls that nobody expects, given to the real nodes in this process."""

import importlib
import inspect
import random
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import State
from nav_msgs.msg import Odometry
from ngo_msgs.msg import DiscreteAction, RelativePose
from rclpy.executors import SingleThreadedExecutor
from rclpy.logging import LoggingSeverity, set_logger_level
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CompressedImage, Image, LaserScan
from tf2_msgs.msg import TFMessage

from ngo_common.nodes.last_catch import answer_always, spin_once
from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.nodes import messages
from ngo_estimator.nodes.local_node import LocalNode
from ngo_estimator.nodes.ngo_node import NgoNode
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.fuzz.mutants import spoil
from tests.fuzz.outcomes import Outcomes
from tests.ros.estimator_graph import image_message, scan
from tests.ros.relative_poses import Drive, write_weights
from tests.unit.ngo_estimator.lidar_steps import HOUSE, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import scan_at
from tests.unit.ngo_recordings import messages as m

STEP_NS = 10**8
_ANSWER_TURNS = 500
_SHARES = (0.0, 0.0, 0.03, 0.2, 1.0)
_FINAL = State.PRIMARY_STATE_FINALIZED

Make = Callable[[int], Any]  # A good message, stamped for its number.


@contextmanager
def made(create: Callable[[], Any], **parameters: object) -> Iterator[Any]:
    """A node with these parameters."""
    given = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    rclpy.init(args=["--ros-args", *given])
    set_logger_level("rcl_lifecycle", LoggingSeverity.FATAL)
    set_logger_level("rcl", LoggingSeverity.FATAL)
    node = create()
    node.get_logger().set_level(LoggingSeverity.FATAL)
    answer_always(node, node.services)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def run_messages(name: str, count: int, rng: random.Random) -> Outcomes:
    """Call the subscriptions of a node with so many messages, good and spoilt ones."""
    outcomes, lines = Outcomes(), list[str]()
    with tempfile.TemporaryDirectory() as folder, NODES[name](Path(folder)) as (node, good):
        dropped = node._status.dropped

        def noted(kind: str, reason: object, *more: Any, **named: Any) -> None:
            lines.append(f"{kind}: {reason}")
            dropped(kind, reason, *more, **named)

        node._status.dropped = noted
        takers = {taker.topic_name: taker for taker in node.subscriptions if taker.topic_name in good}
        assert takers.keys() == good.keys(), (takers.keys(), good.keys())
        counts = dict.fromkeys(good, 0)
        for number in range(count):
            topic = rng.choice(list(good))
            counts[topic] += rng.choice((1, 1, 1, 1, 0, 3))
            message = spoil(good[topic](counts[topic]), rng, rng.choice(_SHARES))
            info = {"received_timestamp": number, "publication_sequence_number": number}

            def take(taker: Any = takers[topic], message: Any = message, info: Any = info) -> str | None:
                lines.clear()
                taker.callback(message, *([info] if len(inspect.signature(taker.callback).parameters) == 2 else []))
                if faults := [line for line in lines if "internal error" in line]:
                    raise RuntimeError(faults[0])
                return lines[0] if lines else None

            outcomes.add(f"{name} {topic}", take, ())
    return outcomes


def run_services(count: int, rng: random.Random) -> Outcomes:
    """Call every service of an ngo_node, over DDS, in every state, with what nobody expects."""
    outcomes = Outcomes()
    while sum(outcomes.counts.values()) < count:
        with tempfile.TemporaryDirectory() as folder, _ngo_node(Path(folder)) as (node, good):
            _call_until_final(node, good["/relative_pose"], count, rng, outcomes)
    return outcomes


def _call_until_final(node: Any, step: Make, count: int, rng: random.Random, outcomes: Outcomes) -> None:
    probe = rclpy.create_node("probe")
    executor = SingleThreadedExecutor()
    for each in (node, probe):
        executor.add_node(each)
    offered = dict(node.get_service_names_and_types_by_node("ngo_node", "/"))
    clients = {}
    for name, (kind, *_) in offered.items():
        package, _, short = kind.split("/")
        service = getattr(importlib.import_module(f"{package}.srv"), short)
        clients[name] = service, probe.create_client(service, name, qos_profile=QoSProfile(depth=100))
    number = 0
    while sum(outcomes.counts.values()) < count and node._state_machine.current_state[0] != _FINAL:
        for taker in node.subscriptions if rng.random() < 0.2 else ():
            if taker.topic_name == "/relative_pose":
                number += 1
                taker.callback(step(number), {"received_timestamp": number, "publication_sequence_number": number})
        name = rng.choice(list(clients))
        service, client = clients[name]
        if not client.service_is_ready():
            spin_once(node, executor, 0.0)
            continue
        request = spoil(service.Request(), rng, rng.choice((0.5, 1.0)))
        if name.endswith("change_state"):
            # The states are passed through again and again; the end comes now and then.
            request.transition.id = rng.choice((1, 1, 2, 3, 3, 4, rng.randrange(256)))
            request.transition.label = rng.choice(("", "", "", request.transition.label))

        def call(client: Any = client, request: Any = request) -> None:
            answer = client.call_async(request)
            for _ in range(_ANSWER_TURNS):
                if answer.done():
                    return
                spin_once(node, executor, 0.01)
            raise RuntimeError("no answer")

        outcomes.add(name, call, ())  # type: ignore[arg-type]
    executor.shutdown()
    probe.destroy_node()


@contextmanager
def _ngo_node(folder: Path) -> Iterator[tuple[Any, dict[str, Make]]]:
    write_weights(folder)
    core = OnlineTrajectory.load(folder)
    drive = Drive(core, 10**18)

    def initial(number: int) -> PoseWithCovarianceStamped:
        return messages.pose_message(number * STEP_NS, "map", np.array([1.0, 2.0, 0.5]), np.diag([0.1, 0.1, 0.01]))

    parameters = {"world": "maze2d", "weights": folder, "save_directory": folder, "window_frames": 64, "key_frames": 8}
    with made(lambda: NgoNode().start(), **parameters) as node:
        yield node, {"/relative_pose": lambda number: drive.step(max(number, 1)), "/initialpose": initial}


@contextmanager
def _lidar_back_end(folder: Path) -> Iterator[tuple[Any, dict[str, Make]]]:
    way = loop_way(1.2)
    angles = np.radians(np.arange(-135.0, 135.0, 2.0))
    steps = list(lidar_steps(way, lambda k, stamp_ns: scan_at(HOUSE, way[k], stamp_ns, angles)))

    def step(number: int) -> RelativePose:
        return messages.relative_pose_message(steps[number % len(steps)], "base_link")

    with made(lambda: NgoNode().start(), world="scan", save_directory=folder) as node:
        yield node, {"/relative_pose": step}


@contextmanager
def _images(folder: Path) -> Iterator[tuple[Any, dict[str, Make]]]:
    write_untrained(folder, "maze2d")

    def image(number: int) -> Image:
        return image_message(scan(number % 7), number * STEP_NS)

    def action(number: int) -> DiscreteAction:
        message = DiscreteAction(action=number % 3)
        message.header.stamp = messages.to_time(number * STEP_NS)
        return message

    with made(LocalNode, world="maze2d", weights=folder) as node:
        yield node, {"/image": image, "/action": action}


@contextmanager
def _compressed(folder: Path) -> Iterator[tuple[Any, dict[str, Make]]]:
    write_untrained(folder, "camera", ImageFormat(12, 16, 3, "uint8"))
    rng = np.random.default_rng(0)
    pictures = [bytes(m.compressed(1, rng.integers(0, 256, (12, 16, 3), np.uint8), "png").data) for _ in range(5)]

    def image(number: int) -> CompressedImage:
        message = CompressedImage(format="png", data=pictures[number % 5])
        message.header.stamp = messages.to_time(number * STEP_NS)
        return message

    with made(LocalNode, world="camera", weights=folder, image_transport="compressed") as node:
        yield node, {"/image/compressed": image}


def _laser(number: int) -> LaserScan:
    ranges = (2.0 + np.sin(np.arange(90) / 9.0 + 0.01 * number)).astype(np.float32).tolist()
    message = LaserScan(angle_min=-1.5, angle_max=1.5, angle_increment=3.0 / 89, range_max=30.0, ranges=ranges)
    message.header.stamp, message.header.frame_id = messages.to_time(number * STEP_NS), "base_link"
    return message


@contextmanager
def _scans_as_images(folder: Path) -> Iterator[tuple[Any, dict[str, Make]]]:
    write_untrained(folder, "laser", ImageFormat(1, 91, 1, "float32", field_of_view_deg=180.0))
    with made(LocalNode, world="laser", weights=folder) as node:
        yield node, {"/scan": _laser}


def _lidar_node(source: str, topic: str, make: Make) -> Callable[[Path], Any]:
    @contextmanager
    def node_of(folder: Path) -> Iterator[tuple[Any, dict[str, Make]]]:
        def static(number: int) -> TFMessage:
            return messages.transform_message(number, "base_link", "laser", np.array([0.1, 0.0, 0.0]))

        with made(LocalNode, world="scan", robot_odometry=source) as node:
            yield node, {"/scan": _laser, topic: make, "/tf_static": static}

    return node_of


def _wheels(number: int) -> Odometry:
    message = Odometry()
    message.header.stamp, message.header.frame_id = messages.to_time(number * STEP_NS), "odom"
    message.pose.pose = messages.planar_pose(np.array([0.01 * number, 0.0, 0.001 * number]))
    return message


def _transform(number: int) -> TFMessage:
    pose = np.array([0.01 * number, 0.0, 0.001 * number])
    return messages.transform_message(number * STEP_NS, "odom", "base_link", pose)


NODES: dict[str, Callable[[Path], Any]] = {
    "ngo_node": _ngo_node,
    "ngo_node of scans": _lidar_back_end,
    "local_node of images": _images,
    "local_node of compressed images": _compressed,
    "local_node of resampled scans": _scans_as_images,
    "local_node of scans and odometry": _lidar_node("topic", "/wheel_odom", _wheels),
    "local_node of scans and TF": _lidar_node("tf", "/tf", _transform),
}
