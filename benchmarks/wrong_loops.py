"""How long the robust corrector takes for large pose graphs in which many loops are wrong.

    python -m benchmarks.wrong_loops

One core, one thread, processor time. Graphs with 10,000 loops have a poor odometry, and two thirds of their loops are
wrong; loops know the whole relative pose, or only "the same place". The last graph has 20,000 nodes, and 30 % of its
14,286 loops are wrong, between any two nodes. ``solved`` is that of ``training.results_graphs``. Each graph is a line;
the last line is one JSON object. ``of_goal`` is the time as a share of the goal: 1 s, and 10 s of 20,000 nodes.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass

import tyro

from benchmarks.pinned import in_process, two_cores
from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.robust import Robust
from training.baselines.graph_peers import least_squares
from training.results_graphs import SOLVED
from training.scoring.graph_problems import synthetic

_GOAL_S = {3333: 1.0, 20_000: 10.0}
_CASES = [(kind, 67, 3333, metric) for kind in ("random", "local", "grouped", "lookalike") for metric in (False, True)]
_CASES.append(("random", 30, 20_000, True))


@dataclass(frozen=True)
class Arguments:
    """What to solve."""

    seed: int = 0  # Of the graphs.


def measure(seed: int) -> list[dict[str, str | float | bool]]:
    """The numbers of all graphs."""
    Robust().correct(synthetic("random", 30, 200, True, 0).problem)  # compiles everything
    found: list[dict[str, str | float | bool]] = []
    for kind, percent, nodes, metric in _CASES:
        judged = synthetic(kind, percent, nodes, metric, seed, hard=nodes < 20_000)
        problem = judged.problem
        began = time.process_time()
        poses = Robust().correct(problem).poses
        seconds, kept = time.process_time() - began, judged.right
        right = GraphProblem(problem.poses, problem.steps, problem.loops[kept], problem.trust[kept])
        ate_m = judged.ate_m(poses)
        found.append(
            {
                "graph": f"{kind}{'' if metric else '_place'}_{percent}",
                "nodes": nodes,
                "loops": len(problem.loops),
                "seconds": round(seconds, 2),
                "of_goal": round(seconds / _GOAL_S[nodes], 2),
                "ate_m": round(ate_m, 3),
                "solved": ate_m <= SOLVED * judged.ate_m(least_squares(right)),
            }
        )
        print(found[-1], flush=True)
    return found


def main(arguments: Arguments) -> None:
    """Measure and print."""
    found = in_process(two_cores()[0], measure, arguments.seed)
    print(json.dumps({"seed": arguments.seed, "graphs": found}))


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
