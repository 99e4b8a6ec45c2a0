from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring.lidar_rows import ROWS, DriveRuns, Estimate, Row, changed, identity_of
from training.scoring.lidar_scores import scored, scored_rows

POSES = np.stack((np.arange(5.0), np.zeros(5), np.zeros(5)), axis=-1)
STAMPS = (1 + np.arange(5)) * 10**9


def drive() -> LidarDrive:
    scans = tuple(LidarScan(int(stamp), 0.0, 0.1, np.ones(5, np.float32), 0.0, 10.0, 0.0, "laser") for stamp in STAMPS)
    wheels = tuple(WheelPose(int(stamp), pose) for stamp, pose in zip(STAMPS, 1.5 * POSES, strict=True))
    return LidarDrive("straight", "straight", scans, wheels, Mounting(np.zeros(3)), TruePoses(STAMPS, POSES))


def test_errors_and_what_is_drawn_of_an_estimate(tmp_path: Path) -> None:
    def estimate(_: DriveRuns) -> Estimate:
        return Estimate(STAMPS, POSES + (0.0, 0.5, 0.0), facts={"loops": 3})

    measured = scored(DriveRuns(drive(), tmp_path), Row(estimate, {"a": 1}, code=()))
    assert measured.errors["ate_m"] == pytest.approx([0.0], abs=1e-9)
    assert measured.errors["loops"] == pytest.approx([3.0])
    assert measured.drawn["path"].shape == measured.drawn["truth"].shape == (5, 3)


def test_a_row_that_needs_wheels_says_that_there_are_none(tmp_path: Path) -> None:
    without = replace(drive(), wheels=())
    assert scored(DriveRuns(without, tmp_path), ROWS["wheels"]).failed == "straight has no wheel odometry"


def test_a_failure_is_kept_in_words(tmp_path: Path) -> None:
    def estimate(_: DriveRuns) -> Estimate:
        raise ValueError("no scan fits")

    measured = scored(DriveRuns(drive(), tmp_path), Row(estimate, None, code=()))
    assert measured.failed == "no scan fits"
    assert measured.errors == {}


def test_rows_of_our_own_follow_from_the_settings_files(tmp_path: Path) -> None:
    def identities() -> dict[str, str]:
        return {name: row.identity for name, row in scored_rows(ROWS, tmp_path).items()}

    (tmp_path / "lidar.json").write_text("{}")
    before = identities()
    (tmp_path / "lidar.json").write_text("{} ")
    changed_rows = {name for name, identity in identities().items() if identity != before[name]}
    assert "ours" in changed_rows and "gtsam_lm" in changed_rows
    assert not changed_rows & {"wheels", "kiss_icp"}


def test_every_row_has_settings_of_its_own() -> None:
    ours = [identity_of(row.settings) for name, row in ROWS.items() if name.startswith(("ours", "without"))]
    assert len(set(ours)) == len(ours)


def test_a_change_goes_down_the_dots_and_an_unknown_name_is_an_error() -> None:
    from ngo_estimator.loops.scan_settings import ScanGraphConfig

    config = changed(ScanGraphConfig(), {"kernel": 7.0, "loops.least_agreeing": 0})
    assert (config.kernel, config.loops.least_agreeing) == (7.0, 0)
    assert ScanGraphConfig().kernel != 7.0
    with pytest.raises(TypeError):
        changed(ScanGraphConfig(), {"kernal": 7.0})
