"""The files of a run over a recording: trajectories, a recording of both paths, a plot and the errors."""

import json
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from ngo_estimator.geometry.planar_motion import propagated
from ngo_estimator.mapping.map_files import write_map
from ngo_estimator.mapping.scan_map import ScanMap
from ngo_estimator.mapping.scan_source import ScanSource
from ngo_estimator.nodes.path_message import PathWriter
from ngo_estimator.nodes.step_messages import TYPES, StepMessages
from ngo_estimator.offline.recorded import RecordedRun, RecordedStep
from ngo_estimator.slam.trajectory_update import Trajectory
from ngo_estimator.trajectory.errors import aligned, associate
from ngo_estimator.trajectory.files import SpatialPoses, write_trajectory
from ngo_estimator.trajectory.g2o import write_g2o
from ngo_estimator.trajectory.plot import save_plot
from ngo_estimator.trajectory.report import Report, ReportSettings, trajectory_report
from ngo_recordings.writer import RecordingWriter

PATHS = {"odometry": "/odom/path", "corrected": "/ngo/path", "truth": "/ground_truth/path"}
PART = "part"  # Folders of the second trajectory of a recording and those after it have this name, and a number.

_FILES = (
    "odometry.tum",
    "online.tum",
    "corrected.tum",
    "truth.tum",
    "graph.g2o",
    "trajectories.mcap",
    "map.pgm",
    "map.yaml",
    "plot.png",
    "metrics.json",
    "run.json",
)
_PATH_TYPE = "nav_msgs/msg/Path"


def remove_results(folder: Path) -> None:
    """Remove the results of an earlier run, so that none of them passes for one of this."""
    for place in (folder, *folder.glob(f"{PART}[0-9]*")):
        for name in _FILES:
            (place / name).unlink(missing_ok=True)


class RecordedOutput:
    """Writes the results of one trajectory into a folder; a context manager.

    ``trajectories.mcap`` grows with every step; the other files are written when the trajectory is whole:
    ``odometry.tum``, ``online.tum`` (each pose as it was when its frame was the newest), ``corrected.tum``,
    ``graph.g2o``, ``plot.png``, with a ``source`` of ranges ``map.pgm`` and ``map.yaml``, and, where the truth is
    known, ``truth.tum`` and ``metrics.json``. All stamps are those of the frames, so that the same recording gives the
    same bytes.
    """

    def __init__(
        self, folder: Path, base_frame: str, odom_frame: str, map_frame: str, source: ScanSource | None = None
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self._frames = {"odom": odom_frame, "map": map_frame}
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._messages = StepMessages(base_frame, odom_frame, map_frame, self._serialise)
        self._covariance = np.zeros((3, 3))
        self._source, self._map = source, ScanMap()
        self.left_out = ""
        """Why scans are not in the map, where any were left out."""
        self.coarser = ""
        """Why the map's cells are larger than usual, where they are."""
        self._writer = RecordingWriter(folder / "trajectories.mcap", flush_s=None, library="ngo_estimator")
        for topic, type_name in TYPES.items():
            self._writer.add_topic(topic, type_name)

    def __enter__(self) -> "RecordedOutput":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.close()

    def add(self, step: RecordedStep) -> None:
        """Write the messages that the nodes publish about a step."""
        local = step.local
        self._covariance = propagated(self._covariance, local.odom_xyyaw, local.relative_xyyaw, local.covariance)
        for topic, message in self._messages.of(local, self._covariance, step.update).items():
            self._writer.write(topic, message, local.stamp_ns)
        if self._source is not None:
            self._map.take(local, self._source.scans(local))

    @property
    def waiting(self) -> int:
        """Scans that wait for the map to follow."""
        return self._map.waiting

    def follow(self, trajectory: Trajectory) -> None:
        """Let the map follow the trajectory as it is now."""
        asked_m = self._map.config.resolution_m
        self.left_out = self._map.update(trajectory.stamps_ns, trajectory.poses_xyyaw).too_large or self.left_out
        if self._map.resolution_m > asked_m:
            made_m = self._map.resolution_m
            self.coarser = f"the map is too large for cells of {asked_m:g} m: it has cells of {made_m:g} m"

    def finish(self, run: RecordedRun, title: str, settings: ReportSettings) -> dict[str, Report]:
        """Write everything about the whole trajectory; returns the errors of each estimate, none without truth.

        Raises:
            ValueError: there is a truth, but nothing can be compared with it; all else has been written.
        """
        trajectory, truth = run.trajectory, run.truth
        stamps_ns = trajectory.stamps_ns
        estimates = {
            "odometry": trajectory.odometry_xyyaw,
            "online": trajectory.online_xyyaw,
            "corrected": trajectory.poses_xyyaw,
        }
        for name, poses in estimates.items():
            write_trajectory(self.folder / f"{name}.tum", stamps_ns, poses)
        write_g2o(self.folder / "graph.g2o", run.graph)
        self._write_path(PATHS["odometry"], self._frames["odom"], stamps_ns, estimates["odometry"])
        self._write_path(PATHS["corrected"], self._frames["map"], stamps_ns, estimates["corrected"])
        in_map = None
        if truth is not None:
            write_trajectory(self.folder / "truth.tum", truth.stamps_ns, truth.planar())
            in_map = _seen_by(truth, SpatialPoses.from_planar(stamps_ns, estimates["corrected"]))
            self._write_path(PATHS["truth"], self._frames["map"], truth.stamps_ns, in_map)
        shown = {name: estimates[name] for name in ("odometry", "corrected")}
        save_plot(self.folder / "plot.png", title, shown, in_map, run.walls)
        self.follow(trajectory)
        if len(self._map):
            write_map(self.folder / "map", self._map.cells())
        if truth is None:
            return {}
        reports = {
            name: trajectory_report(SpatialPoses.from_planar(stamps_ns, poses), truth, settings)
            for name, poses in estimates.items()
        }
        summary = {**reports, "truth_residual": _residual(run.truth_residual)}
        (self.folder / "metrics.json").write_text(json.dumps(summary, indent=1) + "\n")
        return reports

    def _serialise(self, message: Any, type_name: str) -> bytes:
        # The middleware's serialiser leaves the bytes between values as they happen to be: no two runs were the same.
        return bytes(self._store.serialize_cdr(message, type_name))

    def _write_path(self, topic: str, frame: str, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> None:
        self._writer.add_topic(topic, _PATH_TYPE, depth=1, transient_local=True)
        message = PathWriter(frame, lambda path: self._serialise(path, _PATH_TYPE)).write(
            int(stamps_ns[-1]), stamps_ns, poses_xyyaw
        )
        self._writer.write(topic, message, int(stamps_ns[-1]))


def _seen_by(truth: SpatialPoses, estimate: SpatialPoses) -> np.ndarray:
    """The truth ``(frames, 3)`` in the frame of the estimate, with which its first common pose agrees."""
    true, ours = associate(truth, estimate)
    first, onto = (SpatialPoses(p.stamps_ns[:1], p.positions_xyz[:1], p.quaternions_xyzw[:1]) for p in (true, ours))
    whole = SpatialPoses(
        np.concatenate((first.stamps_ns, truth.stamps_ns)),
        np.concatenate((first.positions_xyz, truth.positions_xyz)),
        np.concatenate((first.quaternions_xyzw, truth.quaternions_xyzw)),
    )
    return aligned(whole, onto, "first").planar()[1:]


def _residual(values: np.ndarray) -> dict[str, Any]:
    """Root mean square of z, roll and pitch, which the projection of the truth to the plane leaves out."""
    z_m, roll_rad, pitch_rad = np.sqrt(np.mean(values**2, axis=0)).tolist()
    return {"z_m": z_m, "roll_deg": float(np.degrees(roll_rad)), "pitch_deg": float(np.degrees(pitch_rad))}
