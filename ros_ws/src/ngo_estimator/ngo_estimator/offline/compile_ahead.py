"""Compiles what estimators run, so that the first run after an installation does not: for `make build`.

    python -m ngo_estimator.offline.compile_ahead [WEIGHTS ...]

Compiles for lidars, with their map, for calibrated cameras, and for the networks in the folders WEIGHTS. What was
compiled lies beside the modules, or where they cannot be written to in the user's cache, or in NUMBA_CACHE_DIR.
"""

import sys
from pathlib import Path

import numpy as np

from ngo_estimator.geometry.view_pose import fit_view, measured_ranges, unmeasured
from ngo_estimator.mapping.scan_map import ScanMap
from ngo_estimator.mapping.scan_source import KeyScans
from ngo_estimator.offline.warm_up import warm_up_odometry
from ngo_estimator.slam.scan_trajectory import ScanTrajectory


def compile_for_lidars() -> None:
    """Both estimators and the map, over the drive of ``warm_up_odometry``."""
    online, grid, source = ScanTrajectory(), ScanMap(), KeyScans()
    for step in warm_up_odometry():
        online.update(step)
        grid.take(step, source.scans(step))
    online.finish()
    trajectory = online.trajectory()
    assert trajectory is not None
    grid.update(trajectory.stamps_ns, trajectory.poses_xyyaw)
    grid.cells()


def compile_for_cameras() -> None:
    """The fit of a picture's pose, to a point that nobody has measured."""
    centre, rays = np.zeros(3), np.array(((1.0, 0.0, 0.0),))
    point = unmeasured(centre, rays, 0.25)
    fit_view(point, rays, np.ones(1), centre, np.zeros(3), (np.zeros(3), np.eye(3)), 1.0, 1.0)
    measured_ranges(point, rays, np.ones(1), np.zeros(3), centre)


def main(weights: list[Path]) -> None:
    """Compile for lidars, cameras, and networks in the folders ``weights``."""
    compile_for_lidars()
    compile_for_cameras()
    for folder in weights:
        # Imported here because a lidar's installation has no torch.
        from ngo_estimator.offline.warm_up_trajectory import warm_up_networks
        from ngo_estimator.slam.online_trajectory import OnlineTrajectory

        warm_up_networks(OnlineTrajectory.load(folder))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
