"""Graphs of g2o files as problems: whatever their ids, their order and their gaps, the same motion comes out."""

from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.se2 import between, compose
from ngo_estimator.graph.cycle_agreement import chain_poses
from ngo_estimator.graph.robust import Robust
from ngo_estimator.trajectory.chained_graph import ChainedGraph, chained
from ngo_estimator.trajectory.g2o import PlanarGraph, read_g2o

INFORMATION = "100 3 2 80 -4 400"


def _ring(ids: list[int], drift: float = 0.05) -> tuple[list[str], np.ndarray]:
    """The lines of a square drive that ends where it began, and its poses by steps that turn a little too far."""
    turns = np.zeros(len(ids) - 1)
    turns[len(ids) // 4 :: len(ids) // 4] = 0.5 * np.pi
    relative = np.stack((np.ones(len(turns)), np.zeros(len(turns)), turns + drift / len(turns)), axis=1)
    poses = chain_poses(relative)
    lines = [f"VERTEX_SE2 {name} {x} {y} {yaw}" for name, (x, y, yaw) in zip(ids, poses.tolist(), strict=True)]
    lines += [
        f"EDGE_SE2 {a} {b} {x} {y} {yaw} {INFORMATION}"
        for a, b, (x, y, yaw) in zip(ids[:-1], ids[1:], relative.tolist(), strict=True)
    ]
    x, y, yaw = between(chain_poses(relative - (0.0, 0.0, drift / len(turns)))[-1], np.zeros(3))
    lines.append(f"EDGE_SE2 {ids[-1]} {ids[0]} {x} {y} {yaw} {INFORMATION}")
    return lines, poses


def _chained(folder: Path, lines: list[str]) -> ChainedGraph:
    (path := folder / "graph.g2o").write_text("\n".join(lines) + "\n")
    return chained(read_g2o(path))


def _solved(graph: ChainedGraph) -> PlanarGraph:
    return graph.corrected(Robust().correct(graph.problem))


def test_ids_order_and_the_direction_of_steps_change_nothing(tmp_path: Path) -> None:
    lines, _ = _ring(list(range(16)))
    expected = _solved(_chained(tmp_path, lines))
    assert expected.belief[-1] == 1.0 and np.isnan(expected.belief[:-1]).all()
    others, _ = _ring([3 + 7 * k**2 for k in range(16)])
    shuffled = [others[k] for k in np.random.default_rng(0).permutation(len(others))]
    mixed = _solved(_chained(tmp_path, shuffled))
    np.testing.assert_allclose(mixed.poses, expected.poses, atol=1e-9)
    assert np.nanmax(mixed.belief) == 1.0 and np.isnan(mixed.belief).sum() == 15


def test_a_step_that_was_measured_backwards_says_the_same(tmp_path: Path) -> None:
    lines, _ = _ring(list(range(16)))
    graph = _chained(tmp_path, lines)
    relative, covariance = graph.problem.steps.relative[2], np.linalg.inv(graph.problem.steps.information[2])
    rng = np.random.default_rng(0)
    drawn = compose(relative, np.zeros((200_000, 3))) + rng.multivariate_normal(np.zeros(3), 1e-6 * covariance, 200_000)
    back = between(drawn, np.zeros(3))
    x, y, yaw = between(relative, np.zeros(3))
    upper = np.linalg.inv(np.cov(back.T) * 1e6)[np.triu_indices(3)].tolist()
    lines[16 + 2] = f"EDGE_SE2 3 2 {x} {y} {yaw} {' '.join(map(str, upper))}"
    turned = _chained(tmp_path, lines).problem.steps
    np.testing.assert_allclose(turned.relative[2], relative, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(turned.information[2]), covariance, atol=0.02 * covariance.max())


def test_vertices_without_a_line_begin_where_the_steps_put_them(tmp_path: Path) -> None:
    lines, poses = _ring(list(range(16)))
    edges = [line for line in lines if line.startswith("EDGE")]
    graph = _chained(tmp_path, edges)
    np.testing.assert_allclose(between(graph.problem.poses, poses), 0.0, atol=1e-9)
    del edges[3]
    with pytest.raises(ValueError, match="vertex 4 has no line, and no step leads to it from 3"):
        _chained(tmp_path, edges)


def test_parts_that_nothing_joins_are_both_solved(tmp_path: Path) -> None:
    (first, _), (second, _) = _ring(list(range(16))), _ring(list(range(100, 116)))
    graph = _chained(tmp_path, first + second)
    assert (graph.components, graph.breaks) == (2, 1)
    solved, alone = _solved(graph), _solved(_chained(tmp_path, first))
    for part in (slice(0, 16), slice(16, 32)):
        own = between(solved.poses[part.start], solved.poses[part])
        np.testing.assert_allclose(own, between(alone.poses[0], alone.poses), atol=1e-6)


def test_an_edge_that_is_marked_is_a_loop_and_one_without_heading_too(tmp_path: Path) -> None:
    lines, _ = _ring(list(range(16)))
    lines[16 + 3] += " # loop"
    lines[16 + 7] = lines[16 + 7].replace(INFORMATION, "100 3 0 80 0 0")
    graph = _chained(tmp_path, lines)
    assert graph.breaks == 2 and len(graph.problem.loops) == 3
    assert graph.problem.loops.degrees.tolist() == [3, 2, 3]


def test_the_fixed_vertex_stays_and_there_is_one(tmp_path: Path) -> None:
    lines, poses = _ring(list(range(16)))
    solved = _solved(_chained(tmp_path, [*lines, "FIX 9"]))
    assert solved.poses[9].tolist() == poses[9].tolist() and np.abs(solved.poses[0] - poses[0]).max() > 0.01
    with pytest.raises(ValueError, match="FIX holds 2 vertices, 9 first; expected one"):
        _chained(tmp_path, [*lines, "FIX 9", "FIX 3"])
