"""Crowds of loops: together they are no more than a few witnesses."""

from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.graph.corrector import GraphProblem, truncated_cost
from ngo_estimator.graph.crowds import CrowdAware, without_crowds
from ngo_estimator.graph.robust import Robust
from tests.unit.ngo_estimator.graph.test_robust import square, worst


def outvoted() -> tuple[GraphProblem, np.ndarray]:
    """Thrice as many loops as right ones say of each place that the robot was three steps, 3 m, farther on."""
    problem, true = square(3, 5)
    right = problem.loops[np.argsort(problem.loops.nodes[:, 0], kind="stable")]
    ahead = np.stack((right.nodes[:, 0], np.minimum(right.nodes[:, 1] + 3, len(true) - 1)), axis=1)
    loops = right[::3].extended(replace(right, nodes=ahead))
    return replace(problem, loops=loops, trust=np.ones(len(loops))), true


def test_a_crowd_that_errs_together_does_not_outvote_the_odometry() -> None:
    problem, true = outvoted()
    robust, aware = Robust().correct(problem), CrowdAware().correct(problem)
    assert worst(aware.poses, true) < 0.5 < worst(robust.poses, true)


def test_all_of_a_crowd_count_as_three() -> None:
    problem, _ = square(2, 0)
    nodes = np.tile((10, 70), (len(problem.loops), 1))
    nodes[0] = (30, 90)
    trust = without_crowds(replace(problem, loops=replace(problem.loops, nodes=nodes))).trust
    assert trust[0] == 1.0 and trust[1:].sum() == pytest.approx(3.0)


@pytest.mark.parametrize("metric", [True, False])
def test_it_does_no_harm(metric: bool) -> None:
    problem, true = square(4, 1, wrong=100, metric=metric, group=5)
    robust, aware = Robust().correct(problem), CrowdAware().correct(problem)
    fair = without_crowds(problem.scaled(robust.scale))
    assert truncated_cost(fair, aware.poses) <= truncated_cost(fair, robust.poses)
    assert worst(aware.poses, true) < 1.2 * worst(robust.poses, true)


def test_a_warm_start_goes_on_from_its_solution() -> None:
    problem, true = outvoted()
    first = CrowdAware().correct(problem)
    fewer = replace(problem, loops=problem.loops[:-5], trust=problem.trust[:-5])
    assert worst(CrowdAware().correct(problem, CrowdAware().correct(fewer)).poses, first.poses) < 0.1
    assert worst(first.poses, true) < 0.5
