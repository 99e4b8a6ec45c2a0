"""Estimate the trajectory of a recording, as fast as the machine computes, with the results of the live nodes.

    ros2 run ngo_estimator run_recording lidar.bag --out results
    ros2 run ngo_estimator run_recording drive.mcap --world maze3d --out results
    ros2 run ngo_estimator run_recording bag_folder --weights my_weights --image /camera/image_raw --out results

RECORDINGS are .mcap files, rosbag2 folders, ROS 1 bags or CARMEN logs, several as one. Laser scans need no --world. OUT
gets odometry.tum, online.tum (each corrected pose as it was when its frame was the newest), corrected.tum,
trajectories.mcap (odometry, poses, transforms and paths), graph.g2o (its loops are marked; optimize_graph reads it),
map.pgm and map.yaml (for Nav2), plot.png and run.json; where the recording holds the truth, also truth.tum and
metrics.json. The same recording gives the same bytes.
"""

import gc
import json
import math
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, fields, replace
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from ament_index_python.packages import get_package_share_directory
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ngo_common.files import folder_whole
from ngo_estimator.data.lidar_file import is_lidar, require_opencv, require_torch
from ngo_estimator.mapping.scan_source import ScanSource, scan_source
from ngo_estimator.nodes.command import run_command
from ngo_estimator.offline.compiling import compiling
from ngo_estimator.trajectory.errors import KITTI_LENGTHS_M, RelativeDelta
from ngo_estimator.trajectory.report import ReportSettings, remarks, report_table
from ngo_recordings.calibration import CAMERA_INFO_TYPE
from ngo_recordings.images import COMPRESSED_TYPE, IMAGE_TYPE, LIDAR_TYPES
from ngo_recordings.recording import Recording, open_recording
from ngo_recordings.topics import RecordingTopics, TopicArguments, choose_scan, choose_topics, odometry_to_name

if TYPE_CHECKING:
    from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
    from ngo_estimator.offline.recorded import RecordedRun, RecordedStep, Run

    Started = tuple[str, RecordingTopics, Run, Iterator[RecordedStep | RecordedRun]]

NAME = "run_recording"
LIDAR_WORLD, CAMERA_WORLD = "scan", "camera"
_OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""New objects after which Python looks for cycles among them; its 700 cost imports and messages a twentieth."""
_SCANS_AT_ONCE = 500
"""Scans that wait for the map: it follows in between, so that memory does not grow with the recording."""


@dataclass(frozen=True)
class Arguments:
    """The recordings, the weights, and the folder of the results."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """.mcap files, rosbag2 folders, ROS 1 bags or CARMEN logs, several as one recording in order of time."""
    out: Path
    """Folder for the results, new or empty."""
    world: str | None = None
    """World whose weights are used: maze2d, maze3d or doom. Without weights: scan (any 2D lidar), the default for laser
    scans, and camera (any calibrated camera with the robot's odometry), the default for pictures with a CameraInfo."""
    weights: Path | None = None
    """Folder of weights of your own, instead of those of a world."""
    topics: tyro.conf.OmitArgPrefixes[TopicArguments] = field(default_factory=TopicArguments)
    """The topics to use."""
    window_frames: int = 2000
    """How many of the newest frames are optimised together."""
    key_frames: int = 128
    """How many older poses are kept as key frames: they close loops, and all other old poses move with them."""
    iterations_per_step: int = 1
    """Iterations of an optimisation at each frame, which spreads it over frames; 0 for all at once."""
    scan_yaw_deg: float = 0.0
    """Where a scanner's angle 0 points, counter-clockwise from straight ahead; 0: as the recording's transforms say.
    Where the scanner sits is as they say."""
    min_range: float = 0.0
    """Nearer ranges of a scanner are not used, m: for a robot that its scanner sees."""
    base_frame: str = "base_link"
    """Frame of the robot in trajectories.mcap."""
    odom_frame: str = "odom"
    """Frame in which the odometry is smooth and drifts."""
    map_frame: str = "map"
    """Frame of the corrected trajectory; its origin is the first frame."""
    rpe_metres: float | None = None
    """Take the RPE over so many metres; not given: from each frame to the next."""
    segment_lengths_m: tuple[float, ...] = KITTI_LENGTHS_M
    """Lengths of KITTI's segments."""
    overwrite: bool = False
    """Whether results that are in OUT already may be replaced."""

    def check(self) -> None:
        """Raise ``ValueError`` for arguments that contradict each other."""
        if not self.recordings:
            raise ValueError("no recording was given; expected .mcap files, rosbag2 folders, .bag, .log or .clf files")
        if self.world is not None and self.weights is not None:
            raise ValueError(
                "expected either --world (maze2d, maze3d, doom, scan or camera) or --weights FOLDER, not both"
            )
        if self.out.exists() and not self.out.is_dir():
            raise ValueError(f"{self.out} is a file; expected a folder for the results")
        if self.out.is_dir() and any(self.out.iterdir()) and not self.overwrite:
            raise ValueError(f"{self.out} is not empty; give a new folder, or --overwrite")

    def uses_camera(self, recording: Recording) -> bool:
        """Whether pictures are tracked without weights: as world says, or for pictures with a CameraInfo, no scans."""
        if self.world is not None or self.weights is not None or self.topics.scan_topics:
            return self.world == CAMERA_WORLD
        filled = {info.type_name for info in recording.topics.values() if info.count}
        pictures, scans = filled & {IMAGE_TYPE, COMPRESSED_TYPE}, filled.intersection(LIDAR_TYPES)
        return bool(pictures) and not scans and CAMERA_INFO_TYPE in filled

    def weights_folder(self, recording: Recording) -> Path:
        """The folder with the weights; raises ``ValueError`` where there is none, or none was named for images."""
        shipped = Path(get_package_share_directory("ngo_estimator"), "weights")
        world = self.world
        if world is None and self.weights is None:
            if not self.topics.scan_topics and choose_scan(recording) is None:
                raise ValueError(
                    "expected --world (but scan) or --weights FOLDER: there are no laser scans, and no CameraInfo with "
                    "pictures, which need neither"
                )
            world = LIDAR_WORLD
        folder = self.weights if self.weights is not None else shipped / str(world)
        if not folder.is_dir():
            there = "" if world is None else f"; worlds: {', '.join(sorted(p.name for p in shipped.iterdir()))}"
            raise ValueError(f"there is no folder of weights {folder}{there}")
        return folder

    @property
    def report_settings(self) -> ReportSettings:
        """How estimates are compared with the truth at the same frames."""
        delta = RelativeDelta() if self.rpe_metres is None else RelativeDelta(self.rpe_metres, "metres")
        return ReportSettings(delta=delta, segment_lengths_m=self.segment_lengths_m)


def run(arguments: Arguments, console: Console) -> dict[str, Any]:
    """Run both estimators over the recording, write the results and return the content of run.json.

    The results come all at once, at the end; those of an earlier run stay until then.

    Raises:
        ValueError, OSError: with one line about a file that cannot be read, used or written. There are no results then.
    """
    arguments.check()
    with folder_whole(arguments.out) as out:
        result = _run(arguments, out, console)
        (out / "run.json").write_text(json.dumps(result, indent=1) + "\n")
        from ngo_estimator.nodes.recorded_output import remove_results

        remove_results(arguments.out)
    return result


def _run(arguments: Arguments, out: Path, console: Console) -> dict[str, Any]:
    """Run both estimators, write into ``out``, and return the content of run.json."""
    with open_recording(arguments.recordings) as recording:
        core: Run
        source: ScanSource | None = None
        if arguments.uses_camera(recording):
            world, topics, core, events = _camera(arguments, recording, console)
        elif is_lidar(folder := arguments.weights_folder(recording)):
            world, topics, core, events = _lidar(arguments, folder, recording, console)
            source = scan_source(folder)
        else:
            world, topics, core, events = _networks(arguments, folder, recording, console)
            source = scan_source(folder)
        import_module("ngo_estimator.nodes.recorded_output")  # with matplotlib: no work on frames
        began_s = time.monotonic()
        trajectories = _write(arguments, out, recording, topics, core, events, source, console)
    took_s = time.monotonic() - began_s
    if not trajectories:
        why = "; ".join(f"{count} {reason}, first {core.examples.get(reason, '')}" for reason, count in _rejected(core))
        raise ValueError(f"no two frames of {topics.image} could be used: {why or f'it has {core.frames}'}")
    for line in _losses(core, max(core.frames, recording.topics[topics.image].count)):
        console.print(line)
    console.print(f"{core.frames} frames in {took_s:.1f} s, {core.frames / took_s:.0f} frames/s")
    return {
        "recordings": [str(path) for path in arguments.recordings],
        "weights": world,
        "window_frames": arguments.window_frames,
        "key_frames": arguments.key_frames,
        "iterations_per_step": arguments.iterations_per_step,
        "topics": {field.name: _plain(getattr(topics, field.name)) for field in fields(topics)},
        "frames": core.frames,
        "not_used": dict(core.rejected),
        "gaps": core.gaps,
        **core.facts,
        "trajectories": trajectories,
    }


def _write(
    arguments: Arguments,
    out: Path,
    recording: Recording,
    topics: RecordingTopics,
    core: "Run",
    events: "Iterator[RecordedStep | RecordedRun]",
    source: ScanSource | None,
    console: Console,
) -> list[dict[str, Any]]:
    """Run over all frames; for each trajectory the folder of its results and how many poses it has."""
    from ngo_estimator.nodes.recorded_output import PART, RecordedOutput
    from ngo_estimator.offline.recorded import RecordedStep

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    found: list[dict[str, Any]] = []
    output: RecordedOutput | None = None
    settings = arguments.report_settings
    screen = Console(stderr=True)
    bar = Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal)
    with ExitStack() as stack, bar as progress:
        task = progress.add_task(topics.image, total=recording.topics[topics.image].count)
        for event in events:
            if output is None:
                folder = out if not found else out / f"{PART}{len(found) + 1}"
                names = arguments.base_frame, arguments.odom_frame, arguments.map_frame
                output = stack.enter_context(RecordedOutput(folder, *names, source))
            if isinstance(event, RecordedStep):
                output.add(event)
                if output.waiting >= _SCANS_AT_ONCE and (trajectory := core.trajectory()) is not None:
                    output.follow(trajectory)
                if not bar.disable:
                    progress.update(task, completed=core.frames)
                continue
            name, poses = output.folder.relative_to(out).as_posix(), len(event.trajectory.stamps_ns)
            found.append({"folder": name, "poses": poses})
            title = f"{arguments.recordings[0].name}{'' if len(found) == 1 else f', part {len(found)}'}"
            try:
                reports = output.finish(event, title, settings)
            except ValueError as error:
                console.print(f"no errors were measured: {error}")
                reports = {}
            if output.coarser:
                console.print(output.coarser)
            if output.left_out:
                console.print(f"scans are not in the map: {output.left_out}")
            stack.pop_all().close()
            if reports:
                console.print(report_table(title, reports, ("first", "best")), soft_wrap=False)
                for line in remarks(reports):
                    console.print(line)
            output = None
    return found


def _networks(arguments: Arguments, folder: Path, recording: Recording, console: Console) -> "Started":
    """Networks for images or resampled scans."""
    # Imported here because torch takes seconds: a file that is not there is said at once.
    require_torch()
    import torch

    from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
    from ngo_estimator.offline.recording_run import RecordingRun
    from ngo_estimator.offline.warm_up_trajectory import warm_up_networks
    from ngo_estimator.slam.online_trajectory import OnlineTrajectory
    from ngo_recordings.frames import frames as frames_of

    torch.set_num_threads(1)
    local = LocalOdometry.load(folder, arguments.world)
    bounds = (arguments.key_frames, arguments.iterations_per_step)
    online = OnlineTrajectory.load(folder, arguments.window_frames, arguments.world, *bounds)
    topics = choose_topics(recording, _for_weights(recording, arguments.topics, local))
    _check_side_information(topics, local)
    console.print("; ".join((f"using {_words(topics)}", *recording.notes)))
    with compiling(console.print):
        warm_up_networks(online)
    core = RecordingRun(local, online, scan_yaw_rad=math.radians(arguments.scan_yaw_deg))
    frames = frames_of(recording, topics, core.rejected, local.image_format.largest_picture)
    return local.world, topics, core, core.run(frames)


def _lidar(arguments: Arguments, folder: Path, recording: Recording, console: Console) -> "Started":
    """Registration of a lidar's scans, with the robot's odometry."""
    from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
    from ngo_estimator.geometry.scan_points import Mounting
    from ngo_estimator.offline.lidar_run import LidarRun
    from ngo_estimator.offline.recorded import Truth
    from ngo_estimator.offline.warm_up_scans import warm_up_scans
    from ngo_estimator.slam.scan_trajectory import ScanTrajectory
    from ngo_recordings.frames import frames as frames_of
    from ngo_recordings.lidar_description import describe_lidar
    from ngo_recordings.mounting import find_mounting
    from ngo_recordings.scan_stream import scan_stream

    odometry = MixtureLidar.load(folder, arguments.world)
    online = ScanTrajectory.load(folder, arguments.world, arguments.iterations_per_step)
    given = replace(arguments.topics, action="none", twist="none")
    if not given.scan_topics and (scans := given.image or choose_scan(recording)) is not None:
        given = replace(given, scan_topics=(scans,))
    topics = choose_topics(recording, given)
    described = describe_lidar(recording, topics)
    if arguments.scan_yaw_deg != 0.0:
        described = described.looking_at(math.radians(arguments.scan_yaw_deg))
    for line in described.lines():
        console.print(line)
    first_frame = described.scan_frame

    @cache
    def mounting_of(frame: str) -> Mounting | None:
        found = described.mounting if frame == first_frame else find_mounting(recording, topics, frame)
        if frame != first_frame and found is not None:
            console.print(f"another scanner: {found}")
        return None if found is None else Mounting(found.base_from_scan_xyyaw, found.upside_down, found.height_m)

    truth = Truth()
    if topics.ground_truth is not None:
        for frame in frames_of(recording, topics):
            truth.add(frame)
    with compiling(console.print):
        warm_up_scans()
    core = LidarRun(odometry, online, mounting_of, arguments.min_range)
    known = core.learn(scan_stream(recording, topics, skipped=Counter()))
    ahead_s = known.offset_s if known.offset_s else None
    records = scan_stream(recording, topics, skipped=core.rejected, wheels_ahead_s=ahead_s)
    return LIDAR_WORLD, topics, core, core.run(records, truth)


def _camera(arguments: Arguments, recording: Recording, console: Console) -> "Started":
    """Features of a calibrated camera's pictures, with the robot's odometry."""
    require_opencv()
    import cv2

    from ngo_estimator.frontend.camera.calibrated_camera import NOT_MOUNTED, calibrated_camera
    from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
    from ngo_estimator.offline.camera_run import CameraRun
    from ngo_estimator.slam.picture_trajectory import PictureTrajectory
    from ngo_recordings.calibration import calibration_of, info_topics
    from ngo_recordings.frames import frames as frames_of
    from ngo_recordings.mounting import FLOOR_FRAME, find_pose
    from ngo_recordings.scan_stream import wheel_poses

    cv2.setNumThreads(1)
    topics = choose_topics(recording, replace(arguments.topics, action="none", twist="none"), with_wheels=True)
    named = info_topics(topics.image, recording.topics[topics.image].type_name == COMPRESSED_TYPE)
    info = next((name for name in named if name in recording.topics and recording.topics[name].count), None)
    if info is None:
        raise ValueError(
            f"no CameraInfo is on {' or '.join(named)}: {CAMERA_WORLD} needs the calibration of {topics.image}"
        )
    seen = calibration_of(recording.first(info).value, info, topics.image)
    by_floor = topics.wheels is None
    mounted = find_pose(recording, topics, seen.frame_id or None, *([FLOOR_FRAME] if by_floor else []))
    if mounted is None:
        pose, where = None, f"no transform says where it sits: {NOT_MOUNTED}"
    else:
        base, frame, pose, source = mounted
        seen = replace(seen, frame_id=frame)
        where = f"{frame} in {base} at {', '.join(f'{value:.3f}' for value in pose.position)} m (from {source})"
    model = calibrated_camera(seen, pose)
    if note := odometry_to_name(recording, topics):
        console.print(note)
    odometry = PictureOdometry(model, by_floor=by_floor)
    used = f"using {_words(topics)}, calibration {info}"
    console.print("; ".join((used, *recording.notes)))
    console.print(f"camera: {seen.width} x {seen.height}, {model.description}; {where}")
    if by_floor:
        console.print(
            f"the scale comes from the camera's height of {model.centre[2]:.3f} m over the floor, "
            "where the floor is seen"
        )
    core = CameraRun(odometry, PictureTrajectory(iterations_per_step=arguments.iterations_per_step))
    wheels = () if by_floor else wheel_poses(recording, topics, core.rejected)
    frames = frames_of(recording, topics, core.rejected, (seen.height, seen.width))
    return CAMERA_WORLD, topics, core, core.run(frames, wheels)


def _for_weights(recording: Recording, given: TopicArguments, local: "LocalOdometry") -> TopicArguments:
    """The arguments, with the only laser scan for weights of scans, and without inputs that the weights do not take."""
    if given.image is None and local.image_format.is_scan:
        given = replace(given, image=choose_scan(recording))
    if given.action is None and not local.uses_action:
        given = replace(given, action="none")
    if given.twist is None and not local.uses_twist:
        given = replace(given, twist="none")
    return given


def _check_side_information(topics: RecordingTopics, local: "LocalOdometry") -> None:
    for name, needed, topic in (
        ("action", local.uses_action, topics.action),
        ("twist", local.uses_twist, topics.twist),
    ):
        if needed and topic is None:
            raise ValueError(
                f"these weights need the {name} of each step, and no topic of the recording was chosen for it: "
                f"name one (--{name}), or use weights without"
            )


def _words(topics: RecordingTopics) -> str:
    used = {
        "images": topics.image,
        "depth": topics.depth,
        "wheels": topics.wheels,
        "actions": topics.action,
        "velocities": topics.twist,
        "truth": topics.ground_truth,
    }
    return ", ".join(f"{what} {topic}" for what, topic in used.items() if topic is not None)


def _plain(value: object) -> str | float | None:
    return value if value is None or isinstance(value, float) else str(value)


def _rejected(core: "Run") -> list[tuple[str, int]]:
    return [(reason, count) for reason, count in core.rejected.items() if count]


def _losses(core: "Run", images: int) -> list[str]:
    """A line for each reason why images were not used, and one about gaps."""
    lines = []
    for reason, count in _rejected(core):
        example = core.examples.get(reason)
        lines.append(f"{count} of {images} images not used: {reason}{f' (first: {example})' if example else ''}")
    lines += core.remarks()
    if core.gaps:
        lines.append(f"{core.gaps} steps span more than the time between two frames in training")
    return lines


def main() -> None:
    """Run with the command line's arguments."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    run_command(NAME, Arguments, __doc__, run)


if __name__ == "__main__":
    main()
