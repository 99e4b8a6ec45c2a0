"""The benchmark of depth at toy size: a row for each camera."""

import json

import pytest

from benchmarks import lidar_depth
from benchmarks.lidar_depth import Arguments, main


def test_a_row_for_each_camera(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lidar_depth, "CAMERAS", {"poor": (0.02, 5.0)})
    assert main(Arguments(seeds=(30_000,), scans=8)) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    ((rmse, squares),) = found["poor"]
    assert 0.0 < rmse < 0.5 and squares > 0.0
