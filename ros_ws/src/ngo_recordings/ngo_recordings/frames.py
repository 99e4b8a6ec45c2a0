"""A recording as frames: picture or scan, the step that led to it, and where the robot truly was."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ngo_recordings.association import (
    RESTART_NS,
    Actions,
    Depths,
    Side,
    TruePoses,
    TrueTransforms,
    Twists,
    header_stamp_ns,
)
from ngo_recordings.errors import RecordingError
from ngo_recordings.images import ScanGeometry, depth_picture, picture, with_depth
from ngo_recordings.poses import read_tum
from ngo_recordings.recording import Message, Recording
from ngo_recordings.topics import TF_TYPE, RecordingTopics

__all__ = ["Frame", "ScanGeometry", "frames"]

NO_DEPTH = "no depth within the tolerance"
UNUSABLE = "damaged, or of another size or encoding than before"

# How far the recording is read on for what belongs to an image, before the image is taken without it.
_WAIT_NS = 2_000_000_000


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


def frames(
    recording: Recording,
    topics: RecordingTopics,
    skipped: Counter[str] | None = None,
    largest: tuple[int, int] | None = None,
) -> Iterator[Frame]:
    """The frames of a recording in the order of its images; stamps are the recording's own and may jump.

    Reads the recording once. An image waits for what belongs to it, at most 2 s of the recording, so memory is bounded.

    Args:
        skipped: counts images that gave no frame, by the reason (NO_DEPTH, UNUSABLE).
        largest: see `picture`.

    Raises:
        RecordingError: an image that is damaged, of an encoding that is not supported, or of another size than those
            before. Where skipped is given, only for the first; later ones are counted.
    """
    try:
        yield from _Frames(recording, topics, skipped, largest).run()
    except AttributeError as error:
        raise RecordingError(f"a message is not what its type should be ({error}): is the recording damaged?") from None


class _Frames:
    """One pass over a recording."""

    def __init__(
        self,
        recording: Recording,
        topics: RecordingTopics,
        skipped: Counter[str] | None,
        largest: tuple[int, int] | None,
    ) -> None:
        self._recording, self._topics, self._largest = recording, topics, largest
        self._tolerant = skipped is not None
        self._skipped: Counter[str] = Counter() if skipped is None else skipped
        tolerance_ns, gap_ns = round(topics.tolerance_s * 1e9), round(topics.interpolation_s * 1e9)
        self._depth = Depths(tolerance_ns)
        self._actions = Actions(tolerance_ns)
        self._twists = Twists(round(topics.twist_tolerance_s * 1e9))
        self._truth: TruePoses | TrueTransforms | None = None
        self._sides: list[tuple[Side, tuple[str, ...]]] = []
        if topics.depth is not None:
            self._sides.append((self._depth, (topics.depth,)))
        if topics.action is not None:
            self._sides.append((self._actions, (topics.action,)))
        if topics.twist is not None:
            self._sides.append((self._twists, (topics.twist,)))
        truth = topics.ground_truth
        if truth is not None and truth.tum is not None:
            self._truth = TruePoses(gap_ns, read_tum(truth.tum, gap_ns))
        elif truth is not None and truth.tf is not None:
            names = tuple(name for name, info in recording.topics.items() if info.type_name == TF_TYPE)
            self._truth = TrueTransforms(*truth.tf, gap_ns)
            self._sides.append((self._truth, names))
        elif truth is not None and truth.topic is not None:
            self._truth = TruePoses(gap_ns)
            self._sides.append((self._truth, (truth.topic,)))
        self._ends_ns = [max(recording.topics[name].last_ns for name in names) for _, names in self._sides]
        self._pending: deque[Message] = deque()
        self._newest_ns: int | None = None  # of the images that came, since the source started
        # Newest of the images that gave a frame, from which the next step begins; None: there is no step.
        self._before_ns: int | None = None
        self._shape: tuple[int, ...] | None = None

    def run(self) -> Iterator[Frame]:
        names = {self._topics.image, *(name for _, names in self._sides for name in names)}
        for message in self._recording.messages(names):
            for side, topics in self._sides:
                if message.topic in topics:
                    if side.restarts(message):
                        yield from self._take_all()
                        side.clear()
                    side.add(message)
            if message.topic == self._topics.image:
                yield from self._arrived(message)
            while self._pending and self._complete(self._pending[0], message.log_time_ns):
                yield from self._take()
        yield from self._take_all()

    def _arrived(self, message: Message) -> Iterator[Frame]:
        stamp_ns = header_stamp_ns(message.value)
        if self._newest_ns is not None and stamp_ns <= self._newest_ns - RESTART_NS:
            yield from self._take_all()
            self._before_ns = self._newest_ns = None
        self._newest_ns = stamp_ns if self._newest_ns is None else max(self._newest_ns, stamp_ns)
        self._pending.append(message)

    def _complete(self, image: Message, now_ns: int) -> bool:
        """Whether all that belongs to an image is there, or is no longer waited for."""
        if now_ns - image.log_time_ns > _WAIT_NS:
            return True
        stamp_ns = header_stamp_ns(image.value)
        return all(
            side.knows(self._before_ns, stamp_ns) or now_ns > end_ns
            for (side, _), end_ns in zip(self._sides, self._ends_ns, strict=True)
        )

    def _take_all(self) -> Iterator[Frame]:
        while self._pending:
            yield from self._take()

    def _take(self) -> Iterator[Frame]:
        """The frame of the first image that is pending, if it gives one."""
        message = self._pending.popleft()
        stamp_ns, before_ns = header_stamp_ns(message.value), self._before_ns
        try:
            decoded = self._decoded(message, stamp_ns)
        except RecordingError:
            if not self._tolerant or self._shape is None:
                raise
            self._skipped[UNUSABLE] += 1
            decoded = None
        if decoded is None:  # like an image that was never recorded
            return
        self._before_ns = stamp_ns if before_ns is None else max(before_ns, stamp_ns)
        image, scan = decoded
        yield self._frame(stamp_ns, before_ns, image, scan)
        for side, _ in self._sides:
            side.forget_before(stamp_ns)

    def _decoded(self, message: Message, stamp_ns: int) -> tuple[np.ndarray, ScanGeometry | None] | None:
        """The image with its depth; None where that is missing."""
        type_name = self._recording.topics[message.topic].type_name
        image, scan = picture(message.value, type_name, message.topic, self._largest)
        if self._topics.depth is not None:
            depth = self._depth.at(stamp_ns)
            if depth is None:
                self._skipped[NO_DEPTH] += 1
                return None
            image = with_depth(image, depth_picture(depth, self._topics.depth), self._topics.depth)
        if scan is None and self._shape not in (None, image.shape):
            raise RecordingError(
                f"the image of {message.topic} at {stamp_ns / 1e9:.9f} s is {image.shape} after images of "
                f"{self._shape} (height, width, channels): split the recording there"
            )
        self._shape = image.shape
        self._largest = image.shape[0], image.shape[1]
        return image, scan

    def _frame(self, stamp_ns: int, before_ns: int | None, image: np.ndarray, scan: ScanGeometry | None) -> Frame:
        pose = residual = action = twist = None
        if self._truth is not None and (true := self._truth.at(stamp_ns)) is not None:
            pose, residual = true.planar()
        if before_ns is not None and stamp_ns > before_ns:
            action, twist = self._actions.step(before_ns, stamp_ns), self._twists.step(before_ns, stamp_ns)
        return Frame(stamp_ns, image, scan, action, twist, pose, residual)
