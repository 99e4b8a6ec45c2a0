"""The demo as a person starts it, with untrained weights: then the corrected path is the odometry."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from ngo_estimator.checkpoint import write_untrained

from .processes import wait_until

pytestmark = pytest.mark.processes

DEMO = Path(__file__).parents[2] / "demo" / "run.py"
FRAMES = 30
ERRORS = ["position_rmse_m", "final_percent", "heading_rmse_deg"]


def run_demo(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(DEMO), "--world", "maze2d", "--frames", str(FRAMES), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=150, env=os.environ)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("weights")
    write_untrained(folder, "maze2d")
    return folder


def test_ends_with_the_table_as_json(weights: Path, tmp_path: Path) -> None:
    done = run_demo("--weights", str(weights), "--out", str(tmp_path), "--latency")
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    latency, memory = result.pop("latency_ms"), result.pop("memory_mb")
    assert list(result) == ["world", "seed", "frames", "path_m", "odometry", "corrected"]
    assert (result["world"], result["seed"], result["frames"]) == ("maze2d", 2000, FRAMES)
    assert list(result["odometry"]) == list(result["corrected"]) == ERRORS
    assert result["corrected"] == pytest.approx(result["odometry"], abs=1e-3)
    assert result["path_m"] > 1.0
    assert {"local_node", "ngo_node"} <= memory["half"].keys() == memory["end"].keys()
    assert all(50.0 < size < 1000.0 for sizes in memory.values() for size in sizes.values())
    assert 0.0 < latency["median"] <= latency["p99"] <= latency["max"] and latency["frames"] == FRAMES - 1
    assert (tmp_path / "picture.png").stat().st_size > 10_000
    with (tmp_path / "recording.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    assert counts["/image"] == counts["/ground_truth"] == FRAMES
    assert counts["/odom"] == counts["/ngo/pose"] == FRAMES - 1
    assert counts["/ngo/path"] >= FRAMES - 1, "one more where an optimisation ends by itself"


def descendants(pid: int) -> set[int]:
    """Processes that ``pid`` started, and those that they started."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            # The name, in brackets, may hold blanks; the parent is the second field behind it.
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    found = {pid}
    while new := {child for child, parent in parents.items() if parent in found} - found:
        found |= new
    return found - {pid}


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_interrupted_it_leaves_no_node_behind(weights: Path, tmp_path: Path) -> None:
    command = [sys.executable, str(DEMO), "--world", "maze2d", "--rate", "20", "--weights", str(weights)]
    with (tmp_path / "log").open("w") as log:
        demo = subprocess.Popen([*command, "--out", str(tmp_path / "out")], stdout=log, stderr=log)
        wait_until(lambda: demo.poll() is not None or len(descendants(demo.pid)) >= 3, "the nodes")
        started = descendants(demo.pid)
        demo.send_signal(signal.SIGHUP)  # as a closed terminal; by the handler of an interrupt
        code = demo.wait(60)
    assert code == 130, (tmp_path / "log").read_text()
    assert len(started) >= 3
    wait_until(lambda: not any(map(running, started)), "the end of all processes")
