"""A hundred thousand frames through the online core: time a frame, memory and error as the trajectory grows.

    python -m benchmarks.long_run

One drive in one maze of the 2D world, on one core with one thread. With ``--world scan`` it is a lidar with wheels in
one building, and both estimators run: a frame is a scan. The last line is one JSON object; exit code 1 where the last
10,000 frames take 1.2 times as long as those from 5,000 to 15,000, by processor time, or memory grows by 100 MB from
frame 10,000 on. Memory is what the process alone has resident (RssAnon), without mapped files and less the bytes of the
stored path: stamps, odometry, its deviations, poses as first published, and nodes.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from tqdm import tqdm

from benchmarks.drives import CACHE, drive_of, stamp_ns
from benchmarks.pinned import in_process, two_cores
from benchmarks.process_use import memory_mb
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.nodes.path_message import PathWriter
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.odometry_blocks import OdometryBlocks
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.common.records import ROOT, WEIGHTS
from training.data.batches import seen_from_first
from training.data.building_drives import building_drive
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring.metrics import position_rmse_m

LONGEST_RATIO, MOST_GROWTH_MB = 1.2, 100.0
_FAR_M = 100_000.0


@dataclass(frozen=True)
class Arguments:
    """What to drive."""

    world: Literal["maze2d", "maze3d", "scan"] = "maze2d"  # World to drive in.
    seed: int = 2000  # Maze or building to drive through.
    frames: int = 100_000  # Frames of the drive, a multiple of ``every``.
    every: int = 1000  # Frames that are summed up in one point of the curves.
    window: int = 2000  # Frames that are optimised together; a lidar has no window.
    key_frames: int = 128  # Key frames from before the window; a lidar has no window.
    iterations_per_step: int = 1
    """Iterations of an optimisation that one frame pays for, as in ngo_node; 0: all at once."""
    plot: Path = ROOT / "docs" / "images" / "online_100000.png"  # Picture of the curves.
    cache: Path = CACHE  # Folder for the drive, which is made once, and the curves as JSON.

    def __post_init__(self) -> None:
        if self.every < 8 or self.frames % self.every or self.frames < 20 * self.every:
            raise ValueError(
                f"frames, every are {self.frames}, {self.every}; expected a multiple, 20 times or more, of at least 8"
            )


@dataclass(frozen=True)
class Point:
    """After ``frames`` frames: ms of the last ones, memory, path, and RMSE (m) of all poses so far."""

    frames: int
    mean_ms: float
    mean_cpu_ms: float
    p99_ms: float
    memory_mb: float
    stored_path_mb: float
    path_ms: float
    odometry_rmse_m: float
    online_rmse_m: float
    optimised_rmse_m: float


@dataclass(frozen=True)
class Run:
    """A drive and what estimates it: each call of ``frames`` takes one frame.

    ``truth`` and ``odometry`` ``(n, 3)`` at ``stamps_ns`` ``(n,)``;"""

    core: CorrectedTrajectory
    frames: Iterator[Callable[[], object]]
    stamps_ns: np.ndarray
    truth: np.ndarray


def points(arguments: Arguments) -> list[Point]:
    """Drive, with one thread."""
    torch.set_num_threads(1)
    run = _scan_run(arguments) if arguments.world == "scan" else _maze_run(arguments)
    core = run.core
    wall_ms, cpu_ms = np.zeros(arguments.every), np.zeros(arguments.every)
    writer, found = PathWriter("map"), []
    for number, take in enumerate(tqdm(run.frames, arguments.world, arguments.frames), 1):
        cpu, wall = time.process_time(), time.perf_counter()
        take()
        at = (number - 1) % arguments.every
        wall_ms[at], cpu_ms[at] = 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - cpu)
        if number % arguments.every:
            continue
        resident_mb, stored_mb = memory_mb(os.getpid()), stored_path_mb(core)
        begin = time.perf_counter()
        trajectory = core.trajectory()
        assert trajectory is not None
        writer.write(int(trajectory.stamps_ns[-1]), trajectory.stamps_ns, trajectory.poses_xyyaw)
        path_ms = 1e3 * (time.perf_counter() - begin)
        # A scan that is of no use has no pose.
        so_far = run.truth[np.searchsorted(run.stamps_ns, trajectory.stamps_ns)]
        point = Point(
            frames=number,
            mean_ms=float(wall_ms.mean()),
            mean_cpu_ms=float(cpu_ms.mean()),
            p99_ms=float(np.percentile(wall_ms, 99)),
            memory_mb=resident_mb,
            stored_path_mb=stored_mb,
            path_ms=path_ms,
            odometry_rmse_m=position_rmse_m(trajectory.odometry_xyyaw, so_far),
            online_rmse_m=position_rmse_m(trajectory.online_xyyaw, so_far),
            optimised_rmse_m=position_rmse_m(trajectory.poses_xyyaw, so_far),
        )
        found.append(point)
        if len(found) % 5 == 0:
            tqdm.write(
                f"{number:7d} frames: {point.mean_ms:.2f} ms a frame ({point.mean_cpu_ms:.2f} cpu), "
                f"{resident_mb - stored_mb:.1f} MB, path {path_ms:.1f} ms, RMSE odometry {point.odometry_rmse_m:.2f}, "
                f"online {point.online_rmse_m:.3f}, optimised {point.optimised_rmse_m:.3f} m"
            )
    return found


def _maze_run(arguments: Arguments) -> Run:
    drive = drive_of(arguments.world, arguments.seed, arguments.frames, arguments.cache)
    core = OnlineTrajectory.load(
        WEIGHTS / arguments.world,
        arguments.window,
        arguments.world,
        arguments.key_frames,
        arguments.iterations_per_step,
    )
    stamps_ns = np.array([stamp_ns(frame) for frame in range(len(drive) + 1)])
    truth = np.concatenate((np.zeros((1, 3)), drive.truth))
    return Run(core, (partial(core.update, step) for step in drive.steps()), stamps_ns, truth)


def _scan_run(arguments: Arguments) -> Run:
    drive = building_drive(arguments.seed, _FAR_M, most_scans=arguments.frames)
    assert isinstance(drive.reference, TruePoses)
    core = ScanTrajectory.load(WEIGHTS / "scan", iterations_per_step=arguments.iterations_per_step)
    odometry = MixtureLidar.load(WEIGHTS / "scan")
    odometry.mounting = drive.mounting
    truth = seen_from_first(drive.reference.poses_xyyaw)
    return Run(core, _scans(drive, odometry, core), drive.reference.stamps_ns, truth)


def _scans(drive: LidarDrive, odometry: MixtureLidar, core: ScanTrajectory) -> Iterator[Callable[[], None]]:
    """One call for each scan of a drive and the wheel poses before it, through both estimators."""

    def take(records: list[LidarScan | WheelPose]) -> None:
        for record in records:
            if isinstance(record, WheelPose):
                odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
            else:
                odometry.add_scan(record)
            for step in odometry.ready():
                core.update(step)

    waiting: list[LidarScan | WheelPose] = []
    for record in drive.records():
        waiting.append(record)
        if isinstance(record, LidarScan):
            yield partial(take, waiting)
            waiting = []


def stored_path_mb(core: CorrectedTrajectory) -> float:
    """What of the trajectory has to be kept for every frame."""
    owners = PoseGraph | OdometryBlocks | ScanLoopFinder
    parts = (core, core._log, *(part for part in vars(core._back_end).values() if isinstance(part, owners)))
    rows = [value for part in parts for value in vars(part).values() if isinstance(value, GrowingRows)]
    return sum(each.values.nbytes for each in rows) / 2**20


def summary(found: list[Point]) -> dict[str, Any]:
    """The bars' values and the end of the curves."""
    frames = found[-1].frames
    tenth, twentieth = frames // 10, frames // 20

    def mean(name: str, after: int, to: int) -> float:
        return float(np.mean([getattr(point, name) for point in found if after < point.frames <= to]))

    early, late = ((twentieth, twentieth + tenth), (frames - tenth, frames))
    memory = {
        point.frames: point.memory_mb - point.stored_path_mb for point in found if point.frames in (tenth, frames)
    }
    return {
        "frames": frames,
        "ms_a_frame_early": mean("mean_ms", *early),
        "ms_a_frame_late": mean("mean_ms", *late),
        "ratio": mean("mean_ms", *late) / mean("mean_ms", *early),
        "cpu_ratio": mean("mean_cpu_ms", *late) / mean("mean_cpu_ms", *early),
        "memory_mb_at_tenth": memory[tenth],
        "memory_mb_at_end": memory[frames],
        "memory_growth_mb": memory[frames] - memory[tenth],
        "end": asdict(found[-1]),
    }


def save_plot(path: Path, found: list[Point], title: str) -> None:
    """Write the curves as a PNG."""
    figure = Figure(figsize=(9.0, 8.5))
    FigureCanvasAgg(figure)
    above, middle, below = figure.subplots(3, 1, sharex=True)
    frames = [point.frames for point in found]

    def curve(axes: Any, name: str, label: str, color: str) -> None:
        axes.plot(frames, [getattr(point, name) for point in found], label=label, color=color, linewidth=1.5)

    curve(above, "mean_cpu_ms", "time a frame, mean (processor time)", "#1f6fd6")
    curve(above, "mean_ms", "time a frame, mean (by the clock)", "#9ec3f0")
    # Where others had the core, the clock runs out of the picture.
    above.set(ylabel="ms", ylim=(0.0, 2.5 * max(point.mean_cpu_ms for point in found)), title=title)
    beyond = [point.memory_mb - point.stored_path_mb for point in found]
    middle.plot(frames, beyond, label="resident memory without the stored path", color="#2ca02c", linewidth=1.5)
    curve(middle, "stored_path_mb", "stored path", "#a7d7a7")
    middle.set(ylabel="MB", ylim=(0.0, None))
    curve(below, "odometry_rmse_m", "odometry", "#d62728")
    curve(below, "online_rmse_m", "online: each pose as first published", "#ff7f0e")
    curve(below, "optimised_rmse_m", "optimised: all poses as they are now", "#2ca02c")
    below.set(ylabel="position RMSE so far (m)", xlabel="frames", yscale="log")
    for axes in (above, middle, below):
        axes.grid(color="#dddddd", linewidth=0.5)
        axes.legend(frameon=False, fontsize=9)
    below.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    below.yaxis.set_major_formatter("{x:g}")
    below.yaxis.set_minor_formatter(NullFormatter())
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, bbox_inches="tight")


def main(arguments: Arguments) -> int:
    """Drive, plot, print everything as one line of JSON; return the exit code."""
    found = in_process(two_cores()[0], points, arguments)
    result = summary(found)
    arguments.cache.mkdir(parents=True, exist_ok=True)
    (arguments.cache / "long_run.json").write_text(json.dumps([asdict(point) for point in found]))
    save_plot(arguments.plot, found, f"{arguments.world}, {arguments.frames:,} frames on one core")
    print(json.dumps(result))
    return 0 if result["cpu_ratio"] <= LONGEST_RATIO and result["memory_growth_mb"] <= MOST_GROWTH_MB else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
