from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.scan_points import Mounting
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.data import lidar_drives
from training.data.lidar_drives import LidarDrive, TruePoses
from training.scoring.lidar_rows import ROWS, DriveRuns, Estimate, Row, changed, identity_of
from training.scoring.lidar_scores import DriveSource, score_drive

POSES = np.stack((np.arange(5.0), np.zeros(5), np.zeros(5)), axis=-1)
STAMPS = (1 + np.arange(5)) * 10**9


def drive() -> LidarDrive:
    scans = tuple(LidarScan(int(stamp), 0.0, 0.1, np.ones(5, np.float32), 0.0, 10.0, 0.0, "laser") for stamp in STAMPS)
    wheels = tuple(WheelPose(int(stamp), pose) for stamp, pose in zip(STAMPS, 1.5 * POSES, strict=True))
    return LidarDrive("straight", "straight", scans, wheels, Mounting(np.zeros(3)), TruePoses(STAMPS, POSES))


def source(has_wheels: bool = True) -> DriveSource:
    return DriveSource("straight", "straight", drive, (lidar_drives,), has_wheels)


def test_wheels_come_before_the_scan_of_the_same_stamp() -> None:
    kinds = [type(record).__name__ for record in drive().records()]
    assert kinds == ["WheelPose", "LidarScan"] * 5
    assert [type(record).__name__ for record in drive().records(with_wheels=False)] == ["LidarScan"] * 5


def test_a_row_is_estimated_once_for_settings_and_drive(tmp_path: Path) -> None:
    asked: list[str] = []

    def estimate(runs: DriveRuns) -> Estimate:
        asked.append(runs.drive.name)
        return Estimate(STAMPS, POSES + (0.0, 0.5, 0.0), facts={"loops": 3})

    weights = tmp_path / "weights"
    weights.mkdir()
    for settings in ({"a": 1}, {"a": 1}, {"a": 2}):
        rows = {"mine": Row(estimate, settings, code=())}
        ((name, scored),) = score_drive(source(), rows, weights, tmp_path / "cache")
        assert name == "mine"
        assert scored.errors["ate_m"] == pytest.approx([0.0], abs=1e-9)
        assert scored.errors["loops"] == pytest.approx([3.0])
        assert scored.path.shape == scored.truth.shape == (5, 3)
    assert asked == ["straight", "straight"]


def test_wheels_alone_are_as_wrong_as_they_are(tmp_path: Path) -> None:
    ((_, scored),) = score_drive(source(), {"wheels": ROWS["wheels"]}, tmp_path, tmp_path)
    assert scored.errors["position_rmse_m"] == pytest.approx([np.sqrt(np.mean((0.5 * np.arange(5)) ** 2))])


def test_a_row_that_needs_wheels_is_left_out_where_there_are_none(tmp_path: Path) -> None:
    assert list(score_drive(source(has_wheels=False), {"wheels": ROWS["wheels"]}, tmp_path, tmp_path)) == []


def test_a_failure_is_kept_in_words(tmp_path: Path) -> None:
    def estimate(runs: DriveRuns) -> Estimate:
        raise ValueError("no scan fits")

    for _ in range(2):
        ((_, scored),) = score_drive(source(), {"mine": Row(estimate, None, code=())}, tmp_path, tmp_path)
        assert scored.failed == "no scan fits"
        assert scored.errors == {}


def test_every_row_has_settings_of_its_own() -> None:
    ours = [identity_of(row.settings) for name, row in ROWS.items() if name.startswith(("ours", "without"))]
    assert len(set(ours)) == len(ours)


def test_a_change_goes_down_the_dots_and_an_unknown_name_is_an_error() -> None:
    from ngo_estimator.loops.scan_graph_config import ScanGraphConfig

    config = changed(ScanGraphConfig(), {"kernel": 7.0, "loops.least_agreeing": 0})
    assert (config.kernel, config.loops.least_agreeing) == (7.0, 0)
    assert ScanGraphConfig().kernel != 7.0
    with pytest.raises(TypeError):
        changed(ScanGraphConfig(), {"kernal": 7.0})
