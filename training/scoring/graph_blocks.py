"""A pose graph as a robot builds it: its loops come in blocks, in order of their later nodes."""

from collections.abc import Iterator

import numpy as np

from ngo_estimator.graph.corrector import CorrectedGraph, Corrector, GraphProblem
from training.scoring.graph_problems import JudgedProblem

BLOCK = 120
"""Loops in a block."""


def blocks(judged: JudgedProblem) -> Iterator[JudgedProblem]:
    """The graph after each block; the last one is whole, but for nodes behind its last loop."""
    problem = judged.problem
    order = np.argsort(problem.loops.nodes.max(axis=1), kind="stable")
    for end in range(BLOCK, len(order) + BLOCK, BLOCK):
        rows = order[:end]
        nodes = int(problem.loops.nodes[rows].max()) + 1
        steps, loops = problem.steps[: nodes - 1], problem.loops[rows]
        part = GraphProblem(problem.poses[:nodes], steps, loops, problem.trust[rows])
        yield JudgedProblem(part, judged.truth[:nodes], judged.right[rows], judged.least_ate_m)


class Online:
    """Corrects the blocks of one graph, each from the solution of the one before it."""

    def __init__(self, corrector: Corrector) -> None:
        self._corrector = corrector
        self._last: CorrectedGraph | None = None
        self.changed = self.verdicts = 0
        """Verdicts about known loops that changed, and all of them."""

    def correct(self, problem: GraphProblem) -> CorrectedGraph:
        """The solution of the next block."""
        before, self._last = self._last, self._corrector.correct(problem, self._last)
        if before is not None:
            known = len(before.loop_weights)
            self.changed += int((before.loop_weights != self._last.loop_weights[:known]).sum())
            self.verdicts += known
        return self._last
