"""`run_recording` on a lidar's CARMEN log: the weights are chosen by what is in it, and a map of the scans is drawn."""

import gzip
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.trajectory.files import read_tum
from tests.unit.ngo_estimator.mapping.test_map_files import read_by_nav2
from tests.unit.ngo_estimator.ray_casting import ROOM, cast

pytestmark = pytest.mark.processes

ROS2 = Path(__file__).parents[2] / "tools" / "ros2"
LEFT_OUT = ("gymnasium", "lightning", "networkx", "pymunk", "stable_baselines3", "torch", "tqdm", "vizdoom")
ANGLES = np.radians(np.arange(-90.0, 91.0))


# Compiles as `make build` does, runs the command, and prints what that compiled or loaded besides.
COMPILED_AHEAD = """
import sys
from numba.core.registry import CPUDispatcher
from ngo_estimator.offline import compile_ahead

def compiled():
    modules = [module for name, module in list(sys.modules.items()) if name.startswith("ngo_estimator")]
    found = {f for module in modules for f in vars(module).values() if isinstance(f, CPUDispatcher)}
    return {f"{f.__module__}.{f.__name__}{signature}" for f in found for signature in f.signatures}

compile_ahead.main([])
before = compiled()
from ngo_estimator.nodes import run_recording
run_recording.main()
print("compiled besides:", sorted(compiled() - before))
"""


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


def run(*words: object, python_path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A command whose Python looks into ``python_path`` first."""
    paths = [*([str(python_path)] if python_path else []), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "COLUMNS": "200", "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run([*map(str, words)], capture_output=True, text=True, timeout=170, env=environment)


def run_recording(*arguments: object, python_path: Path | None = None) -> subprocess.CompletedProcess[str]:
    return run(ROS2, "run", "ngo_estimator", "run_recording", *arguments, python_path=python_path)


@pytest.fixture
def for_lidar(tmp_path: Path) -> Path:
    """A folder that hides what `make venv FOR=lidar` leaves out, where Python looks into it first."""
    folder = tmp_path / "hidden"
    folder.mkdir()
    for name in LEFT_OUT:
        (folder / f"{name}.py").write_text(f"raise ModuleNotFoundError('hidden: {name}', name='{name}')\n")
    return folder


def test_nodes_of_a_lidar_need_no_networks(for_lidar: Path) -> None:
    modules = ("local_node", "lidar_input", "ngo_node", "ngo_map", "view_node", "run_recording", "recorded_output")
    lines = [f"import ngo_estimator.nodes.{module}" for module in (*modules, "join_sessions", "optimize_graph")]
    lines += [
        "from ngo_estimator.frontend.lidar.mixture_lidar import MixtureLidar",
        "from ngo_estimator.nodes.lidar_input import warm_up_odometry",
        "from ngo_estimator.nodes.run_recording import get_package_share_directory as share, Path",
        "from ngo_estimator.offline.lidar_run import LidarRun",
        "from ngo_estimator.offline.warm_up_scans import warm_up_scans",
        "from ngo_estimator.slam.scan_trajectory import ScanTrajectory",
        "from ngo_estimator.slam.session import Session",
        "warm_up_odometry(), warm_up_scans()",
        "folder = Path(share('ngo_estimator'), 'weights', 'scan')",
        "print(MixtureLidar.load(folder, 'scan'), ScanTrajectory.load(folder, 'scan'))",
    ]
    done = run(sys.executable, "-c", "\n".join(lines), python_path=for_lidar)
    assert done.returncode == 0 and "Trajectory" in done.stdout, done.stderr
    for node, options in (("local_node", ("-p", "world:=maze2d")), ("ngo_node", ("-p", "world:=maze3d"))):
        done = run(ROS2, "run", "ngo_estimator", node, "--ros-args", *options, python_path=for_lidar)
        assert done.returncode != 0 and "PyTorch is not installed" in done.stderr, done.stderr
        assert "Traceback" not in done.stderr


def test_a_carmen_log_without_named_weights(tmp_path: Path, for_lidar: Path) -> None:
    """The first time nothing is left to compile. The second time what a lidar does not need is not there."""
    log = tmp_path / "drive.clf.gz"
    true = carmen_log(log)
    outputs = []
    for name in ("first", "again"):
        if name == "first":
            done = run(sys.executable, "-c", COMPILED_AHEAD, log, "--out", tmp_path / name)
            assert "compiled besides: []" in done.stdout, done.stdout + done.stderr
        else:
            done = run_recording(log, "--out", tmp_path / name, python_path=for_lidar)
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


def test_images_without_pytorch_are_one_line(tmp_path: Path, for_lidar: Path) -> None:
    carmen_log(tmp_path / "drive.clf.gz")
    arguments = (tmp_path / "drive.clf.gz", "--world", "maze2d", "--out", tmp_path / "out")
    done = run_recording(*arguments, python_path=for_lidar)
    (line,) = done.stderr.strip().splitlines()
    assert done.returncode == 2 and "PyTorch is not installed: run make venv FOR=all" in line


def test_a_damaged_log_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "drive.clf").write_text("FLASER 181 1.0 2.0\n# nothing else\n")
    done = run_recording(tmp_path / "drive.clf", "--out", tmp_path / "out")
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1, done.stderr
