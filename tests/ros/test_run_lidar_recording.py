"""`run_recording` on a lidar's CARMEN log: the weights are chosen by what is in it, and a map of the scans is drawn."""

import gzip
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.trajectory.files import read_tum
from tests.unit.ngo_estimator.mapping.test_map_files import read_by_nav2
from tests.unit.ngo_estimator.ray_casting import ROOM, cast

pytestmark = pytest.mark.processes

ROS2 = Path(__file__).parents[2] / "tools" / "ros2"
ANGLES = np.radians(np.arange(-90.0, 91.0))


def carmen_log(path: Path) -> np.ndarray:
    """A gzipped log of a drive, whose wheels count 4 % too much; returns the true poses ``(80, 3)``."""
    noise, poses, lines = np.random.default_rng(0), [np.array((1.0, 1.0, 0.2))], []
    for k in range(80):
        ranges = cast(ROOM, poses[-1], ANGLES) + noise.normal(0.0, 0.005, len(ANGLES))
        odometry = between(poses[0], poses[-1]) * (1.04, 1.04, 1.0)
        x, y, yaw = odometry
        stamp = f"{1000.0 + 0.1 * k:.6f} robot {0.1 * k:.6f}"
        lines.append(f"ODOM {x:.6f} {y:.6f} {yaw:.6f} 0 0 0 {stamp}")
        pose = f"{x:.6f} {y:.6f} {yaw:.6f}"
        lines.append(f"FLASER 181 {' '.join(f'{r:.3f}' for r in ranges)} {pose} {pose} {stamp}")
        poses.append(compose(poses[-1], np.array((0.06, 0.0, 0.03))))
    path.write_bytes(gzip.compress(("\n".join(lines) + "\n").encode()))
    return np.array(poses[:-1])


def run_recording(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [str(ROS2), "run", "ngo_estimator", "run_recording", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=170, env={**os.environ, "COLUMNS": "200"})


def test_a_carmen_log_without_named_weights(tmp_path: Path) -> None:
    true = carmen_log(tmp_path / "drive.clf.gz")
    outputs = []
    for name in ("first", "again"):
        done = run_recording(tmp_path / "drive.clf.gz", "--out", tmp_path / name)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Traceback" not in done.stderr and "wheel" in done.stdout
        outputs.append([(tmp_path / name / file).read_bytes() for file in ("corrected.tum", "map.pgm", "map.yaml")])
    assert outputs[0] == outputs[1]
    said = json.loads((tmp_path / "first" / "run.json").read_text())
    assert said["weights"] == "scan" and said["frames"] == 80 and said["faults"] == 0 and not said["not_used"]
    path = read_tum(tmp_path / "first" / "corrected.tum")
    moved = np.array([between(true[0], pose) for pose in true])
    assert len(path.positions_xyz) == 80
    assert np.abs(path.positions_xyz[:, :2] - moved[:, :2]).max() < 0.05  # the wheels are 0.1 m off
    cells, facts = read_by_nav2(tmp_path / "first" / "map.yaml")
    room = (cells == 0).sum() * facts["resolution"] ** 2
    assert 20.0 < room < 36.0, "the room has 36 m2, and no wall is seen through"
    picture = (tmp_path / "first" / "plot.png").read_bytes()
    width, height = (int.from_bytes(picture[at : at + 4], "big") for at in (16, 20))
    assert picture.startswith(b"\x89PNG") and width > 2.2 * height  # a panel each: odometry, corrected, walls


def test_a_damaged_log_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "drive.clf").write_text("FLASER 181 1.0 2.0\n# nothing else\n")
    done = run_recording(tmp_path / "drive.clf", "--out", tmp_path / "out")
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
