import json
from pathlib import Path
from typing import Any

import pytest

from demo import run
from demo.graph import GraphError


def fake_result(seed: int) -> dict[str, Any]:
    errors = [{"position_rmse_m": m, "final_percent": 1.0, "heading_rmse_deg": 2.0} for m in (2.0, 1.0)]
    return {"world": "maze2d", "seed": seed, "frames": 30, "path_m": 9.0, "odometry": errors[0], "corrected": errors[1]}


def fake_run_one(arguments: Any, seed: int, out: Path, console: Any, view: Any = None) -> dict[str, Any]:
    return fake_result(seed)


def test_last_line_is_the_result(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    monkeypatch.setattr(run, "run_one", fake_run_one)
    assert run.main(["--world", "maze2d", "--seed", "2003", "--out", str(tmp_path)]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == fake_result(2003)
    assert json.loads((tmp_path / "result.json").read_text()) == fake_result(2003)


def test_several_mazes_end_with_a_summary(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    monkeypatch.setattr(run, "run_one", fake_run_one)
    assert run.main(["--world", "maze2d", "--mazes", "3", "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    summary = json.loads(output.splitlines()[-1])
    assert summary["seeds"] == [2000, 2001, 2002] and summary["wins"] == 3
    assert "3 of 3 mazes better" in " ".join(output.split())
    assert json.loads((tmp_path / "summary.json").read_text()) == summary


def test_a_failed_graph_is_one_message_and_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any
) -> None:
    def fail(*_: Any) -> None:
        raise GraphError("ngo_node ended with exit code 2")

    monkeypatch.setattr(run, "run_one", fail)
    assert run.main(["--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == "demo: ngo_node ended with exit code 2\n"


@pytest.mark.parametrize("argument", ["--frames=2", "--mazes=0", "--rate=-1", "--rate=nan", "--seed=-1"])
def test_refuses_what_makes_no_sense(argument: str, capsys: Any) -> None:
    with pytest.raises(SystemExit):
        run.parse_arguments([argument])
    assert "is not allowed; at least" in capsys.readouterr().err


def test_a_view_shows_one_maze(capsys: Any) -> None:
    assert run.parse_arguments(["--view"]).view and not run.parse_arguments([]).view
    with pytest.raises(SystemExit):
        run.parse_arguments(["--view", "--mazes", "2"])
    assert "it shows one maze" in capsys.readouterr().err
