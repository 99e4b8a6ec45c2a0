"""The live benchmark of the lidar: its scans, and what it reads of a process."""

import os

import pytest

from benchmarks.lidar_live import RATE_HZ, Arguments, frames_of
from benchmarks.process_use import cpu_s, memory_mb
from ngo_estimator.nodes.messages import to_ns


def test_the_scans_are_of_the_asked_size_at_40_hz() -> None:
    frames = frames_of(Arguments(scans=100, before=1, rays=1080))
    assert len(frames) == 101
    scans = [message for ((_, message),) in frames]
    assert {len(scan.ranges) for scan in scans} == {1080}
    stamps = [to_ns(scan.header.stamp) for scan in scans]
    assert [b - a for a, b in zip(stamps[:-1], stamps[1:], strict=True)] == pytest.approx([1e9 / RATE_HZ] * 100, abs=2)


def test_a_process_has_used_time_and_memory() -> None:
    assert cpu_s(os.getpid()) > 0.0
    assert memory_mb(os.getpid()) > 1.0
