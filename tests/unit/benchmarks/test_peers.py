"""Both peers find the poses of a graph whose answer is known, wherever a loop is wrong."""

import numpy as np
import pytest
import torch

from benchmarks.peers import Incremental, LevenbergMarquardt, Problem, xyyaw
from ngo_estimator.geometry import se2

SIDE, LAPS = 5, 3
COUNT = 4 * SIDE * LAPS


@pytest.fixture
def truth() -> np.ndarray:
    steps = np.tile([1.0, 0.0, 0.0], (COUNT, 1))
    steps[SIDE - 1 :: SIDE, 2] = np.pi / 2
    poses = se2.r2g(torch.from_numpy(steps)).numpy()
    return np.concatenate((np.zeros((1, 3)), poses))


def problem_of(truth: np.ndarray, wrong: int = 0) -> Problem:
    """Rounds of a square: an odometry that turns too much, a loop from each pose to the one a lap before."""
    poses = torch.from_numpy(truth)
    relative = se2.between(poses[:-1], poses[1:]).numpy() + [0.0, 0.0, 0.001]
    lap = 4 * SIDE
    nodes = np.stack((np.arange(COUNT + 1 - lap), np.arange(lap, COUNT + 1)), axis=1)
    measured = np.zeros((len(nodes), 3))
    measured[:wrong] = [2.0, -3.0, 1.0]
    return Problem(
        relative=relative,
        std=np.full((COUNT, 3), 0.01),
        nodes=nodes,
        measured=measured,
        loop_std=np.full((len(nodes), 3), 0.01),
        logit=np.where(np.arange(len(nodes)) < wrong, -1.0, 5.0),
    )


def in_order(problem: Problem) -> np.ndarray:
    incremental = Incremental()
    for count in range(1, len(problem.relative) + 1):
        so_far = problem.where(problem.nodes[:, 1] <= count)
        part = Problem(problem.relative[:count], problem.std[:count], *list(vars(so_far).values())[2:])
        estimate = incremental.update(*incremental.prepare(part))
        incremental.keep(estimate)
    return xyyaw(estimate)


def error_m(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(poses[:, :2] - truth[:, :2], axis=1).max())


def test_both_close_the_loops(truth: np.ndarray) -> None:
    problem = problem_of(truth)
    odometry = se2.r2g(torch.from_numpy(problem.relative)).numpy()
    for poses in (xyyaw(LevenbergMarquardt(problem).solve()), in_order(problem)):
        # A lap that turns too much lies beside itself: what the loops say is that it ends where it began.
        assert poses.shape == truth.shape
        assert np.abs(poses[4 * SIDE :: 4 * SIDE, :2]).max() < 0.05
        assert error_m(poses, truth) < 0.5 * error_m(odometry, truth[1:])


def test_a_kernel_keeps_wrong_loops_out(truth: np.ndarray) -> None:
    problem = problem_of(truth, wrong=2)
    right = problem.where(problem.logit > 0.0)
    assert len(right.nodes) == len(problem.nodes) - 2
    poses, expected = (xyyaw(LevenbergMarquardt(each).solve()) for each in (problem, right))
    assert error_m(poses, expected) < 0.05
