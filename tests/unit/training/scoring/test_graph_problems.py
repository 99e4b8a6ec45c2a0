"""Graphs with wrong loops, the peers that solve them, and the table's numbers."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.se2 import between, compose
from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem
from ngo_estimator.graph.cycle_agreement import ChainUncertainty, chain_poses
from ngo_estimator.graph.loop_evidence import map_area, scale_and_inlier_ratio
from ngo_estimator.graph.robust import Robust
from training import results_graphs
from training.baselines import graph_peers
from training.scoring.graph_problems import KINDS, JudgedProblem, Online, blocks, synthetic


@pytest.mark.parametrize("kind", KINDS)
def test_a_graph_has_the_share_of_wrong_loops_that_was_asked_for(kind: str) -> None:
    judged = synthetic(kind, 50.0, 400, True, 0)
    loops = judged.problem.loops
    assert (~judged.right).mean() == pytest.approx(0.5, abs=0.02)
    # The chain's drift is far less than 2 m in so short a graph: it tells the right loops from the wrong ones.
    poses = judged.problem.poses
    off = np.hypot(*(loops.relative - between(poses[loops.nodes[:, 0]], poses[loops.nodes[:, 1]]))[:, :2].T)
    assert np.median(off[judged.right]) < 1.0 and np.median(off[~judged.right]) > 2.0


def test_a_place_alone_knows_no_heading() -> None:
    judged = synthetic("random", 30.0, 400, False, 0)
    assert (judged.problem.loops.degrees == 2).all()


def test_wrong_loops_near_each_other_do_not_pass_for_right_ones_with_large_variances() -> None:
    """Chains between right loops are so long that these fit without being sure; wrong ones have short chains."""
    problem = synthetic("local", 67.0, 3333, True, 0, hard=True).problem
    chain, area = ChainUncertainty(problem.steps), map_area(problem.poses)
    scale, inlier_ratio = scale_and_inlier_ratio(chain, problem.loops, area)
    assert 0.5 < scale < 2.0 and inlier_ratio < 0.4
    scale, _ = scale_and_inlier_ratio(ChainUncertainty(problem.steps.scaled(0.02)), problem.loops.scaled(0.02), area)
    assert 25.0 < scale < 100.0


@pytest.mark.parametrize("span", [1, 2])
def test_a_few_loops_that_repeat_the_odometry_do_not_rule_out_all_others(span: int) -> None:
    """Their residuals are zero, as where a graph says steps twice or composes two of them to one edge."""
    judged = synthetic("random", 30.0, 300, True, 0)
    problem, first = judged.problem, np.arange(0, 290, 13)
    nodes = np.stack((first, first + span), axis=1)
    relative = between(*(chain_poses(problem.steps.relative)[each] for each in nodes.T))
    loops = problem.loops.extended(replace(problem.steps[first], nodes=nodes, relative=relative))
    solution = Robust().correct(replace(problem, loops=loops, trust=np.ones(len(loops))))
    assert (solution.loop_weights[: len(problem.loops)] > 0.0)[judged.right].mean() > 0.9


def test_places_are_believed_against_a_chain_that_is_ten_times_worse_than_stated() -> None:
    """Cycles with such a chain rule out right places, and what they let in makes a solution that seems to agree."""
    judged = synthetic("random", 60.0, 500, False, 0, hard=True)
    problem = replace(judged.problem, steps=judged.problem.steps.scaled(0.01))
    assert judged.ate_m(Robust().correct(problem).poses) < 0.5


def test_the_error_is_that_after_the_best_alignment() -> None:
    judged = synthetic("random", 30.0, 200, True, 1)
    true = np.column_stack((judged.truth, np.zeros(200)))
    assert judged.ate_m(compose(np.array((3.0, -2.0, 1.0)), true)) < 1e-9
    assert judged.ate_m(true * (-1.0, 1.0, 1.0)) > 1.0  # a mirror is no motion


@pytest.fixture(scope="module")
def easy() -> JudgedProblem:
    return synthetic("random", 30.0, 300, True, 2)


@pytest.mark.parametrize("peer", results_graphs.PEERS)
def test_peers_solve_an_easy_graph(easy: JudgedProblem, peer: str) -> None:
    answer = graph_peers.within(results_graphs.PEERS[peer], easy.problem, 60)
    assert answer is not None and easy.ate_m(answer[0]) < 0.5 and answer[1] > 0.0


def test_our_corrector_finds_what_gtsam_finds_in_a_clean_graph(easy: JudgedProblem) -> None:
    ours = Robust().correct(easy.problem)
    kept, problem = easy.problem.loops[ours.loop_weights > 0.0], easy.problem
    theirs = graph_peers.least_squares(GraphProblem(problem.poses, problem.steps, kept, np.ones(len(kept))))
    np.testing.assert_allclose(between(ours.poses, theirs), 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("kind", "percent", "nodes", "metric", "seed"),
    [
        ("random", 90, 300, True, 1),
        ("lookalike", 70, 1000, True, 0),
        ("lookalike", 70, 3000, True, 102),
        ("random", 80, 1000, False, 105),
        ("lookalike", 67, 3333, False, 107),
    ],
)
def test_a_hard_graph_is_solved_though_its_chain_rules_out_loops_that_are_right(
    kind: str, percent: int, nodes: int, metric: bool, seed: int
) -> None:
    """Most loops are wrong, and the odometry is metres off; of places, only the ways between them say which.

    In the first and the third graph a stretch lies wrongly at first. The largest one has more loops than a factor
    holds.
    """
    judged = synthetic(kind, percent, nodes, metric, seed, hard=True)
    problem, kept = judged.problem, judged.problem.loops[judged.right]
    right = Robust().correct(GraphProblem(problem.poses, problem.steps, kept, np.ones(len(kept)))).poses
    off = judged.ate_m(Robust().correct(problem).poses)
    assert off < 1.2 * judged.ate_m(right) < 0.1 * judged.ate_m(problem.poses)


def test_a_peer_that_takes_too_long_or_fails_has_no_answer(easy: JudgedProblem) -> None:
    def never_ends(problem: GraphProblem) -> np.ndarray:
        while True:
            problem.poses.sum()

    def fails(problem: GraphProblem) -> np.ndarray:
        return np.full((1, 3), math.nan)

    assert graph_peers.within(never_ends, easy.problem, 1) is None
    assert graph_peers.within(fails, easy.problem, 60) is None


def test_the_table_has_every_row_and_keeps_other_cells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        results_graphs,
        "synthetic",
        lambda kind, percent, _, *rest, hard=False: synthetic(kind, percent, 200, *rest, hard),
    )
    for kind in ("random", "local"):
        arguments = results_graphs.Arguments(
            graphs=("synthetic_1000",), kinds=(kind,), percents=(30,), seeds=(0, 1), rows=("robust", "gtsam_lm_cauchy"),
            out=tmp_path, docs=tmp_path,
        )  # fmt: skip
        cells = results_graphs.main(arguments)["tables"]["synthetic_1000"]
    assert list(cells) == ["random_30", "local_30"]
    assert set(cells["local_30"]) == {"odometry", "right_loops", "robust", "gtsam_lm_cauchy"}
    robust = cells["random_30"]["robust"]
    assert set(robust) == {"ate_m", "solved", "precision", "recall", "seconds", "cheapest", "graphs", "revision"}
    assert robust["solved"]["mean"] == 1.0 and robust["precision"]["mean"] > 0.9
    assert "| random_30 |" in (tmp_path / "results_graphs.md").read_text()


def test_a_peer_that_was_stopped_counts_as_not_solved_and_the_page_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, easy: JudgedProblem
) -> None:
    def never_ends(problem: GraphProblem) -> np.ndarray:
        while True:
            problem.poses.sum()

    easy = replace(easy, least_ate_m=1000.0)  # even the odometry is good enough
    monkeypatch.setattr(results_graphs, "synthetic", lambda *_, hard=False: easy)
    monkeypatch.setitem(results_graphs.PEERS, "pcm", never_ends)
    arguments = results_graphs.Arguments(
        graphs=("hard_1000",), kinds=("random",), percents=(50,), seeds=(0,), rows=("pcm",), limit_s=1,
        out=tmp_path, docs=tmp_path,
    )  # fmt: skip
    cell = results_graphs.main(arguments)["tables"]["hard_1000"]["random_50"]
    assert cell["odometry"]["solved"]["mean"] == 1.0
    assert cell["pcm"]["solved"]["mean"] == 0.0 and cell["pcm"]["stopped"]["mean"] == 1.0
    assert "100% stopped" in (tmp_path / "results_graphs.md").read_text()


def test_an_unknown_row_is_refused() -> None:
    with pytest.raises(ValueError, match="rows has robusted"):
        results_graphs.Arguments(rows=("robusted",))


def test_online_a_graph_comes_in_blocks_and_is_solved_in_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    judged = synthetic("random", 50.0, 300, True, 1)
    parts = list(blocks(judged))
    assert [len(part.problem.loops) for part in parts] == [120, 240, 300]
    newest = [part.problem.loops.nodes.max(axis=1) for part in parts]
    assert all(len(part.problem.poses) == ends.max() + 1 for part, ends in zip(parts, newest, strict=True))
    assert newest[0].max() <= newest[1][120:].min()
    monkeypatch.setattr(results_graphs, "synthetic", lambda *_, hard=False: judged)
    arguments = results_graphs.Arguments(
        graphs=("hard_1000_online",), kinds=("random",), percents=(50,), seeds=(0,), rows=("robust", "robust_anew"),
        out=tmp_path, docs=tmp_path,
    )  # fmt: skip
    cell = results_graphs.main(arguments)["tables"]["hard_1000_online"]["random_50"]
    assert cell["robust"]["solved"]["mean"] == cell["robust_anew"]["solved"]["mean"] == 1.0
    assert cell["robust"]["changed"]["mean"] < 0.02
    page = (tmp_path / "results_graphs.md").read_text()
    assert "| mean over cells | cells | solved | seconds | precision | recall | cheapest | changed |" in page


def test_verdicts_that_changed_are_counted_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A corrector that believes every second loop, and in the next block the others."""

    class Fickle:
        def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
            verdicts = (np.arange(len(problem.loops)) % 2 == (start is None)).astype(np.float64)
            return CorrectedGraph(problem, problem.poses, verdicts, np.ones(len(problem.steps)), 0.0)

    judged = synthetic("lookalike", 50.0, 250, True, 1)
    parts, online = list(blocks(judged))[:2], Online(Fickle())
    for part in parts:
        online.correct(part.problem)
    assert online.changed == 1.0 and len(online.solutions) == len(parts) == 2
    monkeypatch.setattr(results_graphs, "synthetic", lambda *_, hard=False: judged)
    arguments = results_graphs.Arguments(
        graphs=("synthetic_1000_online",), kinds=("lookalike",), percents=(50,), seeds=(0,), rows=("robust",),
        out=tmp_path, docs=tmp_path,
    )  # fmt: skip
    results_graphs.main(arguments)
    assert (tmp_path / "images/results_graphs_synthetic_1000_online.png").stat().st_size > 10_000
    assert "](images/results_graphs_synthetic_1000_online.png)" in (tmp_path / "results_graphs.md").read_text()
