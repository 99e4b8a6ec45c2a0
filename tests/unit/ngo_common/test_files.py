"""Files are read where they are files, and written whole or not at all."""

import os
from pathlib import Path

import pytest

from ngo_common.files import folder_whole, read_file, write_together, write_whole, written_whole


def test_only_files_are_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"content")
    (tmp_path / "link").symlink_to("a")
    os.mkfifo(tmp_path / "pipe")
    assert read_file(tmp_path / "a") == read_file(tmp_path / "link") == b"content"
    for name in ("pipe", ""):
        with pytest.raises(OSError, match="it is no regular file"):
            read_file(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        read_file(tmp_path / "nowhere")


def test_a_file_comes_whole_or_stays_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_text("old")
    with pytest.raises(FileNotFoundError), written_whole(path) as file:
        file.write_text("half") and file.with_name("nowhere").rename(file)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
    with written_whole(path) as file:
        assert file.suffix == ".png"
        file.write_text("new")
    assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("there", [True, False])
def test_a_folder_comes_whole_or_stays_as_it_was(tmp_path: Path, there: bool) -> None:
    out = tmp_path / "a" / "out"
    if there:
        out.mkdir(parents=True)
        (out / "one").write_text("old")
    with pytest.raises(FileNotFoundError), folder_whole(out) as folder:
        (folder / "one").write_text("half") and (folder / "nowhere").rename(folder / "two")
    assert out.exists() == there
    if there:
        assert [path.name for path in out.iterdir()] == ["one"] and (out / "one").read_text() == "old"
    with folder_whole(out) as folder:
        (folder / "one").write_text("new")
        (folder / "part2").mkdir()
        (folder / "part2" / "two").write_text("new")
    assert sorted(path.relative_to(out).as_posix() for path in out.rglob("*")) == ["one", "part2", "part2/two"]
    assert (out / "one").read_text() == "new"


@pytest.mark.parametrize("content", ["text", b"text", [b"te", b"xt"]])
def test_files_come_together_or_stay_as_they_were(
    tmp_path: Path, content: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    assert write_together({one: content, two: content}) == [one, two]
    assert one.read_text() == two.read_text() == "text" and one.stat().st_mode & 0o777 == 0o644
    two.unlink(), two.mkdir()
    with pytest.raises(IsADirectoryError, match=str(two)):
        write_together({one: "other", two: "other"})
    monkeypatch.setattr(os, "fsync", _full)
    with pytest.raises(OSError, match=f"No space left on device: '{one}'"):
        write_whole(one, "other")
    assert one.read_text() == "text" and sorted(tmp_path.iterdir()) == [one, two]


def _full(_: int) -> None:
    raise OSError(28, "No space left on device")
