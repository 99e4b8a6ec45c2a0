"""The stored drives of lidars notice settings that are a tenth off, and files that are broken."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from ngo_estimator.data.lidar_file import LIDAR_FILE, LidarFileError
from tests.golden.lidar_drives import SHIPPED, GoldenLidarDrive
from tests.golden.net import scores_of
from tests.golden.noise_floor import floors, paths

LIDARS = [name for name in floors() if name.startswith("scan_")]


def leaves_the_floor(name: str, weights: Path) -> bool:
    drive = GoldenLidarDrive.load(name)
    return bool(floors()[name].left_by(scores_of(drive.run(weights), drive.true_poses, paths()[name])))


@pytest.mark.parametrize(
    "changes",
    [
        {"odometry": {"key_m": 0.33}},
        {"odometry": {"points": {"spacing_m": 0.044}}},
        {"graph": {"loops": {"submap_keys": 13}}},
    ],
    ids=["key scans", "points", "submaps"],
)
def test_stored_drives_tell_other_settings(changes: dict[str, Any], tmp_path: Path) -> None:
    """Settings that are a tenth larger or smaller than the shipped ones."""
    shipped = json.loads((SHIPPED / LIDAR_FILE).read_text())
    shutil.copytree(SHIPPED, tmp_path, dirs_exist_ok=True)
    (tmp_path / LIDAR_FILE).write_text(json.dumps({**shipped, **{k: {**shipped[k], **v} for k, v in changes.items()}}))
    steadiest_first = sorted(LIDARS, key=lambda name: floors()[name].spread("moved_m"))
    assert any(leaves_the_floor(name, tmp_path) for name in steadiest_first)


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / LIDAR_FILE).write_text((SHIPPED / LIDAR_FILE).read_text()[:-3])
    with pytest.raises(LidarFileError, match="is not JSON"):
        GoldenLidarDrive.load(LIDARS[0]).run(tmp_path)
