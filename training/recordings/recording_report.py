"""The numbers behind inspect_recording: content of a recording, its quality and its faults."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from tqdm import tqdm

from ngo_recordings.association import header_stamp_ns
from ngo_recordings.frames import NO_DEPTH, UNUSABLE, Frame, frames
from ngo_recordings.images import LIDAR_TYPES
from ngo_recordings.recording import Message, Recording
from ngo_recordings.topics import POSE_TYPES, TF_TYPE, RecordingTopics, transform_topics

REVISIT_M = 1.0  # A place is visited again where the path comes this close to where it was before...
REVISIT_AFTER_M = 5.0  # ...after at least this long a way.
FEW_REVISITS = 0.05  # Share of the frames; with less there is little to learn loops from.
FEW_FRAMES = 200  # Of one recording.
SAMPLES = 6  # How many images of a recording are kept to be shown.
_REVISIT_FRAMES = 5000
_GAP = 3.0
_LONGEST_SIMULATION_S = 365.0 * 24.0 * 3600.0


@dataclass(frozen=True)
class TopicTimes:
    """When the messages of a topic came. Times in s; skew is header stamp less log time, 0 where there is no header."""

    rate_hz: float
    longest_gap_s: float
    gaps: int  # intervals over 3 times the median
    not_rising: int  # stamps that are no later than the one before
    skew_median_s: float
    skew_spread_s: float  # from the first to the last percentile
    frame_ids: tuple[str, ...]
    without_header: bool
    simulated: bool  # stamps of a simulator's clock, which began near 0, logged by the clock of the day


@dataclass(frozen=True)
class Motion:
    """Ground truth from frame to frame: medians and 95th percentiles of a step, and of the whole."""

    path_m: float
    turned_rad: float
    step_m: tuple[float, float, float]  # median, 95 %, largest
    step_rad: tuple[float, float, float]
    standing: float  # share of steps under 1 mm and 0.1 deg
    revisits: float  # share of frames
    height_range_m: float
    largest_tilt_rad: float


@dataclass(frozen=True)
class Report:
    """A recording in numbers. arrays: what a picture needs (stamps_s, poses_xyyaw with NaN where there is none)."""

    files: tuple[str, ...]
    topics: dict[str, dict[str, Any]]
    uses: dict[str, str]
    times: dict[str, TopicTimes]
    frames: int
    image: str
    with_pose: int
    with_action: int
    with_twist: int
    skipped: dict[str, int]
    motion: Motion | None
    problems: tuple[str, ...]
    stamps_s: np.ndarray = field(repr=False)
    poses_xyyaw: np.ndarray = field(repr=False)
    samples: tuple[np.ndarray, ...] = field(repr=False)

    def numbers(self) -> dict[str, Any]:
        """The numbers as JSON takes them."""
        plain = {
            name: getattr(self, name)
            for name in ("files", "topics", "uses", "frames", "image", "with_pose", "with_action", "with_twist")
        }
        return {
            **plain,
            "times": {name: vars(times) for name, times in self.times.items()},
            "skipped": dict(self.skipped),
            "motion": None if self.motion is None else vars(self.motion),
            "problems": list(self.problems),
        }


def inspect(recording: Recording, topics: RecordingTopics) -> Report:
    """Read a recording twice: once for the times of what is used, once as frames.

    Raises RecordingError where it cannot be read.
    """
    uses = topic_uses(recording, topics)
    times = topic_times(recording, [name for name in uses if name in recording.topics])
    skipped: Counter[str] = Counter()
    count = max(1, recording.topics[topics.image].count)
    wanted = {round(index) for index in np.linspace(0, count - 1, SAMPLES)}
    stamps, poses, residuals, samples, have, image = [], [], [], [], Counter[str](), ""
    for index, frame in enumerate(tqdm(frames(recording, topics, skipped), "frames", count, leave=False, disable=None)):
        stamps.append(frame.stamp_ns)
        poses.append(np.full(3, np.nan) if frame.pose_xyyaw is None else frame.pose_xyyaw)
        residuals.append(np.full(3, np.nan) if frame.pose_residual is None else frame.pose_residual)
        have.update(pose=frame.pose_xyyaw is not None, action=frame.action is not None)
        have.update(twist=frame.twist_xyyaw is not None)
        image = image or describe_image(frame)
        if index in wanted:
            samples.append(frame.image)
    arrays = np.array(stamps, np.int64), np.array(poses).reshape(-1, 3), np.array(residuals).reshape(-1, 3)
    motion = motion_of(arrays[1], arrays[2])
    found = _Findings(recording, topics, times, len(stamps), have, skipped, motion)
    return Report(
        files=tuple(str(path) for path in recording.paths),
        topics={name: topic_row(recording, name) for name in recording.topics},
        uses=uses,
        times=times,
        frames=len(stamps),
        image=image,
        with_pose=have["pose"],
        with_action=have["action"],
        with_twist=have["twist"],
        skipped=dict(skipped),
        motion=motion,
        problems=tuple(found.lines()),
        stamps_s=arrays[0] / 1e9,
        poses_xyyaw=arrays[1],
        samples=tuple(samples),
    )


def topic_row(recording: Recording, name: str) -> dict[str, Any]:
    """Type, count and mean rate of a topic."""
    info = recording.topics[name]
    span_s = (info.last_ns - info.first_ns) / 1e9
    rate_hz = (info.count - 1) / span_s if span_s > 0 else 0.0
    return {"type": info.type_name, "count": info.count, "rate_hz": rate_hz}


def topic_uses(recording: Recording, topics: RecordingTopics) -> dict[str, str]:
    """The use of each topic or file."""
    uses: dict[str, str] = {}

    def use(name: str | None, what: str) -> None:
        if name is not None:
            uses[name] = f"{uses[name]}, {what}" if name in uses else what

    use(topics.image, "image")
    for name in topics.more_scans:
        use(name, "scans of another scanner")
    if recording.topics[topics.image].type_name in LIDAR_TYPES:
        for name in transform_topics(recording, topics.image):
            use(name, "where the scanner sits")
    use(topics.depth, "depth channel")
    use(topics.action, "action of each step")
    use(topics.twist, "velocity of each step")
    if topics.wheels is not None:
        by_tf = transform_topics(recording, topics.image)
        for wheels in [topics.wheels.topic] if topics.wheels.tf is None else by_tf:
            use(wheels, f"wheels ({topics.wheels})")
    use(topics.imu, "yaw rate of the IMU")
    truth = topics.ground_truth
    if truth is not None and truth.tf is not None:
        for name, info in recording.topics.items():
            if info.type_name == TF_TYPE:
                use(name, f"ground truth ({truth})")
    elif truth is not None:
        use(str(truth), "ground truth")
    return uses


def topic_times(recording: Recording, names: list[str]) -> dict[str, TopicTimes]:
    """When the messages of these topics came."""
    logs: dict[str, list[int]] = {name: [] for name in names}
    stamps: dict[str, list[int]] = {name: [] for name in names}
    frame_ids: dict[str, set[str]] = {name: set() for name in names}
    total = sum(recording.topics[name].count for name in names)
    for message in tqdm(recording.messages(names), "times", total, leave=False, disable=None):
        logs[message.topic].append(message.log_time_ns)
        stamp_ns, ids = _stamp(message)
        frame_ids[message.topic] |= ids
        if stamp_ns is not None:
            stamps[message.topic].append(stamp_ns)
    return {name: _times(logs[name], stamps[name], frame_ids[name]) for name in names}


def _stamp(message: Message) -> tuple[int | None, set[str]]:
    """Stamp and frame names; those of the first transform of several, which may have stamps of their own."""
    value = message.value
    if hasattr(value, "transforms"):
        pairs = {f"{each.header.frame_id} -> {each.child_frame_id}" for each in value.transforms}
        return None, pairs
    if not hasattr(value, "header"):
        return None, set()
    child = getattr(value, "child_frame_id", "")
    name = str(value.header.frame_id)
    return header_stamp_ns(value), {f"{name} -> {child}" if child else name}


def _times(logs: list[int], stamps: list[int], frame_ids: set[str]) -> TopicTimes:
    times = np.array(stamps or logs, np.int64)
    steps_s = np.diff(times) / 1e9
    rising = steps_s[steps_s > 0]
    median_s = float(np.median(rising)) if len(rising) else 0.0
    skew_s = (np.array(stamps) - np.array(logs)) / 1e9 if stamps else np.zeros(1)
    low, middle, high = np.percentile(skew_s, (1, 50, 99)).tolist()
    return TopicTimes(
        rate_hz=1.0 / median_s if median_s else 0.0,
        longest_gap_s=float(rising.max(initial=0.0)),
        gaps=int((rising > _GAP * median_s).sum()),
        not_rising=int((steps_s <= 0).sum()),
        skew_median_s=middle,
        skew_spread_s=high - low,
        frame_ids=tuple(sorted(frame_ids)),
        without_header=not stamps,
        simulated=middle < -_LONGEST_SIMULATION_S,
    )


def describe_image(frame: Frame) -> str:
    """Size and kind of the images."""
    height, width, channels = frame.image.shape
    if frame.scan is not None:
        view_deg = math.degrees((width - 1) * frame.scan.angle_increment_rad)
        return (
            f"scan of {width} rays over {view_deg:.1f} deg, {frame.scan.range_min_m:g} to {frame.scan.range_max_m:g} m"
        )
    kinds = {("uint8", 1): "grey", ("uint8", 3): "colour", ("float32", 1): "depth", ("float32", 4): "colour and depth"}
    return f"{width} x {height}, {kinds[str(frame.image.dtype), channels]}"


def motion_of(poses_xyyaw: np.ndarray, residuals: np.ndarray) -> Motion | None:
    """Statistics of the ground truth ``(frames, 3)``, NaN where there is none; None where there are no two poses."""
    known = np.isfinite(poses_xyyaw[:, 0])
    if known.sum() < 2:
        return None
    pairs = known[1:] & known[:-1]
    steps = np.diff(poses_xyyaw, axis=0)[pairs]
    if not len(steps):
        return None
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    turns = np.abs((steps[:, 2] + math.pi) % math.tau - math.pi)
    residuals = residuals[known]
    return Motion(
        path_m=float(lengths.sum()),
        turned_rad=float(turns.sum()),
        step_m=_spread(lengths),
        step_rad=_spread(turns),
        standing=float(((lengths < 1e-3) & (turns < math.radians(0.1))).mean()),
        revisits=revisits(poses_xyyaw[known, :2]),
        height_range_m=float(np.ptp(residuals[:, 0])),
        largest_tilt_rad=float(np.abs(residuals[:, 1:]).max()),
    )


def revisits(positions: np.ndarray) -> float:
    """Share of the positions ``(frames, 2)`` where the path comes back to where it was: see REVISIT_M."""
    stride = max(1, math.ceil(len(positions) / _REVISIT_FRAMES))
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(positions, axis=0).T))))[::stride]
    places = positions[::stride]
    near = cKDTree(places).query_ball_point(places, REVISIT_M)
    # The lists hold indices in any order; the smallest is the earliest visit.
    first = np.array([min(indices) for indices in near])
    return float((along - along[first] > REVISIT_AFTER_M).mean())


def _spread(values: np.ndarray) -> tuple[float, float, float]:
    median, most, largest = np.percentile(values, (50, 95, 100)).tolist()
    return median, most, largest


@dataclass(frozen=True)
class _Findings:
    """The faults of a recording, each in one line with its remedy."""

    recording: Recording
    topics: RecordingTopics
    times: dict[str, TopicTimes]
    frames: int
    have: Counter[str]
    skipped: Counter[str]
    motion: Motion | None

    def lines(self) -> Iterator[str]:
        for path in self.recording.unfinished:
            yield f"{path} has no end (its recorder was killed): it is read to its last whole chunk"
        yield from self._of_times()
        if count := self.skipped[NO_DEPTH]:
            yield f"{count} images are left out, {NO_DEPTH}: raise --tolerance-s, or record depth at the images' rate"
        if count := self.skipped[UNUSABLE]:
            yield f"{count} images are left out, {UNUSABLE}: record anew, or cut the recording there"
        if self.frames < 2:
            yield f"there are {self.frames} frames: a recording needs two at least"
            return
        for use, what in (("action", self.topics.action), ("twist", self.topics.twist)):
            if what is not None and (share := self.have[use] / (self.frames - 1)) < 0.95:
                yield (
                    f"{share:.0%} of the steps have a message of {what} in their time: raise --tolerance-s, or leave "
                    f"it out with --{use} none"
                )
        yield from self._of_truth()

    def _of_times(self) -> Iterator[str]:
        for name, times in self.times.items():
            if times.not_rising:
                yield f"{times.not_rising} stamps of {name} repeat or go back: the source restarted, or stamps badly"
            if times.gaps and name == self.topics.image:
                yield (
                    f"{name} has {times.gaps} gaps of up to {times.longest_gap_s:.2f} s: frames were lost; record with "
                    "less load, or cut the recording there"
                )
            # Simulated time passes at a pace of its own.
            if times.skew_spread_s > 0.5 and not times.simulated:
                yield (
                    f"stamps of {name} drift by {times.skew_spread_s:.2f} s against when they were logged: "
                    "check the driver's clock"
                )
        image = self.times[self.topics.image]
        for name, times in self.times.items():
            apart_s = times.skew_median_s - image.skew_median_s
            both_simulated = times.simulated and image.simulated
            if name != self.topics.image and not (times.without_header or both_simulated) and abs(apart_s) > 0.5:
                yield (
                    f"{name} is stamped {apart_s:+.2f} s from {self.topics.image}: the clocks differ; let both "
                    "machines keep time (chrony, PTP)"
                )

    def _of_truth(self) -> Iterator[str]:
        truth = self.topics.ground_truth
        if truth is None:
            candidates = [
                name for name, info in self.recording.topics.items() if info.type_name in (*POSE_TYPES, TF_TYPE)
            ]
            yield (
                "there is no ground truth, which training needs (running does not): name it with --ground-truth, a "
                f"topic, tf:PARENT:CHILD or a TUM file; candidates here: {', '.join(candidates) or 'none'}"
            )
            return
        if (share := self.have["pose"] / self.frames) < 0.95:
            pairs = sorted({pair for times in self.times.values() for pair in times.frame_ids if " -> " in pair})
            hint = f"; transforms here: {', '.join(pairs) or 'none'}" if truth.tf is not None else ""
            yield (
                f"{share:.0%} of the frames have a true pose of {truth}: raise --interpolation-s, or check its rate, "
                f"its clock and its frames{hint}"
            )
        if self.motion is None:
            return
        if self.motion.largest_tilt_rad > math.radians(20.0):
            yield (
                f"{truth} tilts by up to {math.degrees(self.motion.largest_tilt_rad):.0f} deg: the motion is not "
                "planar, or the frame is a camera's optical frame; name one with x forward and z up"
            )
        if self.motion.step_m[2] > 1.0 and self.motion.step_m[2] > 20.0 * self.motion.step_m[1]:
            yield f"{truth} jumps by {self.motion.step_m[2]:.2f} m in a step: choose one that is smooth, or cut there"
        if self.motion.path_m < 1.0:
            yield f"the robot moves {self.motion.path_m:.2f} m in all: drive further to have something to learn from"
        elif self.motion.revisits < FEW_REVISITS:
            yield (
                f"{self.motion.revisits:.0%} of the frames show a place that was passed before: loops are learned "
                "where the robot comes by again, so drive rounds"
            )
        if self.have["pose"] < FEW_FRAMES:
            yield f"{self.have['pose']} frames with a true pose are few to learn from: record a few thousand in all"
