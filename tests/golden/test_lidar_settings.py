"""A lidar's estimators, with the shipped settings, correct a stored drive as they did when it was stored.

``lidar.json`` that is broken or changed fails here, and so does a change of the estimators that changes their results.
``tests.golden.make_drives scan`` makes the stored file anew.
"""

import functools
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ngo_estimator.data.lidar_file import LIDAR_FILE, LidarFileError
from tests.golden.drives import WEIGHTS, largest_difference, position_rmse
from tests.golden.lidar_drives import GoldenLidarDrive, corrected_scans

SHIPPED = WEIGHTS / "scan"

# With AVX-512, AVX2 and neither, in numpy, BLAS and numba, poses differ by less than 0.1 um and 0.1 urad. Registration
# chooses (key scans, nearest points, loops), and another choice moves poses by centimetres: ranges that are 1e-9 off
# change none on this drive and 11 um, ranges that are 1e-6 off change some and 2 cm.
TOLERANCE_M, TOLERANCE_RAD = 0.001, 0.001


@functools.cache
def golden() -> GoldenLidarDrive:
    return GoldenLidarDrive.load()


def test_shipped_settings_correct_a_stored_drive_as_before() -> None:
    drive = golden()
    trajectory, update = corrected_scans(drive, SHIPPED)
    assert update.closed_loops > 0
    corrected_m = position_rmse(trajectory.poses_xyyaw, drive.truth)
    assert corrected_m < 0.5 * position_rmse(trajectory.odometry_xyyaw, drive.truth)
    distance_m, angle_rad = largest_difference(trajectory.poses_xyyaw, drive.poses)
    assert distance_m < TOLERANCE_M and angle_rad < TOLERANCE_RAD
    np.testing.assert_allclose(update.covariance, drive.covariance, rtol=0.05, atol=0.02 * drive.covariance.max())


@pytest.mark.parametrize(
    "changes",
    [
        {"odometry": {"odometry": {"key_distance_m": 0.33}}},
        {"odometry": {"points": {"spacing_m": 0.044}}},
        {"graph": {"loops": {"least_response": 0.495}}},
        {"graph": {"loops": {"submap_keys": 13}}},
    ],
    ids=["key scans", "points", "loops", "submaps"],
)
def test_a_stored_drive_tells_other_settings(changes: dict[str, Any], tmp_path: Path) -> None:
    """Settings that are a tenth larger or smaller than the shipped ones."""
    shipped = json.loads((SHIPPED / LIDAR_FILE).read_text())
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    (tmp_path / LIDAR_FILE).write_text(json.dumps({**shipped, **{k: {**shipped[k], **v} for k, v in changes.items()}}))
    trajectory, _ = corrected_scans(golden(), tmp_path)
    distance_m, angle_rad = largest_difference(trajectory.poses_xyyaw, golden().poses)
    assert distance_m > 2.0 * TOLERANCE_M or angle_rad > 2.0 * TOLERANCE_RAD


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / LIDAR_FILE).write_text((SHIPPED / LIDAR_FILE).read_text()[:-3])
    with pytest.raises(LidarFileError, match="is not JSON"):
        corrected_scans(golden(), tmp_path)
