import gzip
from pathlib import Path

import numpy as np
import pytest

from training.data.lidar_drives import ReferencePoses, Relations
from training.recordings.lidar_logs import log_drive, log_identity, logs_below, read_drive


def flaser(k: int, corrected: str = "") -> str:
    ranges = " ".join(["2.0"] * 180)
    pose = f"{0.1 * k:.2f} 0.0 0.0"
    return f"FLASER 180 {ranges} {corrected or pose} {pose} {100.0 + k:.3f} robot {float(k):.3f}\n"


def write_log(path: Path, corrected: bool = False) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    text = "".join(flaser(k, f"{0.2 * k:.2f} {0.05 * k * k:.2f} 0.1" if corrected else "") for k in range(8))
    with gzip.open(path, "wt") as stream:
        stream.write(text)
    return path


def test_logs_are_found_by_their_names(tmp_path: Path) -> None:
    write_log(tmp_path / "a.clf.gz")
    write_log(tmp_path / "below" / "b-c.log.gz")
    (tmp_path / "a.relations").write_text("")
    assert {name: path.name for name, path in logs_below(tmp_path).items()} == {"a": "a.clf.gz", "b-c": "b-c.log.gz"}


def test_relations_beside_a_log_are_its_reference(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.clf.gz")
    assert read_drive(path).reference is None
    with pytest.raises(ValueError, match="neither"):
        log_drive(path)
    before = log_identity(path)
    (tmp_path / "a.relations").write_text("100.0 102.0 0.2 0 0 0 0 0.5\n")
    drive = log_drive(path)
    assert isinstance(drive.reference, Relations)
    assert drive.reference.relative_xyyaw.tolist() == [[0.2, 0.0, 0.5]]
    assert (len(drive.scans), len(drive.wheels)) == (8, 8)
    assert log_identity(path) != before
    assert str(tmp_path) not in drive.identity


def test_poses_of_a_mapper_are_the_reference_where_there_are_no_relations(tmp_path: Path) -> None:
    drive = log_drive(write_log(tmp_path / "b.log.gz", corrected=True))
    assert isinstance(drive.reference, ReferencePoses)
    np.testing.assert_allclose(drive.reference.poses_xyyaw[2], (0.4, 0.2, 0.1), atol=1e-9)
    assert drive.reference.stamps_ns.tolist() == [scan.stamp_ns for scan in drive.scans]


def test_relations_of_another_form_are_refused(tmp_path: Path) -> None:
    path = write_log(tmp_path / "a.clf.gz")
    (tmp_path / "a.relations").write_text("100.0 102.0 0.2 0 0.5\n")
    with pytest.raises(ValueError, match="5 columns"):
        log_drive(path)
