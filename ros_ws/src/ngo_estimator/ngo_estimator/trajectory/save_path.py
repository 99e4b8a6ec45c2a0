"""Where a service may write: inside one folder, and never in place of anything but a file."""

import stat
from pathlib import Path


def path_inside(folder: Path, path: str) -> Path:
    """The file that ``path`` names, relative to ``folder`` or absolute, with all links resolved.

    Raises:
        ValueError: it lies outside of ``folder``, has ``..`` in it, or is there and no regular file.
    """
    found = _inside(folder, path, "file")
    check_replaceable(found)
    return found


def folder_inside(folder: Path, path: str) -> Path:
    """The folder that ``path`` names, in the same way; raises ``ValueError`` if it lies outside or has ``..`` in it."""
    return _inside(folder, path, "folder")


def _inside(folder: Path, path: str, kind: str) -> Path:
    try:
        given, inside = Path(path).expanduser(), folder.expanduser().resolve()
        found = (inside / given).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # an unknown user, links in a circle, a NUL
        raise ValueError(f"path is {path!r}, which is none ({' '.join(str(error).split())})") from None
    if ".." in given.parts or not found.is_relative_to(inside):
        raise ValueError(f"path is {path!r}; expected a {kind} in {inside} (parameter 'save_directory'), without '..'")
    return found


def check_replaceable(path: Path) -> None:
    """Raise ``ValueError`` where something is at ``path`` that is no regular file: a folder, link, pipe or device."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    except (OSError, ValueError) as error:
        raise ValueError(f"file is '{path}', which cannot be written ({error})") from None
    if not stat.S_ISREG(mode):
        raise ValueError(f"file is '{path}', which is there and no regular file; it is not replaced")
