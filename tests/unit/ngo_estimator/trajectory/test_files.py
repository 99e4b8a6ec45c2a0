"""Trajectories as files: names that are taken, TUM and KITTI as others read them."""

import os
import socket
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface

from ngo_estimator.trajectory.files import SpatialPoses, read_tum, write_trajectory
from ngo_estimator.trajectory.save_path import path_inside

STAMPS_NS = np.array([0, 1_700_000_000_057_142_857, 1_700_000_000_114_285_714], dtype=np.int64)
POSES = np.array([[0.0, 0.0, 0.0], [1.25, -0.5, 0.5 * np.pi], [1.5, 2.0, -3.0]])


@pytest.mark.parametrize("name", ["path.tum", "path.txt"])
def test_evo_reads_tum(tmp_path: Path, name: str) -> None:
    assert write_trajectory(tmp_path / name, STAMPS_NS, POSES) == [tmp_path / name]
    trajectory = file_interface.read_tum_trajectory_file(str(tmp_path / name))
    np.testing.assert_allclose(trajectory.timestamps, STAMPS_NS / 1e9)
    np.testing.assert_array_equal(trajectory.positions_xyz, np.column_stack((POSES[:, :2], np.zeros(3))))
    yaw = 2.0 * np.arctan2(trajectory.orientations_quat_wxyz[:, 3], trajectory.orientations_quat_wxyz[:, 0])
    np.testing.assert_allclose(np.cos(yaw - POSES[:, 2]), 1.0)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_tum_stamps_keep_every_nanosecond(tmp_path: Path) -> None:
    write_trajectory(tmp_path / "path.tum", STAMPS_NS, POSES)
    stamps = [line.split()[0] for line in (tmp_path / "path.tum").read_text().splitlines()]
    assert stamps == ["0.000000000", "1700000000.057142857", "1700000000.114285714"]


def test_evo_reads_kitti_and_the_times_lie_beside(tmp_path: Path) -> None:
    files = write_trajectory(tmp_path / "path.kitti", STAMPS_NS, POSES)
    assert files == [tmp_path / "path.times.txt", tmp_path / "path.kitti"] and set(tmp_path.iterdir()) == set(files)
    poses = file_interface.read_kitti_poses_file(str(tmp_path / "path.kitti")).poses_se3
    for matrix, (x, y, yaw) in zip(poses, POSES, strict=True):
        cos, sin = np.cos(yaw), np.sin(yaw)
        expected = [[cos, -sin, 0.0, x], [sin, cos, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
        np.testing.assert_allclose(matrix, expected, atol=1e-15)
    np.testing.assert_allclose(np.loadtxt(tmp_path / "path.times.txt"), STAMPS_NS / 1e9)


def test_tum_is_read_back_exactly(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = np.column_stack((rng.normal(0.0, 100.0, (50, 2)), rng.uniform(-np.pi, np.pi, 50)))
    stamps_ns = 1_700_000_000_000_000_001 + np.arange(50) * 57_142_857
    write_trajectory(tmp_path / "path.tum", stamps_ns, poses)
    read = read_tum(tmp_path / "path.tum")
    np.testing.assert_array_equal(read.stamps_ns, stamps_ns)
    np.testing.assert_array_equal(read.planar()[:, :2], poses[:, :2])
    np.testing.assert_allclose(read.planar()[:, 2], poses[:, 2], atol=1e-15)
    np.testing.assert_allclose(read.quaternions_xyzw, SpatialPoses.from_planar(stamps_ns, poses).quaternions_xyzw)


def test_tum_of_others_is_read(tmp_path: Path) -> None:
    path = tmp_path / "other.txt"
    path.write_text("\ufeff# a comment\n\n1.5e0 1 2 3 0 0 0.5 0.5\n 2.000000001\t1 2 3 0.5 0.5 0.5 0.5\n")
    read = read_tum(path)
    assert read.stamps_ns.tolist() == [1_500_000_000, 2_000_000_001] and len(read) == 2
    np.testing.assert_allclose(np.linalg.norm(read.quaternions_xyzw, axis=1), 1.0)
    # Half a turn and a third about all axes: x forward becomes y.
    np.testing.assert_allclose(read.planar(), [[1.0, 2.0, 0.5 * np.pi], [1.0, 2.0, 0.5 * np.pi]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 0 0 0 0 0 1\n", "line 1 has 7 numbers; expected 8"),
        ("# c\n1 0 0 0 0 0 0 x\n", "line 2 is '1 0 0 0 0 0 0 x'; expected numbers"),
        ("1 0 0 nan 0 0 0 1\n", "expected 8 that are finite"),
        ("inf 0 0 0 0 0 0 1\n", "expected 8 that are finite"),
        ("1 0 0 0 0 0 0 0\n", "orientation 0 0 0 0"),
        ("1 0 0 0 0 0 0 1\n1.0 0 0 0 0 0 0 1\n", "line 2 has the stamp 1.0; expected one later"),
        ("# nothing\n", "has no poses"),
        ("1e999999999 0 0 0 0 0 0 1\n", "stamp 1e999999999; expected seconds from 0 to 9223372036"),
        ("-1 0 0 0 0 0 0 1\n", "stamp -1; expected seconds from 0"),
        ("9223372037 0 0 0 0 0 0 1\n", "stamp 9223372037; expected seconds"),
        ("1 0 0 0 1e300 1e300 0 1\n", "orientation 1e300 1e300 0 1; expected"),
    ],
)
def test_what_is_not_tum_is_an_error_that_names_the_line(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bad.tum").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_tum(tmp_path / "bad.tum")


def test_other_endings_and_empty_trajectories_are_errors(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"path\.csv'; allowed: a name that ends in \.tum, \.txt or \.kitti"):
        write_trajectory(tmp_path / "path.csv", STAMPS_NS, POSES)
    with pytest.raises(ValueError, match="empty"):
        write_trajectory(tmp_path / "path.tum", STAMPS_NS[:0], POSES[:0])
    with pytest.raises(ValueError, match="expected as many"):
        write_trajectory(tmp_path / "path.tum", STAMPS_NS[:2], POSES)
    with pytest.raises(FileNotFoundError):
        write_trajectory(tmp_path / "nowhere" / "path.tum", STAMPS_NS, POSES)
    assert not list(tmp_path.iterdir())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    inside = tmp_path / "inside"
    inside.mkdir()
    return inside


def test_names_and_absolute_paths_inside_are_taken(folder: Path) -> None:
    (folder / "runs").mkdir()
    assert path_inside(folder, "a.tum") == folder / "a.tum"
    assert path_inside(folder, "runs/a.tum") == path_inside(folder, str(folder / "runs" / "a.tum"))
    (folder / "link").symlink_to("runs")
    assert path_inside(folder, "link/a.tum") == folder / "runs" / "a.tum"
    (folder / "runs" / "b.tum").touch()
    (folder / "b.tum").symlink_to("runs/b.tum")
    assert path_inside(folder, "b.tum") == folder / "runs" / "b.tum", "the link stays"


def test_the_folder_itself_may_be_behind_a_link_or_a_home(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder.parent / "link").symlink_to(folder)
    assert path_inside(folder.parent / "link", "a.tum") == folder / "a.tum"
    monkeypatch.setenv("HOME", str(folder))
    assert path_inside(Path("~"), "~/a.tum") == folder / "a.tum"
    monkeypatch.chdir(folder)
    assert path_inside(Path(""), "a.tum") == folder / "a.tum"


@pytest.mark.parametrize("path", ["../a.tum", "runs/../../a.tum", "runs/../a.tum", "/a.tum", "out/a.tum", "a.tum", ""])
def test_what_leads_out_is_refused(folder: Path, path: str) -> None:
    (folder / "runs").mkdir()
    (folder / "out").symlink_to(folder.parent)
    (folder / "a.tum").symlink_to("../a.tum")
    with pytest.raises(ValueError, match=r"expected a file in|no regular file"):
        path_inside(folder, path)


@pytest.mark.parametrize("path", ["~nosuchuser/a.tum", "a\0.tum", "loop/a.tum", "x" * 5000])
def test_what_is_no_path_is_one_line(folder: Path, path: str) -> None:
    (folder / "loop").symlink_to("loop")
    with pytest.raises(ValueError, match=r"path is|file is") as error:
        path_inside(folder, path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["pipe", "socket", "folder", "link"])
def test_what_is_no_file_is_never_replaced(folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder / "a.tum"
    monkeypatch.chdir(folder)
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind("a.tum")
    elif kind == "folder":
        path.mkdir()
    else:
        path.symlink_to("nowhere")
    before = path.lstat()
    if kind != "link":
        with pytest.raises(ValueError, match="no regular file; it is not replaced"):
            path_inside(folder, "a.tum")
    with pytest.raises(ValueError, match="no regular file; it is not replaced"):
        write_trajectory(path, np.array([1]), np.zeros((1, 3)))
    assert path.lstat() == before and list(folder.iterdir()) == [path]


def test_stamps_beside_kitti_poses_replace_no_link(folder: Path) -> None:
    (folder / "a.times.txt").symlink_to("../elsewhere")
    with pytest.raises(ValueError, match=r"a\.times\.txt', which is there and no regular file"):
        write_trajectory(folder / "a.kitti", np.array([1]), np.zeros((1, 3)))
    assert not (folder / "a.kitti").exists()
