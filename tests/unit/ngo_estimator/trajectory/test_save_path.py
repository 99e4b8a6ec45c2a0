"""A service writes inside one folder, through no link that leads out of it, and in place of files alone."""

import os
import socket
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.trajectory.files import write_trajectory
from ngo_estimator.trajectory.save_path import path_inside


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
