"""The table of pose graphs with wrong loops: who still finds the trajectory, and how long it takes.

    python -m training.results --world graphs
    python -m training.results --world graphs --folder FOLDER --percents 10 30 --rows robust gtsam_gnc

Synthetic graphs have wrong loops of five kinds, with a whole relative pose (KIND) or only "the same place"
(KIND_place); hard ones have a poor odometry, and twice as many loops. With ``--folder`` Lecture Hall and Manhattan3500
are measured, too. The command writes ``training/results/graphs.json`` and ``docs/results_graphs.md``; a run that is
restricted adds its cells to them.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ngo_estimator.graph.corrector import CorrectedGraph, Corrector, GraphProblem, truncated_cost
from ngo_estimator.graph.robust import Robust
from training.baselines import graph_peers
from training.common import records
from training.common.command_line import check_among, run_command
from training.common.records import write_at_once
from training.report import graphs_figure, graphs_page
from training.scoring.graph_problems import KINDS, JudgedProblem, Online, blocks, lecture_hall, manhattan, synthetic
from training.scoring.table import intervals

GRAPHS = ("synthetic_1000", "synthetic_3000", "hard_1000", "hard_3000", "lecture_hall", "manhattan")
_ONLINE = "_online"
"""Ending of a graph whose loops come in blocks: its numbers are means over the blocks."""

_ALL_GRAPHS = (*GRAPHS, "synthetic_20000", *(f"{graph}{_ONLINE}" for graph in GRAPHS))
PEERS: dict[str, graph_peers.Peer] = {
    "gtsam_gnc": graph_peers.gnc,
    "gtsam_lm_cauchy": graph_peers.cauchy,
    "gtsam_lm_dcs": graph_peers.dcs,
    "gtsam_lm_geman_mcclure": graph_peers.geman_mcclure,
    "pcm": graph_peers.pcm,
}
_DRAWN = ("own", "lookalike_50")
"""Cells of online graphs whose first seed is drawn."""

_OURS: dict[str, Callable[[], Corrector]] = {"robust": Robust, "robust_anew": Robust}
ROWS = ("odometry", *PEERS, *_OURS, "right_loops")
SOLVED = 1.5
"""A graph is solved where its error is below so many times that of the right loops."""

_ROUNDING = 1.0 + 1e-6


Correct = Callable[[GraphProblem], CorrectedGraph]


@dataclass(frozen=True)
class Arguments:
    """Settings of the table."""

    graphs: tuple[str, ...] = GRAPHS
    """Graphs to measure; GRAPH_online has its loops in blocks, where robust goes on from its last solution."""
    folder: Path | None = None
    """Folder with Lecture Hall and Manhattan3500; without it they are skipped."""
    kinds: tuple[str, ...] = (*KINDS, *(f"{kind}_place" for kind in KINDS))
    """Kinds of wrong loops; KIND_place has loops without a relative pose, on synthetic graphs alone."""
    percents: tuple[int, ...] = (10, 30, 50, 70)
    """Wrong loops in percent of all."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of a cell's graphs."""
    rows: tuple[str, ...] = tuple(row for row in ROWS if row != "robust_anew")
    """Rows to measure; odometry and right_loops are always measured. robust_anew solves each block from nothing."""
    limit_s: int = 30
    """Computing time after which a peer is stopped; its answer is the odometry then, which counts as not solved."""
    out: Path = records.ROOT / "training" / "results"
    """Folder that gets graphs.json."""
    docs: Path = records.ROOT / "docs"
    """Folder that gets results_graphs.md."""

    def __post_init__(self) -> None:
        check_among(self, graphs=_ALL_GRAPHS, kinds=Arguments.kinds, rows=ROWS)


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, print each cell, write everything after each, and return the JSON's content."""
    path = arguments.out / "graphs.json"
    result: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {"tables": {}}
    result["command"] = 'make results WORLD=graphs ARGS="--folder FOLDER"'
    result["revision"] = records.record("results", arguments)["revision"]
    if arguments.folder is None:
        print("lecture_hall and manhattan are skipped: --folder gives none")
    _measure(synthetic("random", 30, 200, True, 0), arguments.rows, arguments.limit_s)  # compiles everything
    for graph, cell, draw in _cells(arguments):
        measured = []
        for seed in arguments.seeds:
            judged = draw(seed)
            if not graph.endswith(_ONLINE):
                measured.append(_measure(judged, arguments.rows, arguments.limit_s))
                continue
            numbers, online = _measure_online(judged, arguments.rows, arguments.limit_s)
            measured.append(numbers)
            if online.solutions and seed == arguments.seeds[0] and cell.startswith(_DRAWN):
                name = f"results_graphs_{graph}.png"
                graphs_figure.draw(arguments.docs / "images" / name, list(blocks(judged)), online)
                result.setdefault("pictures", {})[graph] = [name, cell]
        rows = result["tables"].setdefault(graph, {}).setdefault(cell, {})
        for row in measured[0]:
            made = {"graphs": len(measured), "revision": result["revision"]}
            columns = {key: np.array([each[row][key] for each in measured]) for key in measured[0][row]}
            rows[row] = {**intervals(columns), **made}
            if row in PEERS:
                rows[row]["limit_s"] = arguments.limit_s
        print(f"{graph} {cell}: {json.dumps({row: _means(rows[row]) for row in measured[0]})}", flush=True)
        write_at_once(path, json.dumps(result, indent=2) + "\n")
        write_at_once(arguments.docs / "results_graphs.md", graphs_page.page(result))
    return result


def _cells(arguments: Arguments) -> Iterator[tuple[str, str, Callable[[int], JudgedProblem]]]:
    """Graph, KIND_PERCENT, and what draws the problem of a seed."""
    folder = arguments.folder
    for graph in arguments.graphs:
        if folder is not None and graph.startswith("lecture_hall"):
            hall = lecture_hall(folder)
            yield graph, f"own_{100.0 * (~hall.right).mean():.0f}", _always(hall)
        for kind in arguments.kinds:
            for percent in arguments.percents:
                name, place = kind.removesuffix("_place"), kind.endswith("_place")
                if graph.startswith(("synthetic", "hard")):
                    form, nodes, *_ = graph.split("_")
                    draw = partial(synthetic, name, percent, int(nodes), not place, hard=form == "hard")
                    yield graph, f"{kind}_{percent}", draw
                elif graph.startswith("manhattan") and folder is not None and not place:
                    yield graph, f"{kind}_{percent}", partial(manhattan, folder, name, percent)


def _always(judged: JudgedProblem) -> Callable[[int], JudgedProblem]:
    return lambda _: judged


def _measure(
    judged: JudgedProblem, rows: tuple[str, ...], limit_s: int, correct: Correct | None = None
) -> dict[str, dict[str, float]]:
    """The numbers of each row on one graph; ``correct`` stands in for the row robust."""
    problem, kept = judged.problem, judged.problem.loops[judged.right]
    right = GraphProblem(problem.poses, problem.steps, kept, np.ones(len(kept)))
    found: dict[str, tuple[np.ndarray, float] | None] = {"odometry": (problem.poses, 0.0)}
    found["right_loops"] = graph_peers.within(graph_peers.least_squares, right, limit_s)
    for row in rows:
        if row in _OURS:
            solve = correct if correct and row == "robust" else _OURS[row]().correct
            began = time.process_time()
            found[row] = (solve(problem).poses, time.process_time() - began)
        elif row in PEERS and not (row == "pcm" and problem.loops.degrees.min(initial=3) < 3):
            found[row] = graph_peers.within(PEERS[row], problem, limit_s)
    answers = {row: (problem.poses, float(limit_s)) if answer is None else answer for row, answer in found.items()}
    bar = max(SOLVED * judged.ate_m(answers["right_loops"][0]), judged.least_ate_m)
    numbers = {row: _numbers(judged, poses, seconds, bar) for row, (poses, seconds) in answers.items()}
    least = _ROUNDING * truncated_cost(problem, answers["right_loops"][0])
    for row, (poses, _) in answers.items():
        numbers[row]["cheapest"] = float(truncated_cost(problem, poses) <= least)
    for row in PEERS.keys() & found.keys():
        numbers[row]["stopped"] = float(found[row] is None)
        numbers[row]["solved"] *= float(found[row] is not None)
    return numbers


def _measure_online(
    judged: JudgedProblem, rows: tuple[str, ...], limit_s: int
) -> tuple[dict[str, dict[str, float]], Online]:
    """The means over all blocks, the share of verdicts that changed, and the solutions."""
    online = Online(Robust())
    found = [_measure(block, rows, limit_s, online.correct) for block in blocks(judged)]
    means = {
        row: {key: float(np.mean([block[row][key] for block in found])) for key in found[0][row]} for row in found[0]
    }
    if "robust" in means:
        means["robust"]["changed"] = online.changed
    return means, online


def _numbers(judged: JudgedProblem, poses: np.ndarray, seconds: float, bar: float) -> dict[str, float]:
    """A loop counts as believed where the poses fit it within its threshold."""
    believed = judged.problem.fits(poses)
    ate = judged.ate_m(poses)
    return {
        "ate_m": ate,
        "solved": float(ate <= bar),
        "precision": float(judged.right[believed].mean()) if believed.any() else 1.0,
        "recall": float(believed[judged.right].mean()),
        "seconds": seconds,
    }


def _means(row: dict[str, Any]) -> dict[str, float]:
    return {key: round(row[key]["mean"], 3) for key in ("ate_m", "solved", "seconds")}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
