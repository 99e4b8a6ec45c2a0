"""From what the nodes publish to what a view draws: one method for each kind of message."""

from typing import Any, Protocol

import numpy as np

from ngo_estimator.view.shapes import Window, ellipse, known_corners, scan_points, shown_picture, window_around
from ngo_estimator.view.tracks import (
    RESTART_NS,
    StampedPoses,
    Track,
    begun_with_identity,
    placed,
    position_rmse_m,
)
from ngo_recordings.images import picture
from ngo_recordings.laser_scan import scan_of
from ngo_recordings.mounting import mounting_in
from ngo_recordings.transform_buffer import TransformBuffer

_ARROW_SHARE = 0.06  # Length of the robot's arrow as a share of half the window: seen in a room and in a building.


class Canvas(Protocol):
    """What a view draws on: ``RerunView``, which documents the methods."""

    url: str

    def at(self, seconds: float) -> None: ...
    def look_at(self, window: Window) -> None: ...
    def path(self, name: str, xy: np.ndarray) -> None: ...
    def loops(self, lines: np.ndarray, colors: np.ndarray) -> None: ...
    def frontiers(self, xy: np.ndarray, colors: np.ndarray) -> None: ...
    def plan(self, xy: np.ndarray) -> None: ...
    def robot(self, pose_xyyaw: np.ndarray, outline: np.ndarray, size_m: float) -> None: ...
    def scan(self, xy: np.ndarray) -> None: ...
    def grid(self, cells: np.ndarray, resolution_m: float, origin_xyyaw: np.ndarray) -> None: ...
    def picture(self, image: np.ndarray) -> None: ...
    def error(self, name: str, position_rmse_m: float) -> None: ...
    def text(self, markdown: str) -> None: ...
    def close(self) -> None: ...


class LiveView:
    """Draws trajectories in the frame of the corrected one, and the errors where the truth is known.

    ``tracks`` holds the odometry and the truth, each in a frame of its own; the truth and the odometry are laid over
    the first pose of the corrected trajectory that they share.
    """

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self.url = canvas.url
        self.tracks = {"odometry": Track(), "truth": Track()}
        self._window: Window | None = None
        self._seen = np.zeros((0, 2))
        self._pose = np.zeros(3)
        self._loops = 0
        self._newest_ns: int | None = None
        self._passed_ns = 0
        # Compiled now: later it would hold up the messages.
        start = StampedPoses(np.zeros(1, np.int64), np.zeros((1, 3)))
        placed(start, start)

    def show_pose(self, stamp_ns: int, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> None:
        """The newest corrected pose ``(3,)`` with its covariance ``(3, 3)``."""
        self._set_time(stamp_ns)
        self._pose = pose_xyyaw
        size_m = _ARROW_SHARE * (self._window.half_m if self._window else 1.0)
        self._canvas.robot(pose_xyyaw, ellipse(pose_xyyaw, covariance), size_m)

    def show_trajectory(self, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> None:
        """The corrected trajectory: stamps ``(n,)`` and poses ``(n, 3)``; with it odometry, truth and errors."""
        if not len(stamps_ns):
            return
        self._set_time(int(stamps_ns[-1]))
        corrected = StampedPoses(stamps_ns, poses_xyyaw)
        shown = {"corrected": corrected}
        for name, track in self.tracks.items():
            if len(track):
                own = begun_with_identity(track, corrected) if name == "odometry" else _poses_of(track)
                if (here := placed(own, corrected)) is not None:
                    shown[name] = here
        self._keep_in_view(poses_xyyaw[:, :2])
        for name, poses in shown.items():
            self._canvas.path(name, poses.poses_xyyaw[:, :2])
        self._show_errors(shown)

    def show_loops(self, lines: np.ndarray, colors: np.ndarray) -> None:
        """Loops as lines ``(n, 2, 2)`` with colors ``(n, 4)``: red, green, blue and opacity, zero to one."""
        self._loops = len(lines)
        self._canvas.loops(lines, colors)

    def show_frontiers(self, xy: np.ndarray, colors: np.ndarray) -> None:
        """What is left to explore: points ``(n, 2)`` with colors ``(n, 3)``, zero to one."""
        self._canvas.frontiers(xy, colors)

    def show_plan(self, xy: np.ndarray) -> None:
        """The path ``(n, 2)`` that the robot means to drive; its end is the goal."""
        self._canvas.plan(xy)

    def show_map(self, cells: np.ndarray, resolution_m: float, origin_xyyaw: np.ndarray) -> None:
        """An occupancy grid ``(height, width)`` as ``nav_msgs/OccupancyGrid`` defines its cells."""
        self._canvas.grid(cells, resolution_m, origin_xyyaw)
        self._keep_in_view(known_corners(cells, resolution_m, origin_xyyaw))

    def show_picture(self, message: Any, type_name: str, topic: str) -> None:
        """An image message. Raises ``ValueError`` for one that cannot be read."""
        self._canvas.picture(shown_picture(picture(message, type_name, topic)[0]))

    def show_scan(self, message: Any, topic: str, static: TransformBuffer, base_frame: str) -> None:
        """A scan message at the newest corrected pose. Raises ``ValueError`` for one that cannot be read."""
        scan = scan_of(message, topic)
        self._canvas.scan(scan_points(scan, mounting_in(static, base_frame, scan.frame_id), self._pose))

    def close(self) -> None:
        """End the view."""
        self._canvas.close()

    def _show_errors(self, shown: dict[str, StampedPoses]) -> None:
        stamps = shown["corrected"].stamps_ns
        lines = [f"**{len(stamps)} frames**, {self._loops} loops"]
        for name in ("odometry", "corrected"):
            if name in shown and "truth" in shown:
                error = position_rmse_m(shown[name], shown["truth"], stamps)
                if error is not None:
                    self._canvas.error(name, error)
                    lines.append(f"{name}: position RMSE **{error:.3f} m**")
        self._canvas.text("\n\n".join(lines))

    def _keep_in_view(self, xy: np.ndarray) -> None:
        """Look at all that was there so far, and at points ``(n, 2)``."""
        if not len(xy):
            return
        self._seen = np.vstack([self._seen, xy])
        self._seen = np.stack([self._seen.min(axis=0), self._seen.max(axis=0)])
        if self._window is None or not self._window.holds(*self._seen):
            self._window = window_around(*self._seen)
            self._canvas.look_at(self._window)

    def _set_time(self, stamp_ns: int) -> None:
        """Time since the first stamp, which goes on where a restarted source begins earlier."""
        if self._newest_ns is not None:
            step_ns = stamp_ns - self._newest_ns
            if -RESTART_NS < step_ns <= 0:
                return
            self._passed_ns += max(step_ns, 0)
        self._newest_ns = stamp_ns
        self._canvas.at(self._passed_ns / 1e9)


def _poses_of(track: Track) -> StampedPoses:
    return StampedPoses(track.stamps_ns, track.poses_xyyaw)
