"""Measure how far estimated trajectories are from the truth.

    python -m training.evaluate --world maze2d --split validation
    python -m training.evaluate --data drive_1.mcap drive_2.mcap --name my_robot
    python -m training.evaluate --estimate odometry.tum online.tum corrected.tum --truth truth.tum

`--world` drives through whole mazes of a split. It measures the odometry, the online estimate (each pose when it was
first published) and the corrected path at the end. `--data` measures the networks of a robot on the recording that was
held out, with plots in RUNS/NAME/results. `--estimate` compares TUM files by ATE, RPE and KITTI's segment errors, with
the definitions of evo. The last line is the table as one JSON object.
"""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
import tyro
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local, load_optimizer, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.trajectory.errors import KITTI_LENGTHS_M, RelativeDelta
from ngo_estimator.trajectory.report import ReportSettings
from training.common import records
from training.data.episodes import simulate
from training.data.features import OPTIMIZER_INPUTS, features_of
from training.data.worlds import TEST_SEEDS, VALIDATION_SEEDS, WorldName, world_named
from training.recordings.recording_source import RecordedArguments
from training.report.error_table import print_errors
from training.report.held_out import evaluate_recorded
from training.scoring.file_errors import evaluate_files
from training.scoring.metrics import TrajectoryError, trajectory_error
from training.scoring.online_estimate import run_online, with_origin

_SPLITS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}


@dataclass(frozen=True)
class Arguments:
    """Settings of an evaluation, of a world, of recordings or of files."""

    world: WorldName | None = None  # World to measure in.
    recordings: tyro.conf.OmitArgPrefixes[RecordedArguments] = field(default_factory=RecordedArguments)
    """Recordings of the training, with the same arguments."""
    split: Literal["validation", "test"] = "validation"  # Mazes to measure on.
    trajectories: int = 20  # Trajectories, each in a maze of its own.
    frames: int = 0  # Frames of a trajectory; 0 for the world's own (2D 2000, 3D 1000).
    weights: Path = records.WEIGHTS  # Folder with NAME/*.safetensors.
    online: bool = True  # Whether to measure the online estimate also; it runs the optimizer at every eighth frame.
    window_frames: int = 0
    """Frames of the online estimate's window; 0 for all. With a window there is one more row: `bounded`, the path at
    the end, with key frames before the window."""
    key_frames: int = 128  # Key frames before that window.
    estimate: tuple[Path, ...] = ()  # Estimated trajectories in the TUM format, to compare with `--truth`.
    truth: Path | None = None  # True trajectory in the TUM format.
    files_tolerance_s: float = 0.01
    """Files: largest time between an estimated pose and the true pose that it is compared with."""
    delta: float = 1.0  # Files: distance between the two poses of the RPE.
    delta_unit: Literal["frames", "metres"] = "frames"  # Files: unit of delta.
    all_pairs: bool = False  # Files: whether pairs of the RPE start at every pose, or at the end of the pair before.
    segment_lengths_m: tuple[float, ...] = KITTI_LENGTHS_M  # Files: lengths of KITTI's segments.
    runs: Path = records.ROOT / "runs"
    """Recordings: folder with NAME/data, which was read from them; gets NAME/results/."""

    def __post_init__(self) -> None:
        given = (self.world is not None) + bool(self.recordings.data) + bool(self.estimate)
        if given != 1 or bool(self.estimate) != (self.truth is not None):
            raise ValueError("expected one of --world, --data FILES, or --estimate FILES and --truth FILE")

    @property
    def report_settings(self) -> ReportSettings:
        """Settings of the comparison of files."""
        delta = RelativeDelta(self.delta, self.delta_unit, self.all_pairs)
        return ReportSettings(self.files_tolerance_s, delta, self.segment_lengths_m)


def main(arguments: Arguments) -> dict[str, object]:
    """Print the table and return it."""
    if arguments.recordings.data:
        return evaluate_recorded(arguments.recordings, arguments.weights, arguments.runs, arguments.online)
    if arguments.world is None:
        assert arguments.truth is not None
        return {**evaluate_files(arguments.estimate, arguments.truth, arguments.report_settings)}
    world = world_named(arguments.world)
    folder = arguments.weights / world.name
    local, place = load_local(folder, world.name)[0], load_place(folder, world.name)[0]
    optimizer = load_optimizer(folder, world.name)[0]
    seeds = list(_SPLITS[arguments.split][: arguments.trajectories])
    frames = arguments.frames or world.episode_frames
    window = arguments.window_frames or max(frames, 2 * optimizer.block)
    core = OnlineTrajectory(optimizer, place.pair_head, window, arguments.key_frames)
    bounded = ("bounded",) if arguments.window_frames else ()
    names = ("odometry", *(("online", *bounded) if arguments.online else ()), "corrected")
    errors: dict[str, list[TrajectoryError]] = {name: [] for name in names}
    with tqdm(total=len(seeds), desc=f"{world.name} {arguments.split}") as bar:
        for group in (seeds[i : i + 8] for i in range(0, len(seeds), 8)):
            for episode in simulate(world, group, frames):
                features = features_of(world, episode, folder, (local, place))
                arrays = [torch.from_numpy(features[name]) for name in OPTIMIZER_INPUTS]
                corrected = optimize_offline(optimizer, place.pair_head, *arrays).poses[0]
                poses = {
                    "odometry": with_origin(se2.r2g(arrays[0]).numpy()),
                    "corrected": with_origin(corrected.numpy()),
                }
                if arguments.online:
                    trajectory = run_online(core, features)
                    poses["online"], poses["bounded"] = trajectory.online_xyyaw.copy(), trajectory.poses_xyyaw.copy()
                for name in names:
                    errors[name].append(trajectory_error(poses[name], episode.poses_xyyaw))
                bar.update()
    result: dict[str, object] = {
        "world": world.name,
        "split": arguments.split,
        "trajectories": len(seeds),
        "frames": frames,
    }
    result |= print_errors(f"{world.name}, {len(seeds)} {arguments.split} mazes of {frames} frames", errors)
    wins = sum(
        c.position_rmse_m < o.position_rmse_m for o, c in zip(errors["odometry"], errors["corrected"], strict=True)
    )
    result["corrected_better_in"] = wins
    print(json.dumps(result))
    return result


def command_line() -> int:
    """Run with the command line's arguments; returns the exit code, 2 with one line for what cannot be measured."""
    try:
        main(tyro.cli(Arguments, description=__doc__))
    except (ValueError, OSError) as error:
        print(f"evaluate: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(command_line())
