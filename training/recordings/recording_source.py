"""A robot's recordings as training data: `--data FILES` in place of a simulated world."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from ngo_estimator.checkpoint import LOCAL, load_local
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_recordings.errors import RecordingError
from ngo_recordings.topics import TopicArguments
from training.common.records import recorded_values
from training.common.trainer_arguments import TrainerArguments
from training.data.batches import ACTION_HISTORY, relative_poses
from training.data.data_source import MIRRORED_ACTIONS, Domain
from training.data.worlds import WorldName, world_named
from training.recordings.recording_store import StoredRecording, make_store
from training.recordings.recording_tracks import PARTS, SHORTEST, Part, Split, Track, period_s, split, tracks_of

NO_LOOPS = "no_loops"
"""Key in the JSON beside a place encoder or an optimizer with which no loops are closed; its value says why."""
FEWEST_STEPS = 200  # Of the networks' part; fewer teach nothing.
_PANORAMA = math.pi
_NARROW = math.radians(35.0)


@dataclass(frozen=True)
class RecordedArguments:
    """Recordings in place of a simulated world, and their use."""

    data: tuple[Path, ...] = ()  # Recordings with ground truth: .mcap files or rosbag2 folders.
    name: str = "my_robot"  # Name of the robot: of the folders of its weights and of its run.
    holdout: tuple[Path, ...] = ()  # Recordings kept for the evaluation; none: the last, or the end of a single one.
    reduction: int | None = None  # Factor by which pictures are made smaller; none: the least for 96 columns at most.
    place_radius_m: float | None = None  # Largest distance of two frames of one place; none: 4 fast steps, 0.3 to 1 m.
    heading_limit_deg: float | None = None  # Largest turn between them; none: 35, or 180 for scanners that look around.
    scan_yaw_deg: float = 0.0  # Direction of a scanner's angle 0, counter-clockwise from ahead; as when it runs live.
    mirror: bool = True  # Whether to learn also from mirror images; not for sensors that sit far to one side.
    from_weights: Path | None = None  # Folder of weights of the same sensor to start from; their sizes stay.
    topics: Annotated[TopicArguments, tyro.conf.arg(name="")] = field(default_factory=TopicArguments)

    def __post_init__(self) -> None:
        if self.holdout and not set(self.holdout) < set(self.data):
            raise ValueError(
                f"holdout is {_names(self.holdout)}, data is {_names(self.data)}; expected some of the data, not all"
            )
        if len(set(self.data)) < len(self.data):
            raise ValueError(f"data is {_names(self.data)}; expected each recording once")
        if self.reduction is not None and self.reduction < 1:
            raise ValueError(f"reduction is {self.reduction}; expected a whole number from 1 on")
        if not math.isfinite(self.scan_yaw_deg):
            raise ValueError(f"scan_yaw_deg is {self.scan_yaw_deg:g}; expected a finite number")
        if "/" in self.name or not self.name:
            raise ValueError(f"name is {self.name!r}; expected one that a folder can have")


@dataclass(frozen=True)
class DataArguments:
    """Where data come from: a simulated world, or recordings."""

    world: WorldName | None = None  # World to train for.
    recordings: tyro.conf.OmitArgPrefixes[RecordedArguments] = field(default_factory=RecordedArguments)

    def __post_init__(self) -> None:
        check_source(self.world, self.recordings)

    @property
    def name(self) -> str:
        """Name of the world or the robot, and of its folders."""
        return self.world or self.recordings.name


@dataclass(frozen=True)
class SourceArguments(DataArguments, TrainerArguments):
    """Arguments of a training on a simulated world or on recordings."""


def check_source(world: str | None, recordings: RecordedArguments) -> None:
    """Raise ``ValueError`` unless the data come from one place, a simulated world or recordings."""
    if (world is None) == (not recordings.data):
        raise ValueError("expected either --world, or --data FILES")


@dataclass(frozen=True)
class RecordedData:
    """Recordings as training data: their domain, and tracks by part; ``sha256`` identifies the data."""

    domain: Domain
    recordings: list[StoredRecording]
    parts: Split
    sha256: str
    scan_yaw_deg: float = 0.0

    def tracks(self, *parts: Part) -> list[Track]:
        """The tracks of some parts."""
        return [track for part in parts for track in self.parts.tracks[part]]

    @property
    def about(self) -> dict[str, Any]:
        """For the JSON beside the weights: which recordings, how they were split, and what the plane leaves out."""
        return {
            "recordings": [recording.name for recording in self.recordings],
            "split": list(self.parts.words),
            "period_s": self.domain.period_s,
            "place_radius_m": self.domain.place_radius_m,
            "scan_yaw_deg": self.scan_yaw_deg,
            "projection_residual": self.residual,
        }

    @property
    def residual(self) -> dict[str, float]:
        """Loss by the projection of the true poses to the plane: range of heights, and the largest tilt."""
        residuals = np.concatenate([recording.residuals for recording in self.recordings])
        known = np.isfinite(residuals).all(axis=1)
        heights = [r.residuals[np.isfinite(r.residuals[:, 0]), 0] for r in self.recordings]
        return {
            "height_range_m": float(max(np.ptp(height) for height in heights if len(height))),
            "largest_tilt_deg": float(np.degrees(np.abs(residuals[known, 1:]).max())),
        }


@dataclass(frozen=True)
class Source:
    """Where the data of a training come from: a simulated world, or recordings."""

    domain: Domain
    recorded: RecordedData | None

    @property
    def sha256(self) -> str | None:
        """What identifies recordings."""
        return None if self.recorded is None else self.recorded.sha256

    @property
    def about(self) -> dict[str, Any]:
        """What the JSON beside the weights says of recordings."""
        return {} if self.recorded is None else {"data": self.recorded.about}


TrainedLocal = tuple[LocalPoseNetwork, dict[str, Any]]
"""A local network and its description, as ``load_local`` gives them."""

_ANEW = "give every script of one training the same, or train the local network anew"


def trained_local(weights: Path, name: str) -> TrainedLocal | None:
    """The local network of this name, None where there is none yet."""
    folder = weights / name
    return load_local(folder, name) if (folder / f"{LOCAL}.safetensors").exists() else None


def open_recorded(arguments: RecordedArguments, runs: Path, local: TrainedLocal | None = None) -> RecordedData:
    """Read the recordings into ``runs/NAME/data`` (once), split them, and print how.

    Args:
        local: network that must have learned from the same, if there is one; arguments are compared before reading.

    Raises:
        RecordingError: of one line, about what is missing in the recordings, or differs from those of ``local``.
    """
    if local is not None:
        check_same_arguments(arguments, local[1])
    data = _opened(arguments, runs)
    if local is not None:
        check_same_data(data, local)
    return data


def open_source(arguments: SourceArguments, local: TrainedLocal | None = None) -> Source:
    """The world that the arguments name, or their recordings, opened as by ``open_recorded``."""
    if arguments.world is not None:
        return Source(world_named(arguments.world), None)
    recorded = open_recorded(arguments.recordings, arguments.runs, local)
    return Source(recorded.domain, recorded)


def check_same_arguments(arguments: RecordedArguments, description: dict[str, Any]) -> None:
    """Raise ``RecordingError`` where arguments choose other recordings or topics than a network was trained with."""
    then = description.get("training", {}).get("arguments", {})
    if "data_sha256" not in then:
        raise RecordingError(f"the local network of {arguments.name} was not trained on recordings; {_ANEW}")
    defaults = {**recorded_values(RecordedArguments()), **recorded_values(TopicArguments())}
    now = {**defaults, **recorded_values(arguments), **recorded_values(arguments.topics)}
    names = ("data", "holdout", "reduction", "scan_yaw_deg", *recorded_values(TopicArguments()))
    expected = {name: then.get(name, defaults[name]) for name in names}
    given = json.loads(json.dumps({name: now[name] for name in names}))
    expected = json.loads(json.dumps(expected))
    if differing := [name for name in names if given[name] != expected[name]]:
        raise RecordingError(
            f"the local network of {arguments.name} learned from other data: given {_flags(given, differing)}; "
            f"expected {_flags(expected, differing)}: {_ANEW}"
        )


def check_same_data(data: RecordedData, local: TrainedLocal) -> None:
    """Raise ``RecordingError`` where a network learned from another sensor, other side information or other files."""
    network, description = local
    config, domain = network.config, data.domain
    if (config.image, config.actions, config.twist) != (domain.image, domain.actions, domain.twist):
        raise RecordingError(
            f"the local network of {domain.name} takes {config.image} and {inputs_of(config)}; these recordings give "
            f"{domain.image} and {inputs_of(domain)}: {_ANEW}"
        )
    if description["training"]["arguments"]["data_sha256"] != data.sha256:
        raise RecordingError(
            f"the recordings of {domain.name} are not those that its local network learned from: files, their folders "
            f"or --from-weights have changed: {_ANEW}"
        )


def inputs_of(network: Domain | LocalPoseConfig) -> str:
    """The side information that a network takes of each step beside its two frames, in words."""
    return "actions" if network.actions else "velocities" if network.twist else "images alone"


def _flags(values: dict[str, Any], names: Sequence[str]) -> str:
    def words(value: Any) -> str:
        if value is None or value == []:
            return "left out"
        return " ".join(map(str, value)) if isinstance(value, list) else str(value)

    return ", ".join(f"--{name.replace('_', '-')} {words(values[name])}" for name in names)


@lru_cache(maxsize=2)  # one script after another in one process asks for the same
def _opened(arguments: RecordedArguments, runs: Path) -> RecordedData:
    image = None
    if arguments.from_weights is not None:
        image = load_local(arguments.from_weights)[0].config.image
    folder = runs / arguments.name / "data"
    yaw_rad = math.radians(arguments.scan_yaw_deg)
    image, recordings, sha256 = make_store(
        folder, arguments.data, arguments.topics, image, arguments.reduction, yaw_rad
    )
    period = period_s(recordings)
    tracks = [tracks_of(n, recording, period) if period else [] for n, recording in enumerate(recordings)]
    for recording, found in zip(recordings, tracks, strict=True):
        if not found:
            raise RecordingError(
                f"{recording.name} has no {SHORTEST} frames in a row, one each {period:.3f} s as most of the "
                "recordings, with a true pose, action and velocity as chosen: see `python -m "
                "training.inspect_recording`, or leave it out"
            )
    parts = split(recordings, tracks, [arguments.data.index(path) for path in arguments.holdout], period)
    for part in PARTS:
        if not parts.tracks[part]:
            raise RecordingError(
                f"the recordings are too short: no {SHORTEST} frames in a row are left for {part}; expected a few "
                f"thousand frames in all: record longer, or more drives ({'; '.join(parts.words)})"
            )
    steps = sum(len(track) - 1 for track in parts.tracks["train"])
    if steps < FEWEST_STEPS:
        raise RecordingError(
            f"the recordings are too short: {steps} steps to learn from; expected {FEWEST_STEPS} or more: "
            "record longer, or more drives"
        )
    domain = domain_of(arguments, image, recordings, parts.tracks["train"], period)
    data = RecordedData(domain, recordings, parts, sha256, arguments.scan_yaw_deg)
    _print(data)
    return data


def domain_of(
    arguments: RecordedArguments,
    image: ImageFormat,
    recordings: Sequence[StoredRecording],
    tracks: Sequence[Track],
    period: float,
) -> Domain:
    """The scale of things, from the tracks that the networks learn from."""
    steps = np.concatenate([relative_poses(track.poses_xyyaw).numpy() for track in tracks])
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    median, fast = np.percentile(lengths, (50, 95)).tolist()
    if fast < 1e-4:
        raise RecordingError("the robot stands still in what is to be learned from: drive around")
    radius = arguments.place_radius_m or min(max(4.0 * fast, 0.3), 1.0)
    around = image.height == 1 and (image.field_of_view_deg is None or image.field_of_view_deg >= 180.0)
    limit = _PANORAMA if around else _NARROW
    with_actions = all(recording.with_actions for recording in recordings)
    with_twist = all(recording.with_twist for recording in recordings)
    twist_scale = (1.0, 1.0, 1.0)
    if with_twist:
        values = np.abs(np.concatenate([track.twists for track in tracks if track.twists is not None]))
        x, y, yaw = np.maximum(np.percentile(values, 95, axis=0), 1e-3).tolist()
        twist_scale = (x, max(y, 0.1 * x), yaw)
    if image.has_depth and arguments.from_weights is None:
        image = with_depth_scale(image, tracks)
    return Domain(
        name=arguments.name,
        image=image,
        period_s=period,
        block_m=2.0 * radius,
        place_radius_m=radius,
        heading_limit_rad=limit if arguments.heading_limit_deg is None else math.radians(arguments.heading_limit_deg),
        # Views are four frames away from the frames of a loop: further than a place reaches, they tell nothing.
        loop_views=5 if 4.0 * median <= 0.6 * radius else 1,
        reverses=not with_actions and float((steps[:, 0] < -0.1 * fast).mean()) > 0.01,
        actions=3 if with_actions else 0,
        mirrored_actions=MIRRORED_ACTIONS if with_actions else (),
        # Where a robot has no momentum, the earlier ones are soon found to say nothing.
        action_history=ACTION_HISTORY if with_actions else 1,
        twist=with_twist,
        twist_scale=twist_scale,
        mirrors=arguments.mirror,
    )


def with_depth_scale(image: ImageFormat, tracks: Sequence[Track]) -> ImageFormat:
    """The format with the scale of the depths that are seen: a third of their median is where resolution halves."""
    some = np.concatenate([np.asarray(track.images[:: max(1, len(track) // 50), ..., -1]).ravel() for track in tracks])
    returned = some[np.isfinite(some)]
    if not len(returned):
        raise RecordingError("no depth in the recordings has a return; expected distances in m")
    softening = round(float(np.median(returned)) / 3.0, 3)
    return dataclasses.replace(image, depth_gain_m=2.0 * softening, depth_softening_m=softening)


def _print(data: RecordedData) -> None:
    image, domain, residual = data.domain.image, data.domain, data.residual
    size = f"{image.width} x {image.height} of {image.channels} x {image.dtype}"
    made = f", made {image.reduction} times smaller" if image.reduction > 1 else ""
    made += f", {image.field_of_view_deg:g} deg" if image.field_of_view_deg is not None else ""
    print(f"frames: {size}{made}, one each {domain.period_s:.4f} s")
    what = inputs_of(domain)
    print(f"each step is estimated from the two frames and: {what}" if what != "images alone" else f"steps from {what}")
    print(f"places: within {domain.place_radius_m:.2f} m and {math.degrees(domain.heading_limit_rad):.0f} deg")
    print(
        f"left out by the projection to the plane: {residual['height_range_m']:.3f} m of height, tilt up to "
        f"{residual['largest_tilt_deg']:.2f} deg"
    )
    for line in data.parts.words:
        print(line)


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(path.name for path in paths) or "none"
