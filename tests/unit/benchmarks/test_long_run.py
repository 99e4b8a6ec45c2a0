"""What has to be kept for every frame is found wherever the graph keeps it."""

import pytest

from benchmarks.long_run import stored_path_mb
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from tests.unit.ngo_estimator.slam.test_online_trajectory import make_steps
from tests.unit.ngo_estimator.slam.test_saved_state import lidar_drive, networks, scans


@pytest.mark.parametrize("core", [networks(), scans()], ids=["networks", "lidar"])
def test_the_stored_path_holds_what_the_graph_keeps_of_each_frame(core: CorrectedTrajectory) -> None:
    steps = make_steps(140) if core.identity.get("window_frames") else lidar_drive()
    for step in steps:
        core.update(step)
    odometry_mb = 3 * 8 * (len(steps) + 1) / 2**20  # the graph's own odometry, beside the log's
    logged = [rows for rows in vars(core._log).values() if isinstance(rows, GrowingRows)]
    assert stored_path_mb(core) > sum(rows.values.nbytes for rows in logged) / 2**20 + odometry_mb
