"""The benchmark of depth at toy size: a row for each camera."""

import json

import pytest

from benchmarks import lidar_depth
from benchmarks.lidar_depth import Arguments, main


def test_a_row_for_each_camera(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidar_depth, "CAMERAS", {"exact": (0.0, 5.0), "poor": (0.02, 5.0)})
    assert main(Arguments(seeds=(30_000,), scans=20)) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(found) == ["exact", "poor"] and 0.0 < found["exact"][0][0] < found["poor"][0][0]
