"""Compiles what estimators run, so that the first run after an installation does not: for `make build`.

    python -m ngo_estimator.offline.compile_ahead [WEIGHTS ...]

Compiles for lidars, with their map, and for the networks in the folders WEIGHTS. What was compiled lies beside the
modules, or where they cannot be written to in the user's cache, or in NUMBA_CACHE_DIR.
"""

import sys
from pathlib import Path

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


def main(weights: list[Path]) -> None:
    """Compile for lidars, and for networks in the folders ``weights``."""
    compile_for_lidars()
    for folder in weights:
        # Imported here because a lidar's installation has no torch.
        from ngo_estimator.offline.warm_up_trajectory import warm_up_networks
        from ngo_estimator.slam.online_trajectory import OnlineTrajectory

        warm_up_networks(OnlineTrajectory.load(folder))


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
