"""Trajectory files: what others read from them, and that they are written at once or not at all."""

from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from ngo_estimator.trajectory_file import write_tum

STAMPS_NS = np.array([0, 1_700_000_000_057_142_857, 1_700_000_000_114_285_714], dtype=np.int64)
POSES = np.array([[0.0, 0.0, 0.0], [1.25, -0.5, 0.5 * np.pi], [1.5, 2.0, -3.0]])


@pytest.mark.parametrize("name", ["path.tum", "path.txt"])
def test_evo_reads_what_was_written(tmp_path: Path, name: str) -> None:
    write_tum(tmp_path / name, STAMPS_NS, POSES)
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / name))
    np.testing.assert_allclose(trajectory.timestamps, STAMPS_NS / 1e9)
    np.testing.assert_allclose(trajectory.positions_xyz, np.column_stack((POSES[:, :2], np.zeros(3))), rtol=1e-8)
    yaw = 2.0 * np.arctan2(trajectory.orientations_quat_wxyz[:, 3], trajectory.orientations_quat_wxyz[:, 0])
    np.testing.assert_allclose(np.cos(yaw - POSES[:, 2]), 1.0)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_stamps_keep_every_nanosecond(tmp_path: Path) -> None:
    write_tum(tmp_path / "path.tum", STAMPS_NS, POSES)
    stamps = [line.split()[0] for line in (tmp_path / "path.tum").read_text().splitlines()]
    assert stamps == ["0.000000000", "1700000000.057142857", "1700000000.114285714"]


def test_other_endings_and_empty_trajectories_are_errors(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"path\.csv'; allowed: a name that ends in \.tum or \.txt"):
        write_tum(tmp_path / "path.csv", STAMPS_NS, POSES)
    with pytest.raises(ValueError, match="empty"):
        write_tum(tmp_path / "path.tum", STAMPS_NS[:0], POSES[:0])
    with pytest.raises(FileNotFoundError):
        write_tum(tmp_path / "nowhere" / "path.tum", STAMPS_NS, POSES)
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "path.tum"
    write_tum(path, STAMPS_NS, POSES)
    before = path.read_text()

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_tum(path, STAMPS_NS[:1], POSES[:1])
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]
