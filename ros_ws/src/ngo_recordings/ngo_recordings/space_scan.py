"""Point clouds and depth images as scans: what stands at the sensor's own height, by the angle at which it is seen.

Points count in the sensor's body axes (REP-103: x ahead, y to the left, z up), also those of optical frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ngo_recordings.association import header_stamp_ns
from ngo_recordings.errors import RecordingError
from ngo_recordings.images import CLOUD_TYPE, IMAGE_TYPE, LIDAR_TYPES, MULTI_ECHO_TYPE, SCAN_TYPE, depth_picture
from ngo_recordings.laser_scan import LidarScan, scan_of

if TYPE_CHECKING:  # live nodes need no files
    from ngo_recordings.recording import Recording

_RAYS = 1440
_BAND_M, _BAND_ON_ROBOT_M = (-0.2, 0.2), (0.1, 0.5)
_HIGH_SHARE = 0.03
"""Points so far below and above the sensor count, and above it this share of their range: rings spread. Nothing below,
where the floor is. Points that are given in the robot's own frame have the floor at about 0."""
_ROBOT_FRAMES = ("base_link", "base_footprint", "base")
_SURFACE_M = 0.1
"""Points of a ray so far behind its nearest one are of the same surface."""
_NEAREST_M, _FARTHEST_M = 0.05, 1000.0
_FARTHEST_DEPTH_M = 5.0
"""Errors of depth grow with its square: there they are 4 cm (Khoshelham and Elberink 2012)."""

_SANE_M, _MOSTLY = (1e-5, 1e5), 0.8
"""Coordinates are within these, mostly; else the driver says the wrong order of bytes, which PCL does not read."""

_NEAR, _FAR, _NEARLY_ALL = 20.0, 200.0, 0.1
"""No sensor of a robot sees all but this share of its points so far away (m), or more than it so near (mm)."""
_FEWEST, _ALIKE = 20, 0.999
"""Fewer tell no unit, and those within this of the farthest one say that nothing came back."""
_AGAIN = 10
"""So many messages in a row that say another unit are right."""
_IN_MM = "its distances are in millimetres: taken so"
_SAME_VIEW = 0.03
"""Widths and heights of two images of one view have the same ratio, but for pixels that were rounded off."""

_TIMES = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset", "ts")
_UNITS = (1.0, 1e-3, 1e-6, 1e-9)
_LONGEST_S = 1.0
_SAME_CLOCK_S = 10.0
_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def is_optical(frame: str) -> bool:
    """Whether a frame has the axes of optics: z ahead, x to the right."""
    return frame.endswith(("_optical_frame", "_optical"))


class DistanceUnit:
    """The unit of the distances on a topic: a driver may give them in millimetres. The first message that tells says
    it, not each anew."""

    def __init__(self) -> None:
        self._unit_m: float | None = None
        self._others = 0

    def metres(self, values: np.ndarray) -> float:
        """The unit (m), where a message has these distances."""
        seen = values[np.isfinite(values) & (values > 0.0)]
        seen = seen[seen < _ALIKE * seen.max(initial=0.0)]
        near = np.quantile(seen, _NEARLY_ALL) if len(seen) >= _FEWEST else _NEAR
        if not _NEAR <= near <= _FAR:  # between them it may be either
            found_m = 0.001 if near > _FAR else 1.0
            self._others = 0 if found_m == self._unit_m else self._others + 1
            if self._unit_m is None or self._others >= _AGAIN:
                self._unit_m, self._others = found_m, 0
        return self._unit_m or 1.0


def cloud_scan(message: Any, topic: str, unit: DistanceUnit | None = None) -> LidarScan:
    """The scan in a PointCloud2 of any layout; each ray has the time of its points where these have one.

    ``unit`` is that of its topic; without, the message alone says it.

    Raises:
        RecordingError: it has no x and y, no stamp, or data of another size than it says.
    """
    values = _records(message, topic)
    names = values.dtype.names or ()
    if "x" in names and (sane := _sane(values["x"])) < _MOSTLY:
        swapped = values.view(values.dtype.newbyteorder())
        values = swapped if _sane(swapped["x"]) > _MOSTLY > 2.0 * sane else values
    if not {"x", "y"} <= set(names):
        raise RecordingError(f"a cloud of {topic} has the fields {', '.join(names) or 'none'}; expected x, y and z")
    flat = np.zeros(len(values))  # a lidar of one plane may leave z out
    points = np.stack([values[name].astype(np.float64) if name in names else flat for name in "xyz"], axis=-1)
    unit_m = (unit or DistanceUnit()).metres(np.linalg.norm(points, axis=1))
    frame = str(message.header.frame_id).strip("/")
    points *= unit_m
    notes = [_IN_MM] if unit_m != 1.0 else []
    if is_optical(frame):
        points = points[:, (2, 0, 1)] * (1.0, -1.0, -1.0)
    if frame.rpartition("/")[2] in _ROBOT_FRAMES:
        low, high = _BAND_ON_ROBOT_M
        notes.append(
            f"its points are given in {frame}, not in the sensor's frame: those at {low:g} to {high:g} m count"
        )
        points[:, 2] -= low - _BAND_M[0]
    stamp_ns = header_stamp_ns(message)
    time = next((name for name in _TIMES if name in names), None)
    offsets_s = None if time is None else _offsets_s(values[time].astype(np.float64), stamp_ns * 1e-9)
    return replace(_scan(points, offsets_s, _FARTHEST_M, stamp_ns, frame, topic), note="; ".join(notes))


def depth_scan(message: Any, info: Any, topic: str, unit: DistanceUnit | None = None) -> LidarScan:
    """The scan in a depth Image, whose camera a CameraInfo describes; ``unit`` as for `cloud_scan`.

    Raises:
        RecordingError: it is no depth image, has no stamp, or the CameraInfo is not of such a camera.
    """
    if info is None:
        raise RecordingError(f"no CameraInfo came on {info_topic(topic)}, which says how {topic} was taken")
    depth = depth_picture(message, topic)
    height, width = depth.shape[:2]
    matrix = _matrix_of(info, width, height)
    if matrix is None:
        known = camera_matrix(info)
        focal = f"{known[0]:g} pixels" if known.size else "not known"
        raise RecordingError(
            f"an image of {topic} is {width} x {height}; its CameraInfo is of {info.width} x {info.height}, its focal "
            f"length {focal}"
        )
    unit_m = (unit or DistanceUnit()).metres(depth)
    ahead = unit_m * depth[..., 0].astype(np.float64)
    ahead[~(ahead < _FARTHEST_DEPTH_M)] = np.nan
    left = (matrix[2] - np.arange(width)) / matrix[0] * ahead
    up = ((matrix[5] - np.arange(height)) / matrix[4])[:, None] * ahead
    points = np.stack((ahead, left, up), axis=-1).reshape(-1, 3)
    frame = str(message.header.frame_id).strip("/")
    found = _scan(points, None, _FARTHEST_DEPTH_M, header_stamp_ns(message), frame, topic)
    return replace(found, note=_IN_MM if unit_m != 1.0 else "")


def camera_matrix(info: Any) -> np.ndarray:
    """The camera matrix ``(9,)`` of a CameraInfo, or that of its projection; nothing ``(0,)`` where it has none."""
    matrix, projection = (np.asarray(getattr(info, name, getattr(info, name.upper(), ())), float) for name in "kp")
    for each in (matrix, projection.reshape(3, 4)[:, :3].ravel() if projection.size == 12 else matrix):
        if each.size == 9 and np.isfinite(each).all() and each[0] > 0.0 and each[4] > 0.0:
            return each
    return np.zeros(0)


def _matrix_of(info: Any, width: int, height: int) -> np.ndarray | None:
    """The camera matrix ``(9,)`` of an image of this size: a part of the sensor's pixels, or fewer of the same view.

    None where the CameraInfo is of another view, or of none.
    """
    matrix = camera_matrix(info).copy()
    if not matrix.size:
        return None
    whole, corner = (info.width or 2.0 * matrix[2] + 1.0, info.height or 2.0 * matrix[5] + 1.0), (0, 0)
    roi = getattr(info, "roi", None)
    # Where it cannot lie in such a picture, the numbers are those of the part already.
    size = info.width or math.inf, info.height or math.inf
    if roi is not None and 0 < roi.width <= size[0] - roi.x_offset and 0 < roi.height <= size[1] - roi.y_offset:
        whole, corner = (roi.width, roi.height), (roi.x_offset, roi.y_offset)
    across, down = width / whole[0], height / whole[1]
    if abs(across / down - 1.0) > _SAME_VIEW:
        return None
    matrix[[0, 4]] *= across, down
    matrix[[2, 5]] = (matrix[[2, 5]] - corner + 0.5) * (across, down) - 0.5
    return matrix


def info_topic(depth_topic: str) -> str:
    """The topic of the CameraInfo beside that of an image."""
    return depth_topic.rpartition("/")[0] + "/camera_info"


def scan_reader(recording: Recording, topic: str, angle_increment: float | None = None) -> Callable[[Any], LidarScan]:
    """What makes scans of the messages of a topic; a LaserScan may have another increment than it says.

    Raises:
        RecordingError: they become no scans, or are depth without a CameraInfo.
    """
    type_name, info = recording.topics[topic].type_name, info_topic(topic)
    if type_name in (SCAN_TYPE, MULTI_ECHO_TYPE):
        return partial(scan_of, topic=topic, angle_increment=angle_increment)
    if type_name == CLOUD_TYPE:
        return partial(cloud_scan, topic=topic, unit=DistanceUnit())
    if type_name == IMAGE_TYPE and info in recording.topics and recording.topics[info].count:
        ready = (each.value for each in recording.messages([info]) if camera_matrix(each.value).size)
        return partial(depth_scan, info=next(ready, recording.first(info).value), topic=topic, unit=DistanceUnit())
    raise RecordingError(
        f"topic {topic} is {type_name}; expected {', '.join(LIDAR_TYPES)}, or depth with a CameraInfo on {info}"
    )


def _records(message: Any, topic: str) -> np.ndarray:
    """The points of a cloud, one record each."""
    height, width = int(message.height), int(message.width)
    step, row = int(message.point_step), int(message.row_step)
    known = [field for field in message.fields if field.datatype in _FORMATS and int(field.count) <= 1]
    order = ">" if message.is_bigendian else "<"
    formats = [order + _FORMATS[field.datatype] for field in known]
    ends = [field.offset + np.dtype(each).itemsize for field, each in zip(known, formats, strict=True)]
    data = np.frombuffer(message.data, np.uint8)
    if height == 1 or row < step * width:  # drivers leave it at 0
        row = step * width
    if max(ends, default=0) > step or len(data) < row * (height - 1) + step * width:
        raise RecordingError(
            f"a cloud of {topic} has {len(data)} bytes; expected {height} rows of {row} bytes, {width} points of {step}"
        )
    names = [str(field.name) for field in known]
    if len(set(names)) < len(names):
        raise RecordingError(f"a cloud of {topic} has the fields {', '.join(names)}; expected each name once")
    kind = np.dtype({"names": names, "formats": formats, "offsets": [f.offset for f in known], "itemsize": step})
    return np.ndarray((height, width), kind, data, 0, (row, step)).reshape(-1)


def _sane(values: np.ndarray) -> float:
    """Share of numbers that are coordinates; bytes in the other order are of any size."""
    sizes = np.abs(values[np.isfinite(values) & (values != 0.0)].astype(np.float64))
    return float(((sizes > _SANE_M[0]) & (sizes < _SANE_M[1])).mean()) if sizes.size else 1.0


def _offsets_s(times: np.ndarray, stamp_s: float) -> np.ndarray | None:
    """When each point was measured, after the stamp (s); None where they all have one time."""
    good = np.isfinite(times)
    if not good.any():
        return None
    low, high = float(times[good].min()), float(times[good].max())
    unit = next((unit for unit in _UNITS if (high - low) * unit <= _LONGEST_S), None)
    if unit is None or high <= low:
        return None
    times = np.where(good, times, low) * unit
    if abs(low * unit - stamp_s) < _SAME_CLOCK_S:
        return times - stamp_s
    return times if abs(low * unit) <= _LONGEST_S else times - low * unit


def _scan(
    points: np.ndarray, offsets_s: np.ndarray | None, farthest_m: float, stamp_ns: int, frame: str, topic: str
) -> LidarScan:
    """The nearest surface at each angle; angles at which no point was seen say nothing."""
    reach = np.hypot(points[:, 0], points[:, 1])
    high = np.maximum(_BAND_M[1], _HIGH_SHARE * reach)
    counts = (reach > _NEAREST_M) & (reach < farthest_m) & (points[:, 2] >= _BAND_M[0]) & (points[:, 2] <= high)
    index = np.flatnonzero(counts)
    angle = np.arctan2(points[index, 1], points[index, 0])
    step = math.tau / _RAYS
    ray = np.minimum(((angle + math.pi) / step).astype(np.int64), _RAYS - 1)
    nearest = np.full(_RAYS, np.inf)
    np.minimum.at(nearest, ray, reach[index])
    surface = reach[index] <= nearest[ray] + _SURFACE_M
    index, ray = index[surface], ray[surface]
    number = np.bincount(ray, minlength=_RAYS)
    seen = number > 0
    ranges = np.full(_RAYS, np.nan, np.float32)
    ranges[seen] = (np.bincount(ray, reach[index], _RAYS) / np.maximum(number, 1))[seen]
    offsets = None
    if offsets_s is not None and seen.any():
        mean = np.bincount(ray, offsets_s[index], _RAYS) / np.maximum(number, 1)
        offsets = np.interp(np.arange(_RAYS), np.flatnonzero(seen), mean[seen])
    return LidarScan(stamp_ns, 0.5 * step - math.pi, step, ranges, _NEAREST_M, farthest_m, 0.0, frame, offsets, topic)
