"""Compiles what both estimators of a lidar run; apart from those of networks, which do without what these load."""

from ngo_estimator.offline.warm_up import warm_up_odometry
from ngo_estimator.slam.scan_trajectory import ScanTrajectory


def warm_up_scans() -> None:
    """Both estimators of a lidar, over the drive of ``warm_up_odometry``."""
    online = ScanTrajectory()
    for step in warm_up_odometry():
        online.update(step)
    online.finish()
