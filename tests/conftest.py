"""Gives each process of a test run a ROS 2 domain of its own, and removes what killed processes leave behind."""

import contextlib
import ctypes
import fcntl
import os
import signal
import tempfile
import time
from pathlib import Path
from typing import IO

import pytest

from demo.graph import FIRST_FREE_DOMAIN

SHARED_MEMORY = Path("/dev/shm")
# 0 is what people use by hand. Those above are for `demo.graph`, which takes an idle one, as ours are at times.
DOMAINS = range(1, FIRST_FREE_DOMAIN)


def claim_domain() -> tuple[int, IO[str]]:
    """A domain that no other process of tests on this machine uses, and the lock that keeps it."""
    for offset in range(len(DOMAINS)):
        domain = DOMAINS[(os.getpid() + offset) % len(DOMAINS)]
        path = Path(tempfile.gettempdir()) / f"ngo_test_domain_{domain}.lock"
        try:
            lock = path.open("w")
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            continue
        return domain, lock
    raise RuntimeError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use by other processes of tests")


# Before any test module imports rclpy: children inherit both.
_domain, _domain_lock = claim_domain()
os.environ["ROS_DOMAIN_ID"] = str(_domain)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

# Processes that run tests side by side share the cores. Before any module imports torch.
os.environ.setdefault("OMP_NUM_THREADS", "1")


# A shell that runs this in the background hands over an ignored SIGINT, which children would inherit.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Linux's prctl: a grandchild whose parent has died becomes this process's child, so that it can be ended. A killed
# maze3d leaves the ViZDoom that it started, which keeps the locks on Fast DDS's ports that it has inherited.
PR_SET_CHILD_SUBREAPER = 36
ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def children() -> set[int]:
    """Process ids of this process's children, adopted ones included."""
    found: set[int] = set()
    for task in Path("/proc/self/task").iterdir():
        found.update(int(pid) for pid in (task / "children").read_text().split())
    return found


def end_leftover_children(before: set[int]) -> None:
    """Kill and collect every child that has come since `before`."""
    for pid in children() - before:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def shared_memory_files() -> set[Path]:
    """Files of Fast DDS and of ViZDoom in shared memory."""
    patterns = ("fastrtps_*", "sem.fastrtps_*", "ViZDoom*")
    return {path for pattern in patterns for path in SHARED_MEMORY.glob(pattern)}


def files_in_use() -> set[str]:
    """Names of the files in shared memory that a living process has mapped or open."""
    used: set[str] = set()
    for process in Path("/proc").glob("[0-9]*"):
        try:
            maps = (process / "maps").read_text()
            opened = [os.readlink(descriptor) for descriptor in (process / "fd").iterdir()]
        except OSError:  # it has just ended, or it is another user's, whose files are left alone anyway
            continue
        for line in [*maps.splitlines(), *opened]:
            if "/dev/shm/" in line:
                used.add(line.partition("/dev/shm/")[2])
    return used


def remove_orphans(before: set[Path]) -> list[Path]:
    """Remove the shared memory files that came since `before` and that no living process uses."""
    now = time.time()
    used = files_in_use()
    removed = []
    for path in shared_memory_files() - before:
        try:
            status = path.stat()
            # A file this young may belong to a process that has not mapped it yet.
            if path.name in used or status.st_uid != os.getuid() or now - status.st_mtime < 1.0:
                continue
            path.unlink()
        except FileNotFoundError:
            continue
        removed.append(path)
    return removed


_CHILDREN = pytest.StashKey[set[int]]()
_FILES = pytest.StashKey[set[Path]]()


def pytest_configure(config: pytest.Config) -> None:
    """Note what was there before this run."""
    config.stash[_CHILDREN] = children()
    # With `-n` the workers' parent alone removes files, when the last worker has ended: what one does not use yet, for
    # its nodes are about to start, must not be removed by another.
    if "PYTEST_XDIST_WORKER" not in os.environ:
        config.stash[_FILES] = shared_memory_files()


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove what the killed processes of this run leave: their own children, and files in shared memory."""
    end_leftover_children(config.stash[_CHILDREN])
    if _FILES in config.stash:
        remove_orphans(config.stash[_FILES])
