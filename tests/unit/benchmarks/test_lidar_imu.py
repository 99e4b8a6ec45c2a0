"""The benchmark of an IMU at toy size: one row for each way to have it."""

import json

import pytest

from benchmarks import lidar_imu
from benchmarks.lidar_imu import Arguments, main


def test_a_row_for_each_imu(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidar_imu, "VARIANTS", ("none", "wrong sign"))
    assert main(Arguments(seeds=(10_000,), scans=20)) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["wrong sign"] == found["none"], "it is too early to know, and it is never used"
