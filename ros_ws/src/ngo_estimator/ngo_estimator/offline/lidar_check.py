"""What a run over a lidar's recording would use, and what is wrong with it, by a look at its beginning."""

from collections import Counter
from functools import cache

import numpy as np

from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.offline.lidar_run import LidarRun
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.lidar_description import describe_lidar
from ngo_recordings.mounting import find_mounting
from ngo_recordings.recording import Recording
from ngo_recordings.scan_stream import scan_stream
from ngo_recordings.topics import RecordingTopics


def lidar_lines(recording: Recording, topics: RecordingTopics) -> list[str]:
    """Scanners, mountings, wheels, clocks and the age of scans, and the faults of each, a line each.

    Raises RecordingError where topics.image is no LaserScan, or has no usable scan.
    """
    described = describe_lidar(recording, topics)
    lines = described.lines()

    @cache
    def mounting_of(frame: str) -> Mounting | None:
        found = described.mounting if frame == described.scan_frame else find_mounting(recording, topics, frame)
        if found is not None and frame != described.scan_frame:
            lines.append(f"another scanner: {found}")
        if found is None:
            return Mounting(np.zeros(3)) if frame == described.scan_frame else None
        return Mounting(found.base_from_scan_xyyaw, found.upside_down, found.height_m)

    run = LidarRun(MixtureLidar(), ScanTrajectory(), mounting_of)
    skipped: Counter[str] = Counter()
    run.learn(scan_stream(recording, topics, skipped=skipped))
    lines += [f"{count} left out at its beginning: {reason}" for reason, count in skipped.items()]
    return lines + run.remarks()
