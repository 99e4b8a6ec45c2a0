"""The benchmarks of the online core and the nodes at toy size: real processes, and a last line of JSON."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Literal

import pytest

from benchmarks import long_run, online
from demo.graph import GraphError
from demo.session import SessionConfig

KEYS = (*online.BARS, "ratio_to_isam2_best", "cpu_s_a_minute_at_10_hz")


@pytest.mark.timeout(300)
def test_online(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = online.Arguments(worlds=("maze2d",), window=64, live=20, repeats=2, out=tmp_path)
    monkeypatch.setattr(online, "BARS", dict.fromkeys(online.BARS, 1e9))
    # tests/ros/test_demo.py runs the whole graph, and measures this latency.
    monkeypatch.setattr(online, "end_to_end", lambda *_: 123.0)
    latencies = {"image_to_path_median_ms": 10.0, "image_to_path_p99_ms": 15.0, "image_to_path_p99_to_median": 1.5}
    monkeypatch.setattr(online, "image_to_path", lambda *_: latencies)
    assert online.main(arguments) == 0
    result = json.loads(capsys.readouterr().out.splitlines()[-1])["maze2d"]
    for key in KEYS:
        assert result[key] > 0.0, key
    assert result["ratio_to_gtsam_lm"] == pytest.approx(result["optimize"]["ms"] / result["gtsam_lm"]["ms"], rel=0.01)
    both = result["cpu_ratio_to_isam2"], result["cpu_ratio_to_isam2_default"]
    assert result["cpu_ratio_to_isam2_best"] == pytest.approx(max(both), rel=0.01)
    assert result["ngo_node_median_ms"] <= result["ngo_node_p99_ms"] <= result["ngo_node_max_ms"]
    assert result["end_to_end_frames_per_s"] == 123.0


class TenFramesASecond:
    """A session of as many frames as are asked for, of which some may be lost."""

    def __init__(self, config: SessionConfig, _: Path, lost: int = 0) -> None:
        self.frames, self.lost = config.frames, lost

    def run(self, show: Callable[[str, int], None], with_latency: bool = False) -> dict[str, Any]:
        show("loading the networks", 0)
        for count in range(1, self.frames + 1):
            TenFramesASecond.now_s = 100.0 + 0.1 * count
            show("driving", count)
        latency = {"latency_ms": {"median": 10.0, "p99": 15.0, "max": 1000.0}} if with_latency else {}
        return {"frames": self.frames - self.lost, **latency}

    now_s = 0.0


def test_frames_end_to_end_are_counted_and_none_may_be_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments = online.Arguments(end_to_end_frames=50, out=tmp_path)
    monkeypatch.setattr(online.time, "monotonic", lambda: TenFramesASecond.now_s)
    monkeypatch.setattr(online, "Session", TenFramesASecond)
    assert online.end_to_end("maze2d", arguments) == pytest.approx(10.0)
    found = online.image_to_path("maze2d", arguments)
    wanted = {"image_to_path_median_ms": 10.0, "image_to_path_p99_ms": 15.0, "image_to_path_p99_to_median": 1.5}
    assert found == pytest.approx(wanted)
    monkeypatch.setattr(online, "Session", partial(TenFramesASecond, lost=2))
    with pytest.raises(GraphError, match="2 of 50 frames were lost"):
        online.end_to_end("maze2d", arguments)


@pytest.mark.parametrize("world", ["maze2d", "scan"])
def test_a_long_run(world: Literal["maze2d", "scan"], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = long_run.Arguments(
        world=world, frames=640, every=32, window=160, key_frames=8, plot=tmp_path / "curves.png", cache=tmp_path
    )
    code = long_run.main(arguments)
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    # How long so few frames take is left to chance.
    assert code == int(result["cpu_ratio"] > long_run.LONGEST_RATIO)
    assert result["memory_growth_mb"] < long_run.MOST_GROWTH_MB
    assert result["end"]["frames"] == 640
    assert 0.0 < result["end"]["optimised_rmse_m"] < result["end"]["odometry_rmse_m"] * 2.0
    assert (tmp_path / "curves.png").stat().st_size > 10_000
