"""Keeping processes on chosen cores."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, TypeVar

Result = TypeVar("Result")


def two_cores() -> tuple[int, int]:
    """The core that is measured and the one beside it; raises ``ValueError`` where there is only one."""
    cores = sorted(os.sched_getaffinity(0))
    if len(cores) < 2:
        raise ValueError(f"this process may run on the cores {cores}; expected two or more")
    return cores[-1], cores[-2]


@contextlib.contextmanager
def running_on(*cores: int) -> Iterator[None]:
    """Keep this thread, and the processes that it starts meanwhile with one thread to compute with, on some cores."""
    before, threads = os.sched_getaffinity(0), os.environ.get("OMP_NUM_THREADS")
    os.sched_setaffinity(0, cores)
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)
        if threads is None:
            del os.environ["OMP_NUM_THREADS"]
        else:
            os.environ["OMP_NUM_THREADS"] = threads


def in_process(core: int, function: Callable[..., Result], *arguments: Any) -> Result:
    """Call a function in a new process of its own on one core."""
    with running_on(core), ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()
