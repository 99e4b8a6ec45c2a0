"""Trajectories as text files in the TUM format, which evo and others read."""

import os
import tempfile
from pathlib import Path

import numpy as np

ENDINGS = (".tum", ".txt")
_NS = 1_000_000_000


def write_tum(path: Path, stamps_ns: np.ndarray, poses_xyyaw: np.ndarray) -> None:
    """Write one line a pose, ``timestamp tx ty tz qx qy qz qw`` (s, m), all at once or not at all.

    Args:
        path: a file ending in one of ``ENDINGS``, in a folder that exists.
        stamps_ns: ``(frames,)`` int64.
        poses_xyyaw: ``(frames, 3)``.

    Raises:
        ValueError: another ending, or no pose to write.
        OSError: the file cannot be written.
    """
    if path.suffix not in ENDINGS:
        raise ValueError(f"file is '{path}'; allowed: a name that ends in {' or '.join(ENDINGS)}")
    if len(stamps_ns) == 0:
        raise ValueError("the trajectory is empty; nothing was written")
    half_yaw = 0.5 * poses_xyyaw[:, 2]
    zero = np.zeros_like(half_yaw)
    values = np.column_stack((poses_xyyaw[:, :2], zero, zero, zero, np.sin(half_yaw), np.cos(half_yaw)))
    # Stamps of today have 19 digits in ns, more than a float64 holds: seconds and nanoseconds are written as
    # integers.
    lines = [
        f"{stamp // _NS}.{stamp % _NS:09d} " + " ".join(f"{value:.9g}" for value in row)
        for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True)
    ]
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w") as file:
            file.write("\n".join(lines) + "\n")
        os.chmod(temporary, 0o644)  # mkstemp's own 0600 would hide the result from others
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
