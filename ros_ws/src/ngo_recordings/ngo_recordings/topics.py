"""Which topics of a recording are used for what."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ngo_recordings.errors import RecordingError
from ngo_recordings.images import COMPRESSED_TYPE, DEPTH_ENCODINGS, IMAGE_TYPE, LIDAR_TYPES, SENSOR_TYPES
from ngo_recordings.transform_buffer import TransformBuffer, is_named

if TYPE_CHECKING:  # live nodes need no files
    from ngo_recordings.recording import Recording

ACTION_TYPE = "ngo_msgs/msg/DiscreteAction"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
TWIST_TYPES = ("geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist", ODOMETRY_TYPE)
POSE_TYPES = (ODOMETRY_TYPE, "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped")
WHEEL_TYPES = (*POSE_TYPES, TWIST_TYPES[0])  # of which Odometry alone is taken without being named
TF_TYPE = "tf2_msgs/msg/TFMessage"
IMU_TYPE = "sensor_msgs/msg/Imu"

_NONE = "none"
_SCANS = (*LIDAR_TYPES, IMAGE_TYPE)  # of depth
_BASE_FRAMES = ("base_link", "base_footprint", "base")
_ODOMETRY_FRAME = "odom"
_GLOBAL_FRAMES = ("map", "world", "earth")
# Of several odometries of a robot, those of the first pattern come first; others are not taken without being named.
_WHEEL_NAMES = tuple(re.compile(pattern, re.IGNORECASE) for pattern in (r"wheel|encoder|odom_enc", r"(^|/)odom$"))
# How much of the transforms is looked through for odom -> base_link.
_LOOK_NS = 10_000_000_000
_COMMAND_NAMES = re.compile(r"cmd|command|goal|initial_?pose", re.IGNORECASE)
_TRUTH_NAMES = re.compile(r"ground_?truth|(^|[/_])(gt|truth|mocap|vicon|optitrack)([/_]|$)", re.IGNORECASE)


@dataclass(frozen=True)
class GroundTruth:
    """Where the true poses come from: exactly one of a topic, two TF frames, or a file.

    topic: of nav_msgs/Odometry, geometry_msgs/PoseStamped or PoseWithCovarianceStamped. tf: parent and child frame,
    looked up through the tree. tum: file in the TUM format, stamps of the same clock as the images'.
    """

    topic: str | None = None
    tf: tuple[str, str] | None = None
    tum: Path | None = None

    def __post_init__(self) -> None:
        if sum(field is not None for field in (self.topic, self.tf, self.tum)) != 1:
            raise RecordingError("ground truth is exactly one of a topic, two TF frames, or a file in the TUM format")

    @classmethod
    def parse(cls, text: str) -> GroundTruth:
        """From the command line: `tf:PARENT:CHILD`, a file ending in .tum or .txt, or else a topic.

        Raises RecordingError for a tf: of another form.
        """
        if text.startswith("tf:"):
            return cls(tf=_frames(text, "ground truth", "tf:map:base_link"))
        if text.endswith((".tum", ".txt")):
            return cls(tum=Path(text))
        return cls(topic=text)

    def __str__(self) -> str:
        if self.tf is not None:
            return f"tf:{self.tf[0]}:{self.tf[1]}"
        return str(self.topic if self.tum is None else self.tum)


@dataclass(frozen=True)
class WheelSource:
    """Where the wheel odometry comes from: a topic of nav_msgs/Odometry, or the parent and child frame of a transform.

    Exactly one of topic and tf is given. A pair of frames is looked up through the tree.
    """

    topic: str | None = None
    tf: tuple[str, str] | None = None

    def __post_init__(self) -> None:
        if (self.topic is None) == (self.tf is None):
            raise RecordingError("wheel odometry is exactly one of a topic and two TF frames")

    @classmethod
    def parse(cls, text: str) -> WheelSource:
        """From the command line: `tf:PARENT:CHILD`, or else a topic.

        Raises RecordingError for a tf: of another form.
        """
        return cls(tf=_frames(text, "wheel odometry", "tf:odom:base_link")) if text.startswith("tf:") else cls(text)

    def __str__(self) -> str:
        return str(self.topic) if self.tf is None else f"tf:{self.tf[0]}:{self.tf[1]}"


@dataclass(frozen=True)
class TopicArguments:
    """What a person says about topics on the command line; a field that is not given is chosen, `none` uses nothing."""

    image: str | None = None
    """Topic of the pictures or scans: Image, CompressedImage or LaserScan; for a lidar MultiEchoLaserScan, PointCloud2,
    and depth, too."""
    depth: str | None = None
    """Topic of a depth image (32FC1, 16UC1) that becomes one more channel of the pictures; none unless given."""
    action: str | None = None
    """Topic of the actions, ngo_msgs/DiscreteAction."""
    twist: str | None = None
    """Topic of the velocity as side information: Twist, TwistStamped or Odometry."""
    ground_truth: str | None = None
    """True poses: a topic of Odometry or PoseStamped, tf:PARENT:CHILD, or a file in the TUM format."""
    tolerance_s: float = 0.05
    """How far the stamps of an image and of its action or depth may be apart, s."""
    interpolation_s: float = 0.25
    """True poses are interpolated between two that are at most this far apart, s."""
    twist_tolerance_s: float = 0.5
    """How old a velocity may be that is used for a step during which none came, s."""
    scan_topics: tuple[str, ...] = ()
    """Topics of several scanners, whose scans are put together; the first one is the image."""
    wheels: str | None = None
    """Wheel odometry: a topic of Odometry, poses or TwistStamped, or tf:PARENT:CHILD; chosen for scans alone."""
    imu: str | None = None
    """Topic of an Imu, whose yaw rate stands in for the wheels' turns where it agrees better with the scans."""

    def __post_init__(self) -> None:
        _check_times(self.tolerance_s, self.interpolation_s, self.twist_tolerance_s)


@dataclass(frozen=True)
class RecordingTopics:
    """What is used for what; None: nothing. `choose_topics` makes one that fits the recording.

    image: Image, CompressedImage, LaserScan, MultiEchoLaserScan or PointCloud2. depth: Image of depth, one more
    channel. action: DiscreteAction. twist: Twist, TwistStamped or Odometry. wheels, imu: wheel odometry and Imu, for
    `scan_stream`; no_wheels: none are wanted. more_scans: those of other scanners. The times are those of
    TopicArguments.
    """

    image: str
    depth: str | None = None
    action: str | None = None
    twist: str | None = None
    ground_truth: GroundTruth | None = None
    tolerance_s: float = 0.05
    interpolation_s: float = 0.25
    twist_tolerance_s: float = 0.5
    wheels: WheelSource | None = None
    no_wheels: bool = False
    more_scans: tuple[str, ...] = ()
    imu: str | None = None

    def __post_init__(self) -> None:
        _check_times(self.tolerance_s, self.interpolation_s, self.twist_tolerance_s)

    @property
    def scans(self) -> tuple[str, ...]:
        """The topics of all scanners."""
        return (self.image, *self.more_scans)


def choose_topics(
    recording: Recording, given: TopicArguments | None = None, with_wheels: bool = False
) -> RecordingTopics:
    """What is given, and for the rest what the types and names of the recording's topics make clear.

    Not given, the image is the only colour or grey Image, else the only CompressedImage, else `choose_scan`; the action
    is a DiscreteAction that is no command; the twist, where there is no action, the only Twist or TwistStamped; the
    ground truth an Odometry or pose topic whose name says so. Where the image is of scans, or with_wheels, the wheels
    are the first of `wheel_candidates`, if it is the only one or its name says so; where there is none, the first of
    `wheel_transforms` below a frame that is called odom, maybe with more. With wheels, the IMU is the first of this
    robot. No more is guessed.

    Raises:
        RecordingError: a topic that is given is not there, empty or of another type, or the image topic is not clear.
    """
    given = given or TopicArguments()
    scans: list[str | None] = [_given(recording, "scans", name, _SCANS) for name in given.scan_topics]
    first, *more = scans or [given.image]
    image = _given(recording, "image", first, (IMAGE_TYPE, COMPRESSED_TYPE, *LIDAR_TYPES)) or _choose_image(recording)
    action = _given(recording, "action", given.action, (ACTION_TYPE,))
    if given.action is None:
        action = _only(name for name in _filled(recording, (ACTION_TYPE,)) if not name.endswith("command"))
    twist = _given(recording, "twist", given.twist, TWIST_TYPES)
    if given.twist is None and action is None:
        twist = _only(_filled(recording, TWIST_TYPES[:2]))
    truth = _choose_truth(recording, given.ground_truth)
    wheels = _choose_wheels(recording, given.wheels, image, truth, bool(scans) or with_wheels)
    imu = _given(recording, "IMU", given.imu, (IMU_TYPE,))
    if given.imu is None and wheels is not None:
        names = _filled(recording, (IMU_TYPE,))
        imu = min((name for name in names if _related(name, image)), default=_only(names))
    more_scans = tuple(name for name in more if name is not None)
    depth = _given(recording, "depth", given.depth, (IMAGE_TYPE,))
    sources = (wheels.topic if wheels is not None else None, truth.topic if truth is not None else None)
    used = (image, *more_scans, depth, action, twist, imu, *sources)
    recording.check_stamps(name for name in used if name is not None)
    return RecordingTopics(
        image=image,
        depth=depth,
        action=action,
        twist=twist,
        ground_truth=truth,
        tolerance_s=given.tolerance_s,
        interpolation_s=given.interpolation_s,
        twist_tolerance_s=given.twist_tolerance_s,
        wheels=wheels,
        no_wheels=given.wheels == _NONE,
        imu=imu,
        more_scans=more_scans,
    )


def choose_scan(recording: Recording) -> str | None:
    """The topic of laser scans, else of scans with echoes, else of point clouds; of several the one called scan
    in the shortest namespace.

    None: there is none.
    """
    return min(
        next((names for kind in LIDAR_TYPES if (names := _filled(recording, (kind,)))), []),
        key=lambda name: (not name.endswith("/scan"), name.count("/"), -recording.topics[name].count, name),
        default=None,
    )


def wheel_candidates(recording: Recording, image: str, truth: GroundTruth | None = None) -> list[str]:
    """The topics of odometry that may be the wheels of the robot whose scans are on `image`, the best one first.

    Not those of the truth or of a global frame (map, world). Those whose frame carries the scanner, by the transforms,
    are the robot's; where no transform says it, another robot's namespace does. What is called wheels comes before
    odom, and this before others, which may be computed of it.
    """
    frame = _scan_frame(recording, image)
    prefix = frame.rpartition("/")[0]
    tree, _ = _first_transforms(recording, image)
    found = []
    for name in _filled(recording, (ODOMETRY_TYPE,)):
        if _TRUTH_NAMES.search(name) or (truth is not None and name == truth.topic):
            continue
        parent, child = _odometry_frames(recording, name)
        if _is_any(_GLOBAL_FRAMES, parent, frame):
            continue
        kind = next((k for k, names in enumerate(_WHEEL_NAMES) if names.search(name)), len(_WHEEL_NAMES))
        other = child.rpartition("/")[0] != prefix
        key = (-_shared(name, image), other, kind, -recording.topics[name].count, name)
        found.append((_carries(tree, child, frame), _related(name, image), key))
    for wanted in ((True, True), (True, False), (False, True)):
        if chosen := [key for *told, key in found if tuple(told) == wanted]:
            return [name for *_, name in sorted(chosen)]
    return []


def wheel_topics_to_name(recording: Recording, image: str, truth: GroundTruth | None = None) -> list[str]:
    """The topics that may be odometry where they are named: no truth, no command, no pose in a global frame, and a
    message each second or more."""
    span_s, frame, found = sum(b - a for a, b in recording.spans_ns(image)) * 1e-9, _scan_frame(recording, image), []
    for name in _filled(recording, WHEEL_TYPES):
        info, (parent, _) = recording.topics[name], _odometry_frames(recording, name)
        other = _COMMAND_NAMES.search(name) or _TRUTH_NAMES.search(name) or (truth is not None and name == truth.topic)
        of_map = info.type_name != ODOMETRY_TYPE and _is_any(_GLOBAL_FRAMES, parent, frame)
        if not other and not of_map and info.count >= span_s:
            found.append(name)
    return found


def odometry_to_name(recording: Recording, topics: RecordingTopics, said: Callable[[str], str] = str) -> str | None:
    """A sentence on what may be odometry where none is used, each topic as it is ``said``; None where nothing may."""
    if topics.no_wheels or topics.wheels is not None:
        return None
    sources = [said(name) for name in wheel_topics_to_name(recording, topics.image, topics.ground_truth)]
    sources += map(str, wheel_transforms(recording, topics.image, topics.ground_truth))
    return f"no odometry is used; if it is {' or '.join(sources)}, --wheels names it" if sources else None


def _is_any(names: Iterable[str], frame: str, beside: str) -> bool:
    return any(is_named(frame, name, beside) for name in names)


def _carries(tree: TransformBuffer, base: str, scan_frame: str) -> bool:
    """Whether transforms of the robot itself join its frame and the scanner's."""
    chain = tree.between(base, scan_frame)
    outside = (_ODOMETRY_FRAME, *_GLOBAL_FRAMES)
    return bool(base and chain) and not any(is_named(part, name, scan_frame) for part in chain for name in outside)


def transform_topics(recording: Recording, image: str) -> list[str]:
    """The topics of transforms of the robot whose scans are on `image`: those of other robots' namespaces are not."""
    names = _filled(recording, (TF_TYPE,))
    return [name for name in names if _related(name, image)] or names


def _related(one: str, other: str) -> bool:
    """Whether two topics may belong to one robot: one's namespace is within the other's."""
    return _shared(one, other) == min(len(_namespace(one)), len(_namespace(other)))


def _shared(one: str, other: str) -> int:
    """How many parts of their namespaces two topics share."""
    pairs = zip(_namespace(one), _namespace(other), strict=False)
    return next((k for k, (a, b) in enumerate(pairs) if a != b), min(len(_namespace(one)), len(_namespace(other))))


def _namespace(topic: str) -> list[str]:
    return topic.strip("/").split("/")[:-1]


def _given(recording: Recording, use: str, name: str | None, types: Collection[str]) -> str | None:
    """The topic that was given for a use, if one was and it fits."""
    if name is None or name == _NONE:
        return None
    # A person may leave out the slash that every topic begins with.
    name = name if name in recording.topics or name.startswith("/") else f"/{name}"
    if name not in recording.topics:
        raise RecordingError(
            f"there is no topic {name} for the {use}; of a type that fits: {_listed(_filled(recording, types))}"
        )
    info = recording.topics[name]
    if info.type_name not in types:
        raise RecordingError(
            f"topic {name} for the {use} is {info.type_name}; expected {' or '.join(types)}: "
            f"{_listed(_filled(recording, types))}"
        )
    if not info.count:
        raise RecordingError(f"topic {name} for the {use} has no message: name another, or {_NONE}")
    return name


def _choose_image(recording: Recording) -> str:
    raw = _filled(recording, (IMAGE_TYPE,))
    coloured = [name for name in raw if _encoding(recording, name) not in DEPTH_ENCODINGS]
    scan = choose_scan(recording)
    for names in (coloured, _filled(recording, (COMPRESSED_TYPE,)), [] if scan is None else [scan], raw):
        if len(names) > 1:
            raise RecordingError(f"several topics may be the image ({', '.join(names)}): name one (--image)")
        if names:
            return names[0]
    raise RecordingError(
        f"no topic is an image: expected {', '.join(SENSOR_TYPES)}; there are "
        + "; ".join((_listed(recording.topics), *recording.notes))
    )


def _choose_truth(recording: Recording, given: str | None) -> GroundTruth | None:
    if given == _NONE:
        return None
    if given is None:
        found = _only(name for name in _filled(recording, POSE_TYPES) if _TRUTH_NAMES.search(name))
        return None if found is None else GroundTruth(topic=found)
    truth = GroundTruth.parse(given)
    if truth.topic is not None:
        return GroundTruth(topic=_given(recording, "ground truth", truth.topic, POSE_TYPES))
    if truth.tf is not None and not _filled(recording, (TF_TYPE,)):
        raise RecordingError(f"ground truth is {truth}, and no topic holds transforms ({TF_TYPE})")
    if truth.tum is not None and not truth.tum.is_file():
        raise RecordingError(f"there is no file {truth.tum} for the ground truth")
    return truth


def _choose_wheels(
    recording: Recording, given: str | None, image: str, truth: GroundTruth | None, scans: bool
) -> WheelSource | None:
    if given == _NONE:
        return None
    if given is not None:
        wheels = WheelSource.parse(given)
        if wheels.topic is not None:
            wheels = WheelSource(_given(recording, "wheels", wheels.topic, WHEEL_TYPES))
        elif not _filled(recording, (TF_TYPE,)):
            raise RecordingError(f"wheel odometry is {wheels}, and no topic holds transforms ({TF_TYPE})")
        if truth is not None and str(wheels) == str(truth):
            raise RecordingError(f"wheel odometry and ground truth are both {wheels}: name another, or {_NONE}")
        return wheels
    if recording.topics[image].type_name not in LIDAR_TYPES and not scans:
        return None
    if candidates := wheel_candidates(recording, image, truth):
        clear = len(candidates) == 1 or any(names.search(candidates[0]) for names in _WHEEL_NAMES)
        return WheelSource(candidates[0]) if clear else None
    sources = wheel_transforms(recording, image, truth)
    return next((each for each in sources if each.tf and _called_odom(each.tf[0])), None)


def _scan_frame(recording: Recording, image: str) -> str:
    return str(getattr(getattr(recording.first(image).value, "header", None), "frame_id", "")).strip("/")


def _odometry_frames(recording: Recording, name: str) -> tuple[str, str]:
    first = recording.first(name).value
    parent = str(getattr(getattr(first, "header", None), "frame_id", ""))
    return parent.strip("/"), str(getattr(first, "child_frame_id", "")).strip("/")


def _first_transforms(recording: Recording, image: str) -> tuple[TransformBuffer, list[tuple[str, str]]]:
    """What is known of the tree after the first seconds, and parent and child of what moves in it."""
    names, tree = transform_topics(recording, image), TransformBuffer()
    static = [name for name in names if name.endswith("static")]
    for message in recording.messages(static):
        tree.take(getattr(message.value, "transforms", ()), static=True)
    moving: list[tuple[str, str]] = []
    start_ns: int | None = None
    for message in recording.messages([name for name in names if name not in static]):
        start_ns = message.log_time_ns if start_ns is None else start_ns
        if message.log_time_ns > start_ns + _LOOK_NS:
            break
        tree.take(getattr(message.value, "transforms", ()), static=False)
        for each in getattr(message.value, "transforms", ()):
            frames = each.header.frame_id.strip("/"), each.child_frame_id.strip("/")
            if frames not in moving:
                moving.append(frames)
    return tree, moving


def wheel_transforms(recording: Recording, image: str, truth: GroundTruth | None = None) -> list[WheelSource]:
    """The transforms of the first seconds that may be odometry, the best one first: below odom those that carry the
    scanner, and others to the robot; then those that carry it below any other frame but the robot's, odom in its name
    first."""
    scan = _scan_frame(recording, image)
    tree, moving = _first_transforms(recording, image)
    above, found = tree.above(scan), []
    for frames in moving:
        parent, child = frames
        carries, robot = child in above, _is_any(_BASE_FRAMES, child, scan)
        if truth is not None and truth.tf == frames:
            continue
        if is_named(parent, _ODOMETRY_FRAME, scan) and (carries or robot):
            found.append((0 if carries else 1, WheelSource(tf=frames)))
        elif carries and robot and (_called_odom(parent) or "base" not in parent):
            found.append((2 if _called_odom(parent) else 3, WheelSource(tf=frames)))
    return [source for _, source in sorted(found, key=lambda each: each[0])]


def _called_odom(frame: str) -> bool:
    return _ODOMETRY_FRAME in frame.rpartition("/")[2]


def _frames(text: str, use: str, example: str) -> tuple[str, str]:
    """Parent and child of tf:PARENT:CHILD."""
    frames = [name.strip("/") for name in text.split(":")[1:]]
    if len(frames) != 2 or not all(frames):
        raise RecordingError(f"{use} is {text!r}; expected tf:PARENT:CHILD, as in {example}")
    return frames[0], frames[1]


def _filled(recording: Recording, types: Collection[str]) -> list[str]:
    """Topics of these types that have messages."""
    return [name for name, info in recording.topics.items() if info.type_name in types and info.count]


def _encoding(recording: Recording, name: str) -> str:
    first = recording.first(name)
    return str(getattr(first.value, "encoding", ""))  # damaged definitions are told when frames are read


def _only(names: Iterable[str]) -> str | None:
    found = list(names)
    return found[0] if len(found) == 1 else None


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"


def _check_times(*values: float) -> None:
    for value in values:
        if not 0.0 <= value < math.inf:
            raise RecordingError(f"a tolerance is {value:g} s; expected a number of at least 0")
