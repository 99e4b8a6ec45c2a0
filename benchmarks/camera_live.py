"""Both estimators live on one core: a camera of 640 x 480 at 15 pictures/s over DDS, from picture to corrected pose.

    python -m benchmarks.camera_live

A drive on a Doom map, with the odometry of simulated wheels. Its pictures come from another core. The last line is one
JSON object: milliseconds from a picture to the corrected pose of its frame, key pictures a second, processor time a
picture and memory (RssAnon, before and after them) of each node. Exit code 1 where one percent of the pictures takes
longer than ``LONGEST_MS``, or both nodes need more time than there is. A picture without an answer is an error.
"""

from __future__ import annotations

import json
import sys
import tempfile
from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from geometry_msgs.msg import Point, Quaternion
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from benchmarks.lidar_live import both_nodes
from benchmarks.node_latency import Frame
from ngo_estimator.frontend.camera.camera_config import CameraConfig
from ngo_estimator.geometry import se2
from ngo_estimator.nodes.messages import to_time
from training.scoring.camera_rows import CameraDrive, camera_drive

RATE_HZ = 15.0
LONGEST_MS = 250.0
_BEGIN_S = 1.0
_INPUTS = {"image": Image, "camera_info": CameraInfo, "wheel_odom": Odometry}


@dataclass(frozen=True)
class Arguments:
    """What to drive."""

    wad: str = "freedoom1.wad"  # File of the map.
    map: str = "E1M1"  # Map to drive on.
    seed: int = 10_000  # Of the drive and its wheels.
    pictures: int = 2000  # Pictures at 15 a second.
    before: int = 100  # Pictures before, as fast as they are answered.

    def __post_init__(self) -> None:
        if self.pictures < 20 or self.before < 3:
            raise ValueError(f"pictures, before are {self.pictures}, {self.before}; expected at least 20 and 3")


def frames_of(of: CameraDrive) -> list[Frame]:
    """The pictures of a drive as messages, each with its calibration and the wheels' pose."""
    camera, frames = of.camera, list[Frame]()
    for number, (picture, pose) in enumerate(zip(of.pictures, of.given, strict=True)):
        header = Header(stamp=to_time(round((_BEGIN_S + number / RATE_HZ) * 1e9)), frame_id="base_link")
        size = {"height": camera.height, "width": camera.width}
        data = array("B", picture.tobytes())
        image = Image(header=header, encoding="mono8", step=camera.width, data=data, **size)
        info = CameraInfo(header=header, distortion_model=camera.distortion, k=camera.matrix.ravel(), **size)
        odometry = Odometry(header=Header(stamp=header.stamp, frame_id="odom"))
        odometry.pose.pose.position = Point(x=pose[0], y=pose[1])
        odometry.pose.pose.orientation = Quaternion(z=float(np.sin(0.5 * pose[2])), w=float(np.cos(0.5 * pose[2])))
        frames.append([("image", image), ("camera_info", info), ("wheel_odom", odometry)])
    return frames


def keys_per_s(truth: np.ndarray) -> float:
    """Key pictures a second of a drive through poses ``(n, 3)``."""
    config, key, count = CameraConfig(), truth[0], 0
    for pose in truth:
        moved = se2.between(key, pose)
        if np.hypot(moved[0], moved[1]) > config.key_m or abs(moved[2]) > config.key_rad:
            key, count = pose, count + 1
    return count * RATE_HZ / len(truth)


def measure(arguments: Arguments, logs: Path) -> dict[str, Any]:
    """Drive live; raises ``GraphError`` where a picture has no answer."""
    count, seed = arguments.before + arguments.pictures, arguments.seed
    of = camera_drive((arguments.wad, arguments.map), seed, count, wheels_seed=seed)
    parameters = {"robot_odometry": "topic", "threads": 1}
    result = both_nodes("camera", parameters, _INPUTS, frames_of(of), arguments.before, RATE_HZ, logs)
    return {**result, "keys_per_s": round(keys_per_s(of.truth[arguments.before :]), 2)}


def main(arguments: Arguments) -> int:
    """Measure and print; returns the exit code."""
    with tempfile.TemporaryDirectory() as logs:
        result = measure(arguments, Path(logs))
    print(json.dumps(result))
    return int(result["p99_ms"] > LONGEST_MS or sum(result["cpu_ms"].values()) > 1e3 / RATE_HZ)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
