"""The benchmark of other sensors at toy size: a row for each."""

import json

import pytest

from benchmarks import lidar_depth
from benchmarks.lidar_depth import Arguments, Sensor, main


def test_a_row_for_each_sensor(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        lidar_depth,
        "SENSORS",
        {"poor": Sensor(growth=0.02), "two": Sensor(180.0, rear=True), "cloud": Sensor(360.0, rings=4)},
    )
    assert main(Arguments(seeds=(30_000,), scans=8)) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(found) == ["poor", "two", "cloud"]
    for ((rmse, squares),) in found.values():
        assert 0.0 < rmse < 0.5 and squares > 0.0
