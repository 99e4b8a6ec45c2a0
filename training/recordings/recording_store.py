"""Recordings as arrays on disk: every frame as networks take it, made once for all commands of a training."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from tqdm import tqdm

from ngo_common.files import write_whole
from ngo_estimator.data.configuration import config_from_dict
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.observations import observation
from ngo_recordings.errors import RecordingError
from ngo_recordings.frames import Frame, frames
from ngo_recordings.recording import open_recording
from ngo_recordings.topics import GroundTruth, TopicArguments, choose_topics
from training.data.data_source import MIRRORED_ACTIONS

MOST_COLUMNS = 96  # Pictures that are wider are made smaller, by the least whole factor.
MOST_RAYS = 289  # A scan's format has at most as many rays.
_INDEX = "store.json"
_VERSION = 1
_NO_ACTION = -1


@dataclass(frozen=True)
class StoredRecording:
    """The frames of one recording, memory-mapped.

    images: ``(frames, height, width, channels)``. stamps_ns ``(frames,)``, poses_xyyaw ``(frames, 3)`` (NaN: no true
    pose), residuals ``(frames, 3)``: z (m), roll and pitch (rad), which the projection to the plane leaves out. actions
    ``(frames,)`` (-1: none) and twists ``(frames, 3)`` (NaN: none) of the step that led to a frame.
    """

    name: str
    images: np.ndarray
    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray
    residuals: np.ndarray
    actions: np.ndarray
    twists: np.ndarray
    with_actions: bool
    with_twist: bool
    skipped: dict[str, int]


def make_store(
    folder: Path,
    files: tuple[Path, ...],
    given: TopicArguments,
    image: ImageFormat | None,
    reduction: int | None,
    scan_yaw_rad: float = 0.0,
) -> tuple[ImageFormat, list[StoredRecording], str]:
    """The format of the frames, the recordings, each file one, and a hash of what they were made from.

    They are read now, or as they were left in ``folder``.

    Args:
        image: what the frames must become; None: what the first recording gives.
        reduction: how many times smaller pictures are made; None: what ``MOST_COLUMNS`` asks for.
        scan_yaw_rad: where a scanner's angle 0 points, counter-clockwise from straight ahead.

    Raises:
        RecordingError: of one line, about a recording that cannot be used to train on.
    """
    identity = _identity(files, given, image, reduction, scan_yaw_rad)
    index = folder / _INDEX
    if not index.exists() or json.loads(index.read_text())["identity"] != identity:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        described = []
        for number, path in enumerate(files):
            image, values = _read(folder / str(number), path, given, image, reduction, scan_yaw_rad)
            described.append(values)
        assert image is not None
        content = {"identity": identity, "image": dataclasses.asdict(image), "recordings": described}
        write_whole(index, json.dumps(content, indent=1) + "\n")
    content = json.loads(index.read_text())
    image = config_from_dict(ImageFormat, content["image"])
    recordings = [_open(folder / str(n), image, values) for n, values in enumerate(content["recordings"])]
    return image, recordings, hashlib.sha256(json.dumps(identity).encode()).hexdigest()


def _identity(
    files: tuple[Path, ...],
    given: TopicArguments,
    image: ImageFormat | None,
    reduction: int | None,
    scan_yaw_rad: float,
) -> Any:
    """Everything that the content of a store depends on, as JSON gives it back."""
    settings = [dataclasses.asdict(given), image and dataclasses.asdict(image), reduction, scan_yaw_rad]
    found: list[Any] = [_VERSION, *settings]
    for path in files:
        if not path.exists():
            raise RecordingError(f"there is no file {path}")
    truth = None if given.ground_truth in (None, "none") else GroundTruth.parse(str(given.ground_truth)).tum
    for path in (*files, *((truth,) if truth is not None and truth.exists() else ())):
        parts = sorted(path.iterdir()) if path.is_dir() else [path]
        found.append([str(path), [[part.name, part.stat().st_size, part.stat().st_mtime_ns] for part in parts]])
    return json.loads(json.dumps(found))


def format_of(frame: Frame, reduction: int | None, scan_yaw_rad: float = 0.0) -> ImageFormat:
    """The format that fits a sensor: its resolution, made smaller where that is large, and a scan's field of view.

    A format looks as far to the left as to the right: that of a scanner that does not, as far as its outermost ray.
    """
    height, width, channels = frame.image.shape
    if frame.scan is not None:
        step = frame.scan.angle_increment_rad
        if math.degrees(width * step) > 359.5:
            return ImageFormat(1, min(width, MOST_RAYS), 1, "float32", 360.0)
        angles = frame.scan.angle_min_rad + scan_yaw_rad + step * np.arange(width)
        half = float(np.abs((angles + math.pi) % math.tau - math.pi).max())
        rays = min(round(2.0 * half / step) + 1, MOST_RAYS)
        return ImageFormat(1, rays, 1, "float32", min(round(math.degrees(2.0 * half), 3), 360.0))
    factor = reduction or (math.ceil(width / MOST_COLUMNS) if height > 1 else 1)
    return ImageFormat(height // factor, width // factor, channels, str(frame.image.dtype), reduction=factor)


def _read(
    folder: Path,
    path: Path,
    given: TopicArguments,
    image: ImageFormat | None,
    reduction: int | None,
    scan_yaw_rad: float,
) -> tuple[ImageFormat, dict[str, Any]]:
    """Write the arrays of a recording; returns the format of its frames, and what the index says of it."""
    folder.mkdir()
    skipped: Counter[str] = Counter()
    columns: dict[str, list[Any]] = {"stamps_ns": [], "poses_xyyaw": [], "residuals": [], "actions": [], "twists": []}
    none = np.full(3, np.nan)
    with open_recording([path]) as recording, (folder / "images.raw").open("wb") as file:
        topics = choose_topics(recording, given)
        if topics.ground_truth is None:
            raise RecordingError(
                f"{path} has no ground truth, which training needs: name it with --ground-truth TOPIC, tf:PARENT:CHILD "
                "or FILE.tum (as from a motion capture, or from a SLAM run over the same recording); "
                "`python -m training.inspect_recording` shows what there is"
            )
        count = recording.topics[topics.image].count
        for frame in tqdm(frames(recording, topics, skipped), desc=f"reading {path.name}", total=count):
            image = _write_image(file, path, frame, image, reduction, scan_yaw_rad)
            if frame.action is not None and frame.action >= len(MIRRORED_ACTIONS):
                raise RecordingError(
                    f"{path}: {topics.action} holds action {frame.action}; expected 0 to {len(MIRRORED_ACTIONS) - 1}: "
                    "leave it out with --action none"
                )
            columns["stamps_ns"].append(frame.stamp_ns)
            columns["poses_xyyaw"].append(none if frame.pose_xyyaw is None else frame.pose_xyyaw)
            columns["residuals"].append(none if frame.pose_residual is None else frame.pose_residual)
            columns["actions"].append(_NO_ACTION if frame.action is None else frame.action)
            columns["twists"].append(none if frame.twist_xyyaw is None else frame.twist_xyyaw)
    if image is None:
        raise RecordingError(f"{path} has no frame that can be used")
    np.savez(folder / "columns.npz", **{name: np.array(values) for name, values in columns.items()})  # type: ignore[arg-type]
    values = {
        "name": path.name,
        "frames": len(columns["stamps_ns"]),
        "topics": {field.name: str(getattr(topics, field.name)) for field in dataclasses.fields(topics)},
        "with_actions": topics.action is not None,
        "with_twist": topics.twist is not None,
        "skipped": dict(skipped),
    }
    return image, values


def _write_image(
    file: BinaryIO, path: Path, frame: Frame, image: ImageFormat | None, reduction: int | None, scan_yaw_rad: float
) -> ImageFormat:
    try:
        image = image or format_of(frame, reduction, scan_yaw_rad)
        file.write(np.ascontiguousarray(observation(image, frame.image, frame.scan, scan_yaw_rad)).tobytes())
    except ValueError as error:
        raise RecordingError(
            f"{path}: {error}: the recordings (and the weights to begin with) must be of one sensor"
        ) from None
    return image


def _open(folder: Path, image: ImageFormat, values: dict[str, Any]) -> StoredRecording:
    shape = (values["frames"], *image.shape)
    with np.load(folder / "columns.npz") as columns:
        return StoredRecording(
            name=values["name"],
            images=np.memmap(folder / "images.raw", dtype=image.dtype, mode="r", shape=shape),
            with_actions=values["with_actions"],
            with_twist=values["with_twist"],
            skipped=values["skipped"],
            **{name: columns[name] for name in columns.files},
        )
