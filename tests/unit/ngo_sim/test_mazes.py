from collections import deque
from collections.abc import Callable

import networkx as nx
import numpy as np
import pytest

from ngo_sim.mazes import Maze, kruskal_maze, prim_maze, repeated_maze

ALGORITHMS = [prim_maze, kruskal_maze]
MakeMaze = Callable[..., Maze]


def maze_of(*rows_from_above: str, block_m: float = 1.0) -> Maze:
    """A maze from its picture: # is wall, the last line is row 0."""
    return Maze(np.array([[block == "#" for block in row] for row in reversed(rows_from_above)]), block_m)


HOOK = ("#######", "#     #", "##### #", "#     #", "#######")


@pytest.mark.parametrize("make", ALGORITHMS)
@pytest.mark.parametrize(("rows", "cols"), [(2, 2), (3, 8), (7, 7), (12, 5)])
def test_a_maze_without_extra_openings_is_a_tree_over_all_cells(make: MakeMaze, rows: int, cols: int) -> None:
    for seed in range(5):
        maze = make(rows, cols, np.random.default_rng(seed))
        assert maze.walls.shape == (2 * rows + 1, 2 * cols + 1)
        assert not maze.walls[1::2, 1::2].any(), "every cell is free"
        assert maze.walls[::2, ::2].all(), "every pillar is wall"
        assert len(maze.free_blocks()) == 2 * rows * cols - 1, "cells and the edges of their spanning tree"
        assert nx.is_tree(maze.graph)


@pytest.mark.parametrize("make", ALGORITHMS)
@pytest.mark.parametrize("extra_openings", [1, 3, 20])
def test_each_extra_opening_adds_exactly_one_cycle(make: MakeMaze, extra_openings: int) -> None:
    for seed in range(5):
        maze = make(5, 6, np.random.default_rng(seed), extra_openings)
        assert nx.is_connected(maze.graph)
        assert len(nx.cycle_basis(maze.graph)) == extra_openings


def test_blocks_and_metres_agree() -> None:
    maze = prim_maze(2, 4, np.random.default_rng(0), block_m=3.0)
    assert maze.size_m == (27.0, 15.0)
    assert maze.block_at(0.0, 2.9) == (0, 0), "row 0 spans y in [0, block_m]"
    assert maze.block_at(26.9, 3.0) == (1, 8)
    np.testing.assert_array_equal(maze.block_center([[0, 0], [1, 8]]), [[1.5, 1.5], [25.5, 4.5]])
    for block in maze.free_blocks():
        assert maze.block_at(*maze.block_center(block)) == tuple(block)
    for x, y in ((-0.1, 1.0), (1.0, 15.0), (27.0, 1.0), (float("nan"), 1.0)):
        with pytest.raises(ValueError, match=r"outside the maze of 27\.0 x 15\.0 m"):
            maze.block_at(x, y)


def test_corners_are_the_four_outermost_cells() -> None:
    maze = prim_maze(2, 4, np.random.default_rng(0))
    assert {tuple(corner) for corner in maze.corners()} == {(1, 1), (1, 7), (3, 1), (3, 7)}


def breadth_first_distance(walls: np.ndarray, start: tuple[int, int], goal: tuple[int, int]) -> int:
    distance, queue = {start: 0}, deque([start])
    while queue:
        row, col = queue.popleft()
        for block in ((row + 1, col), (row - 1, col), (row, col + 1), (row, col - 1)):
            if not walls[block] and block not in distance:
                distance[block] = distance[row, col] + 1
                queue.append(block)
    return distance[goal]


def test_paths_are_connected_free_and_shortest_where_there_are_cycles() -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        maze = kruskal_maze(6, 6, rng, extra_openings=8)
        start, goal = (tuple(map(int, block)) for block in rng.choice(maze.free_blocks(), 2))
        path = maze.shortest_path(start, goal)
        assert tuple(path[0]) == start and tuple(path[-1]) == goal
        assert not maze.walls[tuple(path.T)].any()
        assert (abs(np.diff(path, axis=0)).sum(axis=1) == 1).all()
        assert len(path) - 1 == breadth_first_distance(maze.walls, start, goal)


def test_a_path_needs_free_ends_that_are_joined() -> None:
    maze = maze_of(*HOOK)
    with pytest.raises(ValueError, match=r"start_block is \(2, 1\); it must be .* a free block"):
        maze.shortest_path((2, 1), (1, 1))
    with pytest.raises(ValueError, match=r"goal_block is \(9, 9\)"):
        maze.shortest_path((1, 1), (9, 9))
    walls = maze.walls.copy()
    walls[2, 5] = True
    with pytest.raises(ValueError, match="no path joins"):
        Maze(walls).shortest_path((1, 1), (3, 1))


def test_wall_segments_of_a_hook() -> None:
    # Outer walls inside, then both faces of the bar in the middle and its end.
    expected = {
        ((1, 1), (6, 1)),
        ((1, 4), (6, 4)),
        ((1, 2), (5, 2)),
        ((1, 3), (5, 3)),
        ((1, 1), (1, 2)),
        ((1, 3), (1, 4)),
        ((6, 1), (6, 4)),
        ((5, 2), (5, 3)),
    }
    segments = maze_of(*HOOK, block_m=2.0).wall_segments() / 2.0
    assert {tuple(sorted(tuple(map(int, end)) for end in segment)) for segment in segments} == expected
    assert len(segments) == len(expected)


def test_a_repeated_maze_is_connected_and_looks_the_same_from_module_to_module() -> None:
    for seed in range(20):
        maze = repeated_maze(6, 8, np.random.default_rng(seed))
        assert nx.is_connected(maze.graph)
        # Each module stands on 4 x 4 blocks, those at the border without openings to the outside.
        modules = maze.walls[:-1, :-1].reshape(3, 4, 4, 4).swapaxes(1, 2)
        inner = modules[1:, 1:]
        assert (inner == inner[0, 0]).all()
