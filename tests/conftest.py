"""Gives each test run a ROS 2 domain of its own, and removes what its killed processes leave in shared memory."""

import fcntl
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

SHARED_MEMORY = Path("/dev/shm")
# Above 101 the ports of a domain meet those that Linux hands out to others; 0 is what people use by hand.
DOMAINS = range(1, 102)


def claim_domain() -> tuple[int, IO[str]]:
    """A domain that no other test run on this machine uses, and the lock that keeps it."""
    for offset in range(len(DOMAINS)):
        domain = DOMAINS[(os.getpid() + offset) % len(DOMAINS)]
        path = Path(tempfile.gettempdir()) / f"ngo_test_domain_{domain}.lock"
        try:
            lock = path.open("w")
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            continue
        return domain, lock
    raise RuntimeError(f"all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are in use by other test runs")


# Before any test module imports rclpy: children inherit both.
_domain, _domain_lock = claim_domain()
os.environ["ROS_DOMAIN_ID"] = str(_domain)
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"


def transport_files() -> set[Path]:
    """Fast DDS's files in shared memory."""
    return {*SHARED_MEMORY.glob("fastrtps_*"), *SHARED_MEMORY.glob("sem.fastrtps_*")}


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
    """Remove the transport files that came since `before` and that no living process uses."""
    now = time.time()
    used = files_in_use()
    removed = []
    for path in transport_files() - before:
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


@pytest.fixture(scope="session", autouse=True)
def clean_shared_memory() -> Iterator[None]:
    """`kill -9` leaves Fast DDS's files behind, and tests kill processes: remove what this run's have left."""
    before = transport_files()
    yield
    remove_orphans(before)
