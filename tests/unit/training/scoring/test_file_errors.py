"""The report about files: right numbers, in a table and as JSON, and a clear word about what it cannot measure."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.trajectory.errors import RelativeDelta
from ngo_estimator.trajectory.files import write_tum
from ngo_estimator.trajectory.report import ReportSettings
from training.evaluate import Arguments, command_line
from training.scoring.file_errors import evaluate_files
from training.scoring.metrics import path_length_m, trajectory_error

STAMPS_NS = 10**9 + np.arange(300) * 10**8


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """A drive of 60 m in steps of 0.2 m around a circle, and two estimates that begin elsewhere."""
    angle = 0.2 * np.arange(300) / 5.0
    truth = np.column_stack((5.0 * np.sin(angle), -5.0 * np.cos(angle), angle))
    drift = np.random.default_rng(0).normal(0.0, [0.01, 0.01, 0.002], (300, 3)).cumsum(axis=0)
    poses = {"truth": truth, "odometry": truth + drift - [0.0, -5.0, 0.0], "corrected": truth + 0.1 * drift}
    paths = {name: tmp_path / f"{name}.tum" for name in poses}
    for name, path in paths.items():
        count = 280 if name == "corrected" else 300
        write_tum(path, STAMPS_NS[:count], poses[name][:count])
        np.save(tmp_path / f"{name}.npy", poses[name])
    return paths


def test_each_estimate_has_its_column(files: dict[str, Path], capsys: pytest.CaptureFixture[str]) -> None:
    settings = ReportSettings(delta=RelativeDelta(2.0, "metres"), segment_lengths_m=(10.0, 20.0, 100.0))
    reports = evaluate_files([files["odometry"], files["corrected"]], files["truth"], settings)
    assert list(reports) == ["odometry", "corrected"]
    odometry, corrected = reports.values()
    truth, estimate = (np.load(files[name].with_suffix(".npy")) for name in ("truth", "odometry"))
    expected = trajectory_error(estimate, truth)
    assert odometry["ate"]["first"]["translation_m"]["rmse"] == pytest.approx(expected.position_rmse_m)
    assert odometry["ate"]["first"]["rotation_deg"]["rmse"] == pytest.approx(expected.heading_rmse_deg)
    assert odometry["final_percent"] == pytest.approx(expected.final_percent)
    assert odometry["path_m"] == pytest.approx(path_length_m(truth)) and odometry["poses"] == 300
    for how in ("first", "best"):
        assert corrected["ate"][how]["translation_m"]["rmse"] < odometry["ate"][how]["translation_m"]["rmse"] / 3
    assert odometry["ate"]["none"]["translation_m"]["rmse"] > 4.5
    assert corrected["poses"] == 280
    # A start at every tenth frame, an end 51 or 101 frames later.
    assert odometry["kitti"]["segments"] == {"10": 25, "20": 20, "100": 0}
    printed = capsys.readouterr().out
    assert json.loads(printed.splitlines()[-1]) == reports
    assert "KITTI segments of 10, 20 m, %" in printed and "RPE over 2 metres" in printed
    assert "KITTI: the path is too short for segments of 100 m" in printed


def test_poses_without_partner_are_said(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stamps_ns = STAMPS_NS[:100] + np.where(np.arange(100) < 30, 50_000_000, 0)
    write_tum(tmp_path / "late.tum", stamps_ns, np.load(tmp_path / "odometry.npy")[:100])
    assert evaluate_files([tmp_path / "late.tum"], files["truth"])["late"]["poses"] == 70
    assert "late: 30 poses have no partner in time" in capsys.readouterr().out


def test_the_command_line_says_in_one_line_what_is_wrong(
    files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    still = tmp_path / "still.tum"
    write_tum(still, STAMPS_NS, np.zeros((300, 3)))
    command = ["--estimate", str(files["odometry"]), "--truth", str(still)]
    run = subprocess.run([sys.executable, "-m", "training.evaluate", *command], capture_output=True, text=True)
    assert (run.returncode, len(run.stderr.splitlines())) == (2, 1), run.stderr
    assert f"{files['odometry']}: the truth has no length" in run.stderr
    monkeypatch.setattr(sys, "argv", ["evaluate", "--estimate", str(tmp_path / "nowhere.tum"), *command[2:]])
    assert command_line() == 2
    assert "No such file" in capsys.readouterr().err


def test_a_world_and_files_exclude_each_other() -> None:
    file = Path("a.tum")
    for given in ({}, {"world": "maze2d", "estimate": (file,)}, {"estimate": (file,)}, {"truth": file}):
        with pytest.raises(ValueError, match="one of --world, --data FILES, or --estimate"):
            Arguments(**given)  # type: ignore[arg-type]
