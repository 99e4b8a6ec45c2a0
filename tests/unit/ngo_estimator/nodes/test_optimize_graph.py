"""The command that corrects a g2o file: it finds the wrong loops, says so in its files, and ends in one line else."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from ngo_estimator.nodes import optimize_graph
from ngo_estimator.nodes.optimize_graph import Arguments
from ngo_estimator.trajectory.g2o import graph_of, read_g2o, write_g2o
from training.scoring.graph_problems import JudgedProblem, synthetic


@pytest.fixture(scope="module")
def judged() -> JudgedProblem:
    return synthetic("random", 50.0, 300, True, 3)


@pytest.fixture
def graph(tmp_path: Path, judged: JudgedProblem) -> Path:
    problem = judged.problem
    nothing = np.full(len(problem.loops), np.nan)
    write_g2o(tmp_path / "graph.g2o", graph_of(np.full(300, -1), problem.poses, problem.steps, problem.loops, nothing))
    return tmp_path / "graph.g2o"


def test_it_tells_right_loops_from_wrong_ones_in_all_its_files(graph: Path, judged: JudgedProblem) -> None:
    out, console = graph.with_name("out.g2o"), Console(record=True, width=200)
    report = optimize_graph.run(Arguments(graph, out), console)
    corrected, right = read_g2o(out), judged.right
    assert judged.ate_m(corrected.poses) < 0.3 < judged.ate_m(judged.problem.poses)
    belief = corrected.belief[corrected.is_loop]
    assert (belief[right] == 1.0).mean() > 0.9 and (belief[~right] == 0.0).mean() > 0.97
    assert json.loads(out.with_suffix(".json").read_text()) == report
    assert [loop["believed"] for loop in report["loops"]] == (belief == 1.0).tolist()
    assert all((loop["misfit"] <= 1.0) == loop["believed"] for loop in report["loops"])
    assert out.with_suffix(".png").stat().st_size > 10_000
    text = console.export_text()
    assert f"{report['loops_believed']} loops are believed, {report['loops_refused']} refused" in text
    # What was refused is asked again, so that the answer does not depend on the marks.
    again = optimize_graph.run(Arguments(out, graph.with_name("again.g2o"), picture=False), console)
    assert again["loops_believed"] == report["loops_believed"] and again["largest_move_m"] < 1e-3


def test_a_fault_ends_it_with_one_line(
    graph: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def ends(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["optimize_graph", *words])
        with pytest.raises(SystemExit) as error:
            optimize_graph.main()
        assert error.value.code == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        return said

    (bad := graph.with_name("bad.g2o")).write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n")
    assert "line 1 is a VERTEX_SE3:QUAT" in ends(str(bad), "--out", str(graph.with_name("out.g2o")))
    assert "No such file" in ends(str(graph.with_name("none.g2o")), "--out", str(graph.with_name("out.g2o")))
    assert "is there already" in ends(str(graph), "--out", str(graph))
    assert "ends in .g2o" in ends(str(graph), "--out", str(graph.with_name("out.txt")))
    assert not graph.with_name("out.g2o").exists()
