"""The rows of the lidar's tables: who estimates, with which settings. One line makes a row."""

import contextlib
import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.lidar import mixture_lidar
from ngo_estimator.frontend.lidar.mixture_config import read_mixture_config
from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar
from ngo_estimator.geometry.planar_motion import chained
from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.robust import Robust
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam import scan_trajectory
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory
from ngo_recordings.scan_stream import WheelPose
from training.baselines import graph_peers, lidar_peers
from training.baselines.graph_peers import Peer
from training.baselines.lidar_peers import KissConfig
from training.data.lidar_drives import LidarDrive
from training.scoring import wrong_loops
from training.scoring.wrong_loops import WrongLoopsConfig, with_wrong_loops

_MOST_WALL_POINTS = 60_000  # of a picture
_PIPELINE = (mixture_lidar, scan_trajectory)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Where a row says that the robot was.

    ``poses`` ``(n, 3)`` at ``stamps_ns`` ``(n,)`` with all the row knows at the end. Where the row has them: ``online``
    ``(n, 3)`` as published at each stamp with ``covariances`` ``(n, 3, 3)``, ``odometry`` ``(n, 3)`` that was given to
    the correction, and ``walls`` ``(m, 2)`` at the corrected poses. ``scans_per_s`` by computing time of one thread;
    ``facts`` are numbers about the run.
    """

    stamps_ns: np.ndarray
    poses: np.ndarray
    scans_per_s: float | None = None
    online: np.ndarray | None = None
    covariances: np.ndarray | None = None
    odometry: np.ndarray | None = None
    walls: np.ndarray | None = None
    facts: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Pipeline:
    """Our estimators with the shipped settings, and what a row changes of them.

    ``wheels`` are listened to where the robot has any. ``odometry`` and ``graph`` are changes of the front end and of
    the back end, by the setting's name with dots: ``{"loops.every": 4}``.
    """

    wheels: bool = True
    odometry: Mapping[str, Any] = field(default_factory=dict)
    graph: Mapping[str, Any] = field(default_factory=dict)


Config = TypeVar("Config")


def changed(config: Config, changes: Mapping[str, Any]) -> Config:
    """A dataclass with other values; raises ``TypeError`` for a name that it does not have."""
    for name, value in changes.items():
        first, _, rest = name.partition(".")
        inner = changed(getattr(config, first), {rest: value}) if rest else value
        config = dataclasses.replace(config, **{first: inner})  # type: ignore[type-var]
    return config


@dataclass(frozen=True, eq=False)
class Front:
    """What odometry gave: its steps, the age of scans that it found, unsure steps, and its computing time."""

    steps: list[RelativeStep]
    lag_s: float
    unsure: int
    took_s: float


@dataclass(frozen=True, eq=False)
class _Run:
    online: ScanTrajectory
    trajectory: Trajectory
    covariances: np.ndarray
    front: Front
    back_s: float


class DriveRuns:
    """Our estimators over one drive: rows that share a front end, or all of it, share its run."""

    def __init__(self, drive: LidarDrive, weights: Path) -> None:
        self.drive = drive
        self._weights = weights
        self._fronts: dict[str, Front] = {}
        self._runs: dict[str, _Run] = {}

    def run(self, pipeline: Pipeline) -> _Run:
        """Both estimators over the drive; raises ``ValueError`` where it gives no trajectory."""
        pipeline = dataclasses.replace(pipeline, wheels=pipeline.wheels and bool(self.drive.wheels))
        key = identity_of(pipeline)
        if key not in self._runs:
            self._runs[key] = self._optimized(self.front(pipeline), pipeline)
        return self._runs[key]

    def front(self, pipeline: Pipeline) -> Front:
        """Odometry over the drive."""
        key = identity_of(dataclasses.replace(pipeline, graph={}))
        if key not in self._fronts:
            settings = changed(read_mixture_config(self._weights), pipeline.odometry)
            odometry = MixtureLidar(settings, self.drive.mounting)
            steps: list[RelativeStep] = []
            began = time.process_time()
            for record in self.drive.records(pipeline.wheels):
                if isinstance(record, WheelPose):
                    odometry.add_wheels(record.stamp_ns, record.pose_xyyaw)
                else:
                    with contextlib.suppress(ValueError):  # a scan that is of no use is left out, as by the node
                        odometry.add_scan(record)
                _take(odometry, steps, at_end=False)
            _take(odometry, steps, at_end=True)
            took_s = time.process_time() - began
            self._fronts[key] = Front(steps, odometry.lag_s, sum(step.unsure for step in steps), took_s)
        return self._fronts[key]

    def _optimized(self, front: Front, pipeline: Pipeline) -> _Run:
        settings = changed(read_lidar_file(self._weights, "graph", ScanGraphConfig), pipeline.graph)
        online = ScanTrajectory(settings)
        covariances = [np.zeros((3, 3))]
        began = time.process_time()
        for step in front.steps:
            covariances.append(online.update(step).covariance)
        online.finish()
        back_s = time.process_time() - began
        trajectory = online.trajectory()
        if trajectory is None or len(trajectory.stamps_ns) != len(covariances):
            raise ValueError(f"{self.drive.name}: {len(front.steps)} steps give no trajectory; expected a single one")
        return _Run(online, trajectory, np.stack(covariances), front, back_s)


def _take(odometry: MixtureLidar, steps: list[RelativeStep], at_end: bool) -> None:
    while True:
        try:
            steps.extend(odometry.ready(at_end))
            return
        except ValueError:
            continue


def ours(runs: DriveRuns, pipeline: Pipeline) -> Estimate:
    """The whole pipeline."""
    run = runs.run(pipeline)
    trajectory, seconds = run.trajectory, run.front.took_s + run.back_s
    return Estimate(
        trajectory.stamps_ns,
        trajectory.poses_xyyaw,
        len(trajectory.stamps_ns) / seconds,
        trajectory.online_xyyaw,
        run.covariances,
        trajectory.odometry_xyyaw,
        run.online.walls(_MOST_WALL_POINTS),
        {
            "keys": len(run.online.back_end.graph),
            "loops": len(run.online.back_end.closed),
            "lag_s": run.front.lag_s,
            "unsure": run.front.unsure,
        },
    )


def graph_peer(runs: DriveRuns, solve: Peer) -> Estimate:
    """Another solver on the steps and the loops of our own run, from its odometry."""
    run = runs.run(Pipeline())
    back_end = run.online.back_end
    problem = _problem(*back_end.measurements())
    began = time.process_time()
    nodes = solve(problem)
    facts = {"solver_s": time.process_time() - began, "loops": len(problem.loops)}
    poses = back_end.graph.frame_poses(nodes=nodes)
    return Estimate(run.trajectory.stamps_ns, poses, odometry=run.trajectory.odometry_xyyaw, facts=facts)


def fed_with_wrong_loops(runs: DriveRuns, solve: Peer, wrong: WrongLoopsConfig) -> list[Estimate]:
    """A solver on the steps and the loops of our own run and wrong loops, one estimate for each seed of these."""
    run = runs.run(Pipeline())
    steps, loops = run.online.back_end.measurements()
    estimates = []
    for seed in wrong.seeds:
        fed = with_wrong_loops(loops, len(steps) + 1, wrong.percent, np.random.default_rng(seed))
        poses = run.online.back_end.graph.frame_poses(nodes=solve(_problem(steps, fed)))
        estimates.append(Estimate(run.trajectory.stamps_ns, poses, odometry=run.trajectory.odometry_xyyaw))
    return estimates


def _problem(steps: RelativePoses, loops: RelativePoses) -> GraphProblem:
    return GraphProblem(chained(steps.relative), steps, loops, np.ones(len(loops)))


def wheels_alone(runs: DriveRuns) -> Estimate:
    """The wheel odometry as it was published."""
    wheels = runs.drive.wheels
    stamps_ns = np.array([pose.stamp_ns for pose in wheels], dtype=np.int64)
    kept = np.concatenate(([True], np.diff(np.maximum.accumulate(stamps_ns)) > 0))
    return Estimate(stamps_ns[kept], np.stack([pose.pose_xyyaw for pose in wheels])[kept])


def kiss(runs: DriveRuns, config: KissConfig) -> Estimate:
    """KISS-ICP."""
    drive = runs.drive
    began = time.process_time()
    poses = lidar_peers.kiss_icp(drive.scans, drive.mounting, config)
    return Estimate(drive.scan_stamps_ns, poses, len(poses) / (time.process_time() - began), online=poses)


@dataclass(frozen=True)
class Row:
    """A row: how it estimates, by which settings, and what it needs.

    ``code`` are the modules that its numbers follow from, beside those that they import. ``missing`` says in a few
    words what it lacks on this machine, or nothing. Of several estimates, one a seed, the mean error counts. Rows of
    the ``ablation`` are measured on some drives of a table alone.
    """

    estimate: Callable[[DriveRuns], Estimate | list[Estimate]]
    settings: Any
    needs_wheels: bool = False
    code: tuple[ModuleType, ...] = _PIPELINE
    missing: Callable[[], str] = lambda: ""
    ablation: bool = False


def _ours(ablation: bool = False, **changes: Any) -> Row:
    pipeline = Pipeline(**changes)
    return Row(partial(ours, pipeline=pipeline), pipeline, ablation=ablation)


def _gtsam(solve: Peer) -> Row:
    return Row(partial(graph_peer, solve=solve), None, code=(*_PIPELINE, graph_peers))


def _fed(name: str, solve: Peer, percent: float) -> Row:
    wrong = WrongLoopsConfig(percent)
    return Row(
        partial(fed_with_wrong_loops, solve=solve, wrong=wrong),
        {"solver": name, "wrong": dataclasses.asdict(wrong)},
        code=(*_PIPELINE, graph_peers, wrong_loops),
        ablation=True,
    )


def _robust(problem: GraphProblem) -> np.ndarray:
    return Robust().correct(problem).poses


def _kiss_missing() -> str:
    return "" if find_spec("kiss_icp") else "KISS-ICP is not installed (requirements/test.txt)"


ROWS: dict[str, Row] = {
    "wheels": Row(wheels_alone, None, needs_wheels=True, code=()),
    "ours": _ours(),
    "ours_without_wheels": _ours(wheels=False),
    "gtsam_lm": _gtsam(graph_peers.cauchy_on_all),
    "gtsam_gnc": _gtsam(graph_peers.gnc),
    "kiss_icp": Row(partial(kiss, config=KissConfig()), KissConfig(), code=(lidar_peers,), missing=_kiss_missing),
    **{
        f"{name}_{percent}_percent_wrong": _fed(name, solve, percent)
        for percent in (0, 10, 30, 60)
        for name, solve in (
            ("ours", _robust),
            ("gtsam_lm", graph_peers.cauchy_on_all),
            ("gtsam_gnc", graph_peers.gnc),
        )
    },
}
"""By name. Those that end with ``percent_wrong`` get wrong loops, so many of all: 0 for comparison."""

_FRONT_ABLATION: dict[str, dict[str, Any]] = {
    "wheels_that_are_good": {"first_weights": (0.0, 0.65, 0.1, 0.15, 0.07, 0.03)},
    "wheels_that_are_poor": {"first_weights": (0.65, 0.0, 0.1, 0.15, 0.07, 0.03)},
    "last_displacement": {"first_weights": (0.45, 0.2, 0.0, 0.25, 0.07, 0.03)},
    "last_velocity": {"first_weights": (0.45, 0.2, 0.25, 0.0, 0.07, 0.03)},
    "no_motion": {"first_weights": (0.45, 0.2, 0.14, 0.18, 0.0, 0.03)},
    "learned_deviations": {"learn_rate": 1e-9},
    "calibrated_wheels": {"certain_m": 1e9, "certain_rad": 1e9},
    "repeated_errors": {"repeated": 1.0},
    "second_mode": {"margin": 1e-9},
    "wide_windows": {"most_window_m": 0.4},
    "usual_misfit": {"usual_misfit": 1e-9},
    "lost": {"lost_share": 1e-9},
    "segments": {"lost": 1e9, "silent_s": 1e9},
}
"""What the front end does, and the settings without it."""

FRONT_ABLATION = {f"without_{name}": _ours(True, odometry=changes) for name, changes in _FRONT_ABLATION.items()}
"""Rows of the front end without one of its parts."""


def identity_of(settings: Any) -> str:
    """Settings in words; two of one identity are the same."""
    values = dataclasses.asdict(settings) if dataclasses.is_dataclass(settings) else settings  # type: ignore[arg-type]
    return json.dumps(values, sort_keys=True)
