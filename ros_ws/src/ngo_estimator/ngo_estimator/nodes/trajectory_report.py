"""What diagnostics say of the trajectory."""

from typing import TYPE_CHECKING

import numpy as np

from ngo_estimator.geometry.planar_covariance import position_std
from ngo_estimator.trajectory.files import seconds

if TYPE_CHECKING:
    from ngo_estimator.slam.loop_report import LoopReport
    from ngo_estimator.slam.trajectory_update import TrajectoryUpdate


class TrajectoryReport:
    """Counts what happened to the relative poses, and tells what is new since the last report."""

    def __init__(self) -> None:
        self._gaps = self._restarts = self._new_gaps = 0
        self._fault = ""
        self._last_correction_m = 0.0
        self._lost_since_ns: int | None = None

    def count(self, gap: bool, restarted: bool) -> None:
        """Count a relative pose."""
        self._gaps += gap
        self._new_gaps += gap
        self._restarts += restarted

    def updated(self, update: "TrajectoryUpdate") -> None:
        """Take what a relative pose, or the end of an optimisation, changed."""
        self._fault = update.fault or self._fault
        self._lost_since_ns = update.lost_since_ns
        if update.optimized:
            self._last_correction_m = update.largest_move_m

    def begin_anew(self) -> None:
        """Forget what was of another trajectory."""
        self._last_correction_m = 0.0
        self._lost_since_ns = None

    def counts(self) -> dict[str, str]:
        """Values for diagnostics in any mode."""
        return {"gaps": str(self._gaps), "restarts": str(self._restarts)}

    def details(
        self, update: "TrajectoryUpdate", loops: "LoopReport", map_from_odom: np.ndarray, covariance: np.ndarray
    ) -> dict[str, str]:
        """Values for diagnostics: map_from_odom ``(3,)`` and the newest pose's covariance ``(3, 3)`` in map."""
        x, y, yaw = map_from_odom.tolist()
        return {
            "frames": str(update.frames),
            "window fill": f"{update.window_fill:.3f}",
            "loops": str(update.closed_loops),
            "loops believed, doubted, refused": f"{loops.believed}, {loops.doubted}, {loops.refused}",
            "newest loop that is refused": loops.newest_refused or "none",
            "variances of steps, of loops (times as stated)": (
                "{:.3g}, {:.3g}".format(*loops.scales) if loops.scales else "not measured yet"
            ),
            "last correction, largest move (m)": f"{self._last_correction_m:.3f}",
            "standard deviation of the position (m)": f"{position_std(covariance):.3g}",
            "map_from_odom (x m, y m, yaw rad)": f"{x:.3f} {y:.3f} {yaw:.4f}",
        }

    def problems(self) -> list[str]:
        """Gaps and faults since the last call, and that the robot is lost."""
        found = []
        if self._lost_since_ns is not None:
            found.append(f"not localised in the map since {seconds(self._lost_since_ns)}")
        if self._new_gaps:
            found.append(f"{self._new_gaps} gaps in the relative poses, bridged by the odometry")
            self._new_gaps = 0
        if self._fault:
            found.append(f"internal fault, the trajectory goes on by odometry: {self._fault}")
            self._fault = ""
        return found
