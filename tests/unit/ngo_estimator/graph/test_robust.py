"""Robust loops of a pose graph: which are believed, and what each knows of a pose."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import KDTree

from ngo_estimator.geometry.se2 import between
from ngo_estimator.graph import robust
from ngo_estimator.graph.corrector import GraphProblem, normal_equations
from ngo_estimator.graph.cycle_agreement import ChainUncertainty, chain_poses
from ngo_estimator.graph.graduated import graduate
from ngo_estimator.graph.loop_errors import squared_and_log
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.robust import Robust
from ngo_estimator.graph.surest_first import believe
from tests.unit.ngo_estimator.graph.test_corrector import STD, loop, straight

STEP_STD, LOOP_STD = np.array((0.02, 0.02, 0.004)), np.array((0.05, 0.05, 0.02))
ROUND = 60  # Steps of one way around a square.


def square(
    rounds: int, seed: int, wrong: int = 0, metric: bool = True, group: int = 1
) -> tuple[GraphProblem, np.ndarray]:
    """A robot that goes around a square; loops join a round to others, the last ``wrong`` of them wrongly.

    The other value is the true poses. Wrong loops come in groups that agree with each other.
    """
    rng = np.random.default_rng(seed)
    steps = np.tile((1.0, 0.0, 0.0), (rounds * ROUND, 1))
    steps[:: ROUND // 4, 2] = math.pi / 2.0
    true = chain_poses(steps)
    measured = steps + rng.normal(0.0, STEP_STD, steps.shape)
    nodes = np.stack((np.arange(len(steps)), np.arange(1, len(steps) + 1)), axis=1)
    first = rng.integers(0, len(true) - ROUND, 2 * ROUND)
    right = np.stack((first, first + ROUND), axis=1)
    relative = between(true[right[:, 0]], true[right[:, 1]]) + rng.normal(0.0, LOOP_STD, (len(right), 3))
    groups = -(-wrong // group)
    start = rng.integers(0, len(true) - ROUND, groups)
    shift = rng.integers(10, ROUND - 10, groups)
    pairs = (np.stack((start, start + shift), axis=1)[:, None] + np.arange(group)[:, None]).reshape(-1, 2)[:wrong]
    pairs = np.minimum(pairs, len(true) - 1)
    pairs, relative = np.concatenate((right, pairs)), np.concatenate((relative, np.zeros((wrong, 3))))
    deviations = np.tile(LOOP_STD if metric else (0.3, 0.3, math.inf), (len(pairs), 1))
    loops = RelativePoses.of_deviations(pairs, relative, deviations)
    chain = RelativePoses.of_deviations(nodes, measured, np.tile(STEP_STD, (len(steps), 1)))
    return GraphProblem(chain_poses(measured), chain, loops, np.ones(len(loops))), true


def worst(poses: np.ndarray, others: np.ndarray) -> float:
    return float(np.hypot(*(poses - others)[:, :2].T).max())


def least_squares(problem: GraphProblem) -> np.ndarray:
    poses = problem.poses
    for _ in range(10):
        parts = [(edges, np.ones(len(edges))) for edges in (problem.steps, problem.loops)]
        poses = poses + normal_equations(poses, *parts).solution()
    return poses


def test_a_loop_shares_its_error_by_the_variances() -> None:
    """Three steps of 1 m and a loop of 2.8 m, all of one variance: each gives way by a quarter of 0.2 m."""
    solution = Robust().correct(straight(3, loop(2.8, (STD, STD, STD))))
    np.testing.assert_allclose(solution.poses[:, 0], [0.0, 0.95, 1.9, 2.85], atol=1e-6)
    assert solution.loop_weights.tolist() == [1.0]
    assert solution.cost == pytest.approx(4 * (0.05 / STD) ** 2)


def test_a_fix_across_a_corridor_moves_nothing_along_it() -> None:
    """The loop is sure across (y) and turned by 90 deg against the map: its own axes must be turned along."""
    steps = np.array([(0.0, 0.0, math.pi / 2.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    chain = RelativePoses.of_deviations(
        np.array([(k, k + 1) for k in range(4)]), steps, np.tile((0.1, 0.1, 1e-4), (4, 1))
    )
    # Seen from node 1, ahead is the map's y. It is 0.3 m to the left of where the chain has it, and 2 m short.
    loop_1_4 = RelativePoses.of_deviations(
        np.array([(1, 4)]), np.array([(1.0, 0.3, 0.0)]), np.array([(math.inf, 1e-3, math.inf)])
    )
    found = Robust().correct(GraphProblem(chain_poses(steps), chain, loop_1_4, np.ones(1)))
    np.testing.assert_allclose(found.poses[4], [-0.3, 3.0, math.pi / 2.0], atol=2e-3)
    covariance = found.covariance([4])
    assert covariance[1, 1] > 0.02 and covariance[0, 0] < 2e-2  # the map's y is the corridor's length


def test_without_loops_nothing_moves() -> None:
    problem = straight(3, loop(3.0, (STD, STD, STD))[:0])
    solution = Robust().correct(problem)
    assert np.array_equal(solution.poses, problem.poses) and solution.cost == 0.0


def test_a_clean_graph_has_its_least_squares_solution() -> None:
    problem, _ = square(3, 1)
    solution = Robust().correct(problem)
    believed = solution.loop_weights > 0.0
    assert believed.mean() > 0.95  # a hundredth is beyond its threshold by chance
    kept = replace(problem, loops=problem.loops[believed], trust=problem.trust[believed])
    np.testing.assert_allclose(between(solution.poses, least_squares(kept)), 0.0, atol=1e-4)
    assert (solution.scale, solution.step_scale, solution.loop_scale) == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("metric", [True, False])
@pytest.mark.parametrize("group", [1, 12])
def test_wrong_loops_are_recognised(group: int, metric: bool) -> None:
    """Two thirds of the loops are wrong, alone or in groups that agree, with a whole pose or only as a place."""
    problem, true = square(4, 2, 4 * ROUND, metric, group)
    solution = Robust().correct(problem)
    believed, right = solution.loop_weights > 0.0, np.arange(len(problem.loops)) < 2 * ROUND
    assert believed[right].mean() > 0.9 and believed[~right].mean() < 0.05
    assert worst(solution.poses, true) < 0.5 * worst(problem.poses, true)


@pytest.mark.parametrize("seed", [3, 4])
def test_two_floors_that_look_alike_are_not_laid_upon_each_other(seed: int) -> None:
    """Four rounds on each: wrong loops join the same places of both, are more than the right ones, and all agree.

    To believe them costs less, but the chain alone says that the floors are apart.
    """
    rng, wrong, right, std = np.random.default_rng(seed), 300, 200, 3.0 * STEP_STD
    floor = np.tile((1.0, 0.0, 0.0), (4 * ROUND, 1))
    floor[:: ROUND // 4, 2] = math.pi / 2.0
    steps = np.concatenate((floor, np.tile((1.0, 0.0, 0.0), (40, 1)), floor))
    true, other = chain_poses(steps), len(floor) + 40
    first = rng.integers(0, len(floor) - ROUND, right)
    inside = np.stack((first, first + ROUND), axis=1) + other * rng.integers(0, 2, right)[:, None]
    first = rng.integers(0, len(floor), wrong)
    across = np.stack((first, other + first % ROUND + ROUND * rng.integers(0, 4, wrong)), axis=1)
    pairs = np.concatenate((inside, across))
    relative = np.concatenate((between(true[inside[:, 0]], true[inside[:, 1]]), np.zeros((wrong, 3))))
    relative += rng.normal(0.0, LOOP_STD, relative.shape)
    loops = RelativePoses.of_deviations(pairs, relative, np.tile(LOOP_STD, (len(pairs), 1)))
    nodes = np.stack((np.arange(len(steps)), np.arange(1, len(true))), axis=1)
    measured = steps + rng.normal(0.0, std, steps.shape)
    chain = RelativePoses.of_deviations(nodes, measured, np.tile(std, (len(steps), 1)))
    believed = (
        Robust().correct(GraphProblem(chain_poses(measured), chain, loops, np.ones(len(loops)))).loop_weights > 0.0
    )
    assert believed[:right].mean() > 0.95 and not believed[right:].any()


def test_a_second_drive_is_joined_where_its_step_knows_nothing() -> None:
    """Information next to zero, as files have it between two drives: that a loop leads there speaks against none."""
    problem, true = square(4, 2, 2 * ROUND, group=12)
    relative, root = problem.steps.relative.copy(), problem.steps.root.copy()
    relative[2 * ROUND], root[2 * ROUND] = (15.0, -8.0, 2.0), np.diag((1e-3, 1e-3, 1e-2))
    steps = RelativePoses(problem.steps.nodes, relative, root)
    solution = Robust().correct(replace(problem, poses=chain_poses(relative), steps=steps))
    assert (solution.loop_weights > 0.0)[: 2 * ROUND].mean() > 0.9
    assert worst(solution.poses, true) < worst(problem.poses, true)


@pytest.mark.parametrize("seed", [0, 21])
def test_two_drives_that_wander_are_joined_among_groups_of_wrong_loops(seed: int) -> None:
    """80 % are wrong. What the step between drives says against loops loses the first, and holds the second."""
    rng = np.random.default_rng(seed)
    true, place, heading = np.zeros((500, 3)), np.zeros(2), 0.0
    for node in range(500):
        true[node] = *place, heading
        heading += rng.choice((0.0, 0.0, 0.5, -0.5)) * math.pi if node % 4 == 3 else 0.0
        ahead = 0.5 * np.array((math.cos(heading), math.sin(heading)))
        if np.abs(place + ahead).max() > 15.0:
            heading, ahead = heading + 0.5 * math.pi, ahead[::-1] * (-1.0, 1.0)
        place = place + ahead
    deviations = np.tile((0.03, 0.02, 0.006), (499, 1))
    steps = between(true[:-1], true[1:]) + rng.normal(0.0, deviations)
    steps[249], deviations[249] = (15.0, -8.0, 2.0), (1e3, 1e3, 1e2)
    ends = np.stack((np.arange(499), np.arange(1, 500)), axis=1)
    chain = RelativePoses.of_deviations(ends, steps, deviations)
    right = KDTree(true[:, :2]).query_pairs(1.0, output_type="ndarray")
    right = right[np.abs(right[:, 1] - right[:, 0]) > 20]
    right = right[rng.permutation(len(right))[:200]]
    wrong = (rng.integers(0, 490, (100, 1, 2)) + np.arange(8)[:, None]).reshape(-1, 2)
    relative = np.repeat(rng.normal(0.0, 0.3, (100, 3)), 8, axis=0)
    relative = np.concatenate((between(true[right[:, 0]], true[right[:, 1]]), relative))
    relative += rng.normal(0.0, LOOP_STD, relative.shape)
    loops = RelativePoses.of_deviations(np.concatenate((right, wrong)), relative, np.tile(LOOP_STD, (1000, 1)))
    solution = Robust().correct(GraphProblem(chain_poses(steps), chain, loops, np.ones(1000)))
    believed = solution.loop_weights > 0.0
    assert believed[:200].mean() > 0.95 and not believed[200:].any()


def test_lanes_that_are_taken_for_their_neighbours_make_up_no_scale() -> None:
    """A lawn mower's loops, 70 % wrong: four of five of these are off by one lane, eight in a row in the same way."""
    rng = np.random.default_rng(2)
    along, lanes = np.tile(np.arange(0.0, 25.5, 0.5), (24, 1)), np.repeat(np.arange(24.0)[:, None], 51, axis=1)
    along[1::2] = along[1::2, ::-1]
    true = np.stack((lanes, along, np.where(lanes % 2.0, -0.5, 0.5) * math.pi), axis=2).reshape(-1, 3)
    steps = between(true[:-1], true[1:])
    measured = steps + rng.normal(0.0, (0.03, 0.02, 0.006), steps.shape)
    ends = np.stack((np.arange(len(steps)), np.arange(1, len(true))), axis=1)
    chain = RelativePoses.of_deviations(ends, measured, np.tile((0.03, 0.02, 0.006), (len(steps), 1)))
    pairs = KDTree(true[:, :2]).query_pairs(1.3, output_type="ndarray")
    pairs = np.sort(pairs[np.abs(pairs[:, 1] - pairs[:, 0]) > 20], axis=1)
    pairs = pairs[rng.permutation(len(pairs))[:1200]]
    wrong = pairs[rng.integers(len(pairs), size=2800)]
    relative = between(true[(both := np.concatenate((pairs, wrong)))[:, 0]], true[both[:, 1]])
    relative += rng.normal(0.0, LOOP_STD, relative.shape)
    side = np.repeat(rng.choice((-1.0, 1.0), 350), 8)
    odd = np.arange(2800) % 5 == 0
    relative[1200:, 1] += np.where(odd, rng.normal(0.0, 3.0, 2800), side)
    relative[1200:, 0] += np.where(odd, rng.normal(0.0, 3.0, 2800), 0.0)
    loops = RelativePoses.of_deviations(both, relative, np.tile(LOOP_STD, (len(both), 1)))
    solution = Robust().correct(GraphProblem(chain_poses(measured), chain, loops, np.ones(len(both))))
    believed = solution.loop_weights > 0.0
    assert believed[:1200].mean() > 0.97 and believed[1200:].sum() < 15


def test_loops_without_trust_change_nothing() -> None:
    problem, _ = square(2, 3)
    solution = Robust().correct(replace(problem, trust=np.zeros(len(problem.loops))))
    np.testing.assert_allclose(between(solution.poses, problem.poses), 0.0, atol=1e-9)


@pytest.mark.parametrize("factor", [50.0, 0.02])
def test_misstated_covariances_are_noticed(factor: float) -> None:
    problem, _ = square(4, 4, ROUND)
    stated = replace(problem, steps=problem.steps.scaled(factor), loops=problem.loops.scaled(factor))
    solution, honest = Robust().correct(stated), Robust().correct(problem)
    np.testing.assert_allclose([solution.step_scale * factor, solution.loop_scale * factor], 1.0, rtol=0.5)
    assert worst(solution.poses, honest.poses) < 0.1
    ratio = solution.covariance([100]) / honest.covariance([100])
    assert 0.5 < ratio[0, 0] < 2.0


def mixed(seed: int, wrong: int, group: int = 1) -> tuple[GraphProblem, np.ndarray]:
    """Of the loops of a square, each second one says only that two nodes are at one place."""
    (problem, true), (places, _) = (square(4, seed, wrong, metric, group) for metric in (True, False))
    loops = problem.loops[::2].extended(places.loops[1::2])
    return replace(problem, loops=loops), true


@pytest.mark.parametrize("factor", [25.0, 0.04])
def test_misstated_covariances_are_noticed_where_some_loops_know_only_places(factor: float) -> None:
    problem, true = mixed(4, 2 * ROUND)
    stated = replace(problem, steps=problem.steps.scaled(factor), loops=problem.loops.scaled(factor))
    solution = Robust().correct(stated)
    assert 0.3 < solution.step_scale * factor < 3.0
    assert worst(solution.poses, true) < 2.0 * worst(Robust().correct(problem).poses, true)


@pytest.mark.parametrize(("least_scale", "believed"), [(1.0, True), (1e-3, False)])
def test_errors_in_common_do_not_shut_out_the_loops_of_another_place(least_scale: float, believed: bool) -> None:
    """All residuals are small, until the last loops, which are two deviations off, and agree with each other."""
    problem, true = square(3, seed=0)
    later = problem.loops.nodes[:, 1]
    nodes = problem.steps.nodes
    relative = between(true[nodes[:, 0]], true[nodes[:, 1]])
    of_loops = between(true[problem.loops.nodes[:, 0]], true[later]) + (later > 170)[:, None] * 2.0 * LOOP_STD
    deviations = np.tile(LOOP_STD, (len(later), 1))
    problem = replace(
        problem,
        poses=true,
        steps=RelativePoses.of_deviations(nodes, relative, np.tile(STEP_STD, (len(nodes), 1))),
        loops=RelativePoses.of_deviations(problem.loops.nodes, of_loops, deviations),
    )
    weights = Robust(least_scale=least_scale).correct(problem).loop_weights
    assert (weights[later > 170] > 0.5).all() == believed and (weights[later <= 170] > 0.5).all()


def test_right_loops_are_believed_where_the_steps_alone_are_better_than_stated() -> None:
    """One scale for both, found in cycles that are mostly steps, would make a tenth of the loops' variances, too."""
    problem, _ = square(6, seed=3)
    solution = Robust().correct(replace(problem, steps=problem.steps.scaled(30.0)))
    assert (solution.loop_weights > 0.0).mean() > 0.95
    assert solution.step_scale < 0.1 and solution.loop_scale == 1.0


def test_whole_loops_that_are_stated_too_well_are_often_noticed_beside_right_steps() -> None:
    problems = [square(6, seed)[0] for seed in range(1, 11)]
    solutions = [Robust().correct(replace(problem, loops=problem.loops.scaled(0.25))) for problem in problems]
    noticed = [solution for solution in solutions if solution.loop_scale != 1.0]
    assert len(noticed) > 5
    for solution in noticed:
        assert (solution.loop_weights > 0.0).mean() > 0.9
        assert solution.step_scale == 1.0 and solution.loop_scale == pytest.approx(4.0, rel=0.5)


@pytest.mark.parametrize("metric", [True, False])
def test_a_wrong_loop_that_is_written_often_is_one_witness(metric: bool) -> None:
    problem, true = square(4, seed=5, metric=metric)
    right, rows = problem.loops, np.tile(np.arange(0, 2 * ROUND, 2), 20)
    three_metres_off = np.minimum(right.nodes[rows] + (0, 3), len(true) - 1)
    loops = right.extended(RelativePoses(three_metres_off, right.relative[rows], right.root[rows]))
    solution = Robust().correct(replace(problem, loops=loops, trust=np.ones(len(loops))))
    assert worst(solution.poses, Robust().correct(problem).poses) < 0.1
    assert solution.loop_weights[len(right) :].mean() < 0.05
    assert solution.loop_weights[: len(right)].mean() > 0.95


def test_a_warm_start_ends_where_a_start_from_nothing_does() -> None:
    """The graph grows, and its loops come in blocks; no verdict of the end differs."""
    problem, _ = square(4, 6, ROUND)
    order = np.argsort(problem.loops.nodes.max(1), kind="stable")
    problem = replace(problem, loops=problem.loops[order])
    solution = None
    for nodes in (100, 150, 200, len(problem.poses)):
        here = problem.loops.nodes.max(1) < nodes
        part = GraphProblem(problem.poses[:nodes], problem.steps[: nodes - 1], problem.loops[here], problem.trust[here])
        solution = Robust().correct(part, solution)
    assert solution is not None
    anew = Robust().correct(problem)
    assert np.array_equal(solution.loop_weights, anew.loop_weights)
    assert worst(solution.poses, anew.poses) < 1e-3


def test_a_warm_start_asks_no_loop_again_that_was_refused_and_does_not_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, _ = square(4, 2, 4 * ROUND)
    old = len(problem.loops) - 20
    before = replace(problem, loops=problem.loops[:old], trust=problem.trust[:old])
    start = Robust().correct(before)
    asked: list[int] = []

    def counted(part: GraphProblem, *rest: Any, **more: Any) -> tuple[np.ndarray, np.ndarray]:
        asked.append(len(part.loops))
        return believe(part, *rest, **more)

    monkeypatch.setattr(robust, "believe", counted)
    solution = Robust().correct(problem, start)
    believed = int((start.loop_weights > 0.0).sum())
    assert asked == [believed + 20] and believed < 0.5 * old
    assert np.array_equal(solution.loop_weights[:old], start.loop_weights)


def test_a_wrong_first_verdict_does_not_last() -> None:
    """A warm start from a solution that believed the wrong loops alone finds the right ones."""
    problem, _ = square(4, 7, ROUND)
    first = Robust().correct(problem)
    upside_down = replace(first, poses=problem.poses, loop_weights=1.0 - first.loop_weights, loops_from_nothing=1)
    assert worst(Robust().correct(problem, upside_down).poses, first.poses) < 1e-2


def test_cycles_have_the_covariance_of_what_is_in_them() -> None:
    """Squared residuals of right cycles are chi-square with three degrees of freedom: 3 on average, variance 6."""
    problem, true = square(3, 8)
    pair, rng, found = np.array(((5, 66), (12, 70))), np.random.default_rng(0), []
    for _ in range(400):
        steps = replace(problem.steps, relative=between(true[:-1], true[1:]) + rng.normal(0.0, STEP_STD, (180, 3)))
        relative = between(true[pair[:, 0]], true[pair[:, 1]]) + rng.normal(0.0, LOOP_STD, (2, 3))
        loops = RelativePoses.of_deviations(pair, relative, np.tile(LOOP_STD, (2, 1)))
        chain = ChainUncertainty(steps)
        found.append((*chain.off_chain(loops)[0], chain.off_pairs(loops, np.array([[0, 1]]))[0][0]))
    np.testing.assert_allclose(np.mean(found, axis=0), 3.0, atol=0.4)
    np.testing.assert_allclose(np.var(found, axis=0), 6.0, atol=2.0)


def test_covariances_of_pairs_are_those_of_a_dense_inverse() -> None:
    problem, _ = square(2, 9)
    parts = [(edges, np.ones(len(edges))) for edges in (problem.steps, problem.loops)]
    equations = normal_equations(problem.poses, *parts)
    pairs = problem.loops.nodes[:10]
    for pair, joint in zip(pairs, equations.pair_covariances(pairs), strict=True):
        if pair.min() > 0:
            np.testing.assert_allclose(joint, equations.covariance(pair), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        equations.pair_covariances(np.array([[0, 1]]))[0, 3:, 3:], equations.covariance([1]), rtol=1e-6, atol=1e-12
    )


def test_what_a_graph_predicts_of_loops_is_as_sure_as_dense_matrices_say() -> None:
    problem, _ = square(2, 9)
    parts = [(edges, np.ones(len(edges))) for edges in (problem.steps, problem.loops)]
    poses, loops = problem.poses, problem.loops[:10]
    joint = normal_equations(poses, *parts).pair_covariances(loops.nodes)
    jacobian, residuals = loops.whitened_jacobian(poses), loops.residuals(poses)
    predicted = loops.predicted_covariances(poses, joint)
    np.testing.assert_allclose(predicted, jacobian @ joint @ jacobian.mT, rtol=1e-9, atol=1e-12)
    total = predicted + np.eye(3)
    squared, logs = squared_and_log(residuals, predicted)
    np.testing.assert_allclose(squared, np.einsum("ki,kij,kj->k", residuals, np.linalg.inv(total), residuals))
    np.testing.assert_allclose(logs, np.linalg.slogdet(total)[1])


def test_where_a_factor_does_not_hold_all_places_two_choices_of_them_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    problem, true = square(4, 2, 4 * ROUND, metric=False)
    nodes = problem.loops.nodes.copy()
    nodes[: 2 * ROUND : 2, 1] += ROUND * (nodes[: 2 * ROUND : 2, 0] <= 2 * ROUND)  # to the next round but one
    problem = replace(problem, loops=replace(problem.loops, nodes=nodes))
    given: list[np.ndarray] = []

    def solved(part: GraphProblem, *rest: Any, **more: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        given.append(part.loops.nodes)
        return graduate(part, *rest, **more)

    monkeypatch.setattr(robust, "_MOST_FILLED", 3000)
    monkeypatch.setattr(robust, "graduate", solved)
    solution = Robust().correct(problem)
    first, second = given[:2]
    assert max(len(first), len(second)) < 2 * ROUND and not np.array_equal(first, second)
    right = np.arange(len(problem.loops)) < 2 * ROUND
    believed = solution.loop_weights > 0.0
    assert believed[right].mean() > 0.9 and believed[~right].mean() < 0.05
    assert worst(solution.poses, true) < 0.5 * worst(problem.poses, true)


def test_the_likeliest_of_each_place_come_first_and_what_is_ruled_out_last() -> None:
    nodes = np.array(((1, 80), (5, 110), (105, 3), (81, 200), (85, 210), (140, 300)))  # one the other way
    odds = np.array((9.0, 7.0, 8.0, 1.0, 2.0, -1.0))
    np.testing.assert_array_equal(robust._spread(nodes, odds, 40), (0, 4, 2, 3, 1, 5))
