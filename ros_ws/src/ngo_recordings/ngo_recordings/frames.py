"""A recording as frames: picture or scan, the step that led to it, and where the robot truly was."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ngo_recordings.recording import Recording
from ngo_recordings.topics import RecordingTopics


@dataclass(frozen=True)
class ScanGeometry:
    """Of a scan whose rays run counter-clockwise from angle_min_rad; its image has them the other way round.

    Column c of an image of n rays looks at ``angle_min_rad + (n - 1 - c) * angle_increment_rad`` from straight ahead,
    counter-clockwise; angle_increment_rad is positive.
    """

    angle_min_rad: float
    angle_increment_rad: float
    range_min_m: float
    range_max_m: float


@dataclass(frozen=True)
class Frame:
    """One frame of a recording.

    stamp_ns: of the image's header. image: ``(height, width, channels)``, uint8 of 1 (grey) or 3 (red, green, blue)
    channels, or float32 of 1 (depth, m) or 4 (colour 0 to 1, and depth); no return is +inf. A scan is ``(1, rays, 1)``,
    leftmost ray first, with its geometry in scan. action, twist_xyyaw ``(3,)`` (m/s, m/s, rad/s in the moving frame):
    of the step from the frame before to this one. pose_xyyaw ``(3,)``: ground truth (m, m, rad) projected to the plane;
    pose_residual ``(3,)``: what the projection leaves out (z m, roll rad, pitch rad). None: there is none within the
    tolerance.
    """

    stamp_ns: int
    image: np.ndarray
    scan: ScanGeometry | None = None
    action: int | None = None
    twist_xyyaw: np.ndarray | None = None
    pose_xyyaw: np.ndarray | None = None
    pose_residual: np.ndarray | None = None


def frames(recording: Recording, topics: RecordingTopics, skipped: Counter[str] | None = None) -> Iterator[Frame]:
    """The frames of a recording in the order of its images; stamps are the recording's own and may jump.

    skipped counts images that gave no frame, by the reason.

    Raises:
        RecordingError: an image of an encoding that is not supported, or of another size than the one before.
    """
    raise NotImplementedError
