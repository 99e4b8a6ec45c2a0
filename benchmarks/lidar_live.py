"""Both estimators live on one core: a lidar of 1080 rays at 40 Hz over DDS, from scan to corrected pose.

    python -m benchmarks.lidar_live

A robot drives through a simulated building without wheels. Its scans come from another core. The last line is one JSON
object: milliseconds from a scan to the corrected pose of its frame, processor time a scan and memory (RssAnon, before
and after) of each node. Exit code 1 where one percent of the scans takes longer than ``LONGEST_MS``, or both nodes need
more time than there is. A scan without an answer is an error.
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
from geometry_msgs.msg import PoseWithCovarianceStamped
from sensor_msgs.msg import LaserScan
from std_msgs.msg import Header

from benchmarks.node_latency import Feed, Frame
from benchmarks.pinned import running_on, two_cores
from benchmarks.process_use import cpu_s, memory_mb
from demo.graph import Graph, NodeSpec
from ngo_estimator.nodes.messages import to_time
from ngo_sim.building2d import Building2d
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig

RATE_HZ = 40.0
LONGEST_MS = 250.0
_NODES = ("local_node", "ngo_node")
_BEGIN_S = 1.0
_FAR_M = 100_000.0


@dataclass(frozen=True)
class Arguments:
    """What to drive."""

    seed: int = 10_000  # Building to drive through.
    scans: int = 2400  # Scans at 40 Hz.
    before: int = 200  # Scans before, as fast as they are answered.
    rays: int = 1080  # Rays of a scan, over 270 degrees.

    def __post_init__(self) -> None:
        if self.scans < 100 or self.before < 1:
            raise ValueError(f"scans, before are {self.scans}, {self.before}; expected at least 100 and 1")


def frames_of(arguments: Arguments) -> list[Frame]:
    """The scans as messages."""
    scanner = ScannerConfig(rays=arguments.rays, scan_period_s=1.0 / RATE_HZ)
    count = arguments.before + arguments.scans
    drive = Building2d(FloorPlanConfig(), scanner=scanner).record(arguments.seed, _FAR_M, count)
    frames: list[Frame] = []
    for stamp_s, ranges in zip(drive.stamps_s, drive.ranges_m, strict=True):
        header = Header(stamp=to_time(round((_BEGIN_S + stamp_s) * 1e9)), frame_id="base_link")
        message = LaserScan(header=header, angle_increment=scanner.increment_rad, scan_time=scanner.scan_period_s)
        message.angle_min, message.angle_max = float(scanner.angles_rad[0]), float(scanner.angles_rad[-1])
        message.range_min, message.range_max = scanner.range_min_m, scanner.range_max_m
        message.ranges = array("f", ranges.astype(np.float32).tobytes())
        frames.append([("scan", message)])
    return frames


def measure(arguments: Arguments, logs: Path) -> dict[str, Any]:
    """Drive live; raises ``GraphError`` where a scan has no answer."""
    return both_nodes("scan", {}, {"scan": LaserScan}, frames_of(arguments), arguments.before, RATE_HZ, logs)


def both_nodes(
    world: str, parameters: dict[str, Any], inputs: dict[str, type], frames: list[Frame], before: int, rate_hz: float,
    logs: Path,
) -> dict[str, Any]:  # fmt: skip
    """Both nodes on one core: ``before`` frames as fast as they are answered, then the others at a rate.

    Args:
        parameters: of ``local_node``, besides the world and reliable inputs.
    """
    node_core, own_core = two_cores()
    reliable = {"image_reliability": "reliable", "image_depth": 5000}
    settings = {"local_node": {**reliable, **parameters}, "ngo_node": {}}
    with Graph(logs) as graph, running_on(own_core):
        with running_on(node_core):
            for name in _NODES:
                graph.start(NodeSpec("ngo_estimator", name, {"world": world, **settings[name]}))
        with Feed(graph, "ngo_node", inputs, ("ngo/pose", PoseWithCovarianceStamped)) as feed:
            sent = feed.connect(frames[:before], again=False)
            fast = feed.fast(frames[sent:before])
            began = {name: (cpu_s(graph.pid(name)), memory_mb(graph.pid(name))) for name in _NODES}
            milliseconds = feed.paced(frames[before:], rate_hz)
            used = {name: (cpu_s(graph.pid(name)) - began[name][0]) / len(milliseconds) for name in _NODES}
            memory = {name: (began[name][1], memory_mb(graph.pid(name))) for name in _NODES}
    return {
        "fast_per_s": round(fast, 1),
        "median_ms": round(float(np.median(milliseconds)), 2),
        "p99_ms": round(float(np.percentile(milliseconds, 99)), 2),
        "longest_ms": round(max(milliseconds), 2),
        "cpu_ms": {name: round(1e3 * seconds, 2) for name, seconds in used.items()},
        "memory_mb": {name: [round(size, 1) for size in sizes] for name, sizes in memory.items()},
    }


def main(arguments: Arguments) -> int:
    """Measure and print; returns the exit code."""
    with tempfile.TemporaryDirectory() as logs:
        result = measure(arguments, Path(logs))
    print(json.dumps(result))
    late = result["p99_ms"] > LONGEST_MS or sum(result["cpu_ms"].values()) > 1e3 / RATE_HZ
    return int(late)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
