"""Random block mazes: Prim and Kruskal spanning trees, optional cycles, shortest paths and a picture.

A maze of `rows` x `cols` cells is drawn on (2 rows + 1) x (2 cols + 1) square blocks: cells stand at odd
(row, col), the block between two cells is free where they are connected, everything else is wall. Corridors
are one block wide and no 2 x 2 square is ever free, so the free blocks have exactly the cycles of the cells.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import networkx as nx
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Cell = tuple[int, int]
Edge = tuple[Cell, Cell]


@dataclass(frozen=True, eq=False)
class Maze:
    """A closed maze of square blocks. Its frame has its origin at the outer corner of block (0, 0), x along
    the columns and y along the rows.

    walls: bool (height, width), True where a block is wall; row 0 spans y in [0, block_m].
    block_m: side of a block and width of a corridor, in metres.
    """

    walls: npt.NDArray[np.bool_]
    block_m: float = 1.0

    def __post_init__(self) -> None:
        walls = np.array(self.walls, dtype=np.bool_)
        if walls.ndim != 2 or any(size < 5 or size % 2 == 0 for size in walls.shape):
            raise ValueError(f"walls has shape {walls.shape}; it must be 2-D with odd sizes of at least 5")
        if not (walls[[0, -1]].all() and walls[:, [0, -1]].all()):
            raise ValueError("walls is open at its border; every block of the outer ring must be wall")
        if not (np.isfinite(self.block_m) and self.block_m > 0):
            raise ValueError(f"block_m is {self.block_m!r}; it must be a finite number above 0")
        walls.setflags(write=False)
        object.__setattr__(self, "walls", walls)

    @property
    def size_m(self) -> tuple[float, float]:
        """(width, height) of the whole maze in metres, along x and y."""
        height, width = self.walls.shape
        return width * self.block_m, height * self.block_m

    @cached_property
    def graph(self) -> nx.Graph:
        """Free blocks as (row, col) nodes, with an edge between every two that share a side."""
        free = ~self.walls
        graph = nx.Graph()
        graph.add_nodes_from(map(tuple, np.argwhere(free).tolist()))
        for step in ((0, 1), (1, 0)):
            height, width = free.shape[0] - step[0], free.shape[1] - step[1]
            pairs = np.argwhere(free[:height, :width] & free[step[0] :, step[1] :])
            graph.add_edges_from(((row, col), (row + step[0], col + step[1])) for row, col in pairs.tolist())
        return graph

    def free_blocks(self) -> npt.NDArray[np.int64]:
        """(n, 2) the (row, col) of every free block, in row-major order."""
        return np.argwhere(~self.walls)

    def corners(self) -> npt.NDArray[np.int64]:
        """(4, 2) the (row, col) of the four corner cells."""
        height, width = self.walls.shape
        return np.array([(1, 1), (1, width - 2), (height - 2, 1), (height - 2, width - 2)], dtype=np.int64)

    def block_center(self, blocks: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """(..., 2) the centres x, y in metres of blocks (..., 2) given as (row, col)."""
        return (np.asarray(blocks, dtype=np.float64)[..., ::-1] + 0.5) * self.block_m

    def block_at(self, x: float, y: float) -> tuple[int, int]:
        """(row, col) of the block that holds the point x, y in metres; ValueError outside the maze."""
        width_m, height_m = self.size_m
        if not (0 <= x < width_m and 0 <= y < height_m):
            raise ValueError(f"the point ({x}, {y}) m is outside the maze of {width_m} x {height_m} m")
        return int(y // self.block_m), int(x // self.block_m)

    def wall_segments(self) -> npt.NDArray[np.float64]:
        """(n, 2, 2) both ends x, y, in metres, of every straight stretch of wall that bounds free blocks."""
        return wall_segments(self.walls) * self.block_m

    def shortest_path(self, start_block: Iterable[int], goal_block: Iterable[int]) -> npt.NDArray[np.int64]:
        """(n, 2) the (row, col) blocks from start to goal, both included, by Dijkstra's algorithm.

        Raises ValueError where an end is not a free block or no path joins the two.
        """
        start, goal = tuple(map(int, start_block)), tuple(map(int, goal_block))
        for name, block in (("start_block", start), ("goal_block", goal)):
            if block not in self.graph:
                raise ValueError(f"{name} is {block}; it must be the (row, col) of a free block of this maze")
        try:
            return np.array(nx.dijkstra_path(self.graph, start, goal), dtype=np.int64)
        except nx.NetworkXNoPath as error:
            raise ValueError(f"no path joins block {start} and block {goal}") from error


MOST_CELLS = 100  # Rows or columns of the largest maze: a mistyped size is said at once, not met as minutes of waiting.


def check_maze_size(rows: int, cols: int, extra_openings: int) -> None:
    """Raise a ValueError that names the field, the value and what is allowed, where no such maze exists."""
    for name, value in (("rows", rows), ("cols", cols)):
        integer = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not (integer and 2 <= value <= MOST_CELLS):
            raise ValueError(f"{name} is {value!r}; it must be an integer from 2 to {MOST_CELLS}")
    # Cells have rows (cols - 1) + cols (rows - 1) walls between them and a spanning tree opens rows cols - 1.
    most = (rows - 1) * (cols - 1)
    integer = isinstance(extra_openings, (int, np.integer)) and not isinstance(extra_openings, bool)
    if not (integer and 0 <= extra_openings <= most):
        raise ValueError(
            f"extra_openings is {extra_openings!r}; it must be an integer from 0 to {most} "
            f"in a maze of {rows} x {cols} cells"
        )


def prim_maze(rows: int, cols: int, rng: np.random.Generator, extra_openings: int = 0, block_m: float = 1.0) -> Maze:
    """A random maze grown by Prim's algorithm with random weights: many short dead ends.

    extra_openings walls are opened on top of the spanning tree; each adds exactly one cycle.
    """
    check_maze_size(rows, cols, extra_openings)
    start = (int(rng.integers(rows)), int(rng.integers(cols)))
    reached = {start}
    tree: list[Edge] = []
    frontier: list[Edge] = [(start, cell) for cell in _neighbours(start, rows, cols)]
    while frontier:
        # An edge of the frontier at random equals independent weights; the swap keeps the pop O(1).
        pick = int(rng.integers(len(frontier)))
        frontier[pick], frontier[-1] = frontier[-1], frontier[pick]
        near, far = frontier.pop()
        if far in reached:
            continue
        reached.add(far)
        tree.append((near, far))
        frontier.extend((far, cell) for cell in _neighbours(far, rows, cols) if cell not in reached)
    return _build(rows, cols, tree, rng, extra_openings, block_m)


def kruskal_maze(rows: int, cols: int, rng: np.random.Generator, extra_openings: int = 0, block_m: float = 1.0) -> Maze:
    """A random maze by Kruskal's algorithm with random weights: longer, winding corridors.

    extra_openings walls are opened on top of the spanning tree; each adds exactly one cycle.
    """
    check_maze_size(rows, cols, extra_openings)
    edges = _all_edges(rows, cols)
    joined = nx.utils.UnionFind((row, col) for row in range(rows) for col in range(cols))
    tree: list[Edge] = []
    for index in rng.permutation(len(edges)).tolist():
        first, second = edges[index]
        if joined[first] != joined[second]:
            joined.union(first, second)
            tree.append((first, second))
    return _build(rows, cols, tree, rng, extra_openings, block_m)


MODULE_CELLS = 2  # Cells along a side of the module that ``repeated_maze`` repeats.


def check_aliased(aliased: bool, rows: int, cols: int, extra_openings: int) -> None:
    """Raise a ValueError where no aliased maze has this size."""
    if aliased and (rows % MODULE_CELLS or cols % MODULE_CELLS or extra_openings):
        raise ValueError(
            f"rows, cols, extra_openings are {rows}, {cols}, {extra_openings}; an aliased maze has multiples of "
            f"{MODULE_CELLS}, {MODULE_CELLS} and no extra openings"
        )


def repeated_maze(rows: int, cols: int, rng: np.random.Generator, block_m: float = 1.0) -> Maze:
    """An aliased maze: one random module of 2 x 2 cells over and over, joined by the same openings everywhere.

    Only the maze's border tells two modules apart. Raises ValueError where rows or cols are no multiples of a module.
    """
    check_maze_size(rows, cols, 0)
    check_aliased(True, rows, cols, 0)
    module = prim_maze(MODULE_CELLS, MODULE_CELLS, rng).walls[:-1, :-1].copy()
    module[2 * rng.integers(MODULE_CELLS) + 1, 0] = module[0, 2 * rng.integers(MODULE_CELLS) + 1] = False
    walls = np.pad(np.tile(module, (rows // MODULE_CELLS, cols // MODULE_CELLS)), ((0, 1), (0, 1)))
    walls[[0, -1]] = walls[:, [0, -1]] = True
    return Maze(walls=walls, block_m=block_m)


def draw_maze(axes: Axes, maze: Maze, colors: npt.ArrayLike | None = None) -> None:
    """Draw the maze on matplotlib axes as one image, in metres, y up.

    Walls are dark grey, or of colors (height, width, 3) in [0, 1], one a block.
    """
    wall = np.full((*maze.walls.shape, 3), 0.25) if colors is None else np.asarray(colors, dtype=np.float64)
    if wall.shape != (*maze.walls.shape, 3):
        raise ValueError(f"colors has shape {wall.shape}; it must be {(*maze.walls.shape, 3)}")
    width_m, height_m = maze.size_m
    axes.imshow(
        np.where(maze.walls[..., None], wall, 1.0),
        origin="lower",
        interpolation="nearest",
        zorder=0,
        extent=(0.0, width_m, 0.0, height_m),
    )
    axes.set(aspect="equal", xlim=(0.0, width_m), ylim=(0.0, height_m), xlabel="x [m]", ylabel="y [m]")


def wall_segments(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """(n, 2, 2) both ends x, y, in blocks, of every straight stretch between wall and free blocks (height, width)."""
    return np.concatenate((_segments_along_x(walls), _segments_along_x(walls.T)[..., ::-1]))


def _segments_along_x(walls: npt.NDArray[np.bool_]) -> npt.NDArray[np.float64]:
    """(n, 2, 2) the ends x, y, in blocks, of the longest straight walls along x with one free side."""
    # Between row i and row i + 1: which of them alone is free, +1 the first, -1 the second, 0 both or none.
    free_side = np.diff(walls.astype(np.int8), axis=0)
    line, last = np.nonzero(np.diff(free_side, axis=1))
    begins, ends_here = free_side[line, last + 1] != 0, free_side[line, last] != 0
    starts = np.stack((last[begins] + 1, line[begins] + 1), axis=-1)
    ends = np.stack((last[ends_here] + 1, line[ends_here] + 1), axis=-1)
    return np.stack((starts, ends), axis=1).astype(np.float64)


def _neighbours(cell: Cell, rows: int, cols: int) -> list[Cell]:
    row, col = cell
    around = ((row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1))
    return [(r, c) for r, c in around if 0 <= r < rows and 0 <= c < cols]


def _all_edges(rows: int, cols: int) -> list[Edge]:
    along_x = [((row, col), (row, col + 1)) for row in range(rows) for col in range(cols - 1)]
    along_y = [((row, col), (row + 1, col)) for row in range(rows - 1) for col in range(cols)]
    return along_x + along_y


def _build(
    rows: int, cols: int, tree: list[Edge], rng: np.random.Generator, extra_openings: int, block_m: float
) -> Maze:
    """Carve the tree's edges and extra_openings of the edges it leaves."""
    used = {frozenset(edge) for edge in tree}
    spare = [edge for edge in _all_edges(rows, cols) if frozenset(edge) not in used]
    opened = [spare[index] for index in rng.permutation(len(spare))[:extra_openings].tolist()]
    walls = np.ones((2 * rows + 1, 2 * cols + 1), dtype=np.bool_)
    walls[1::2, 1::2] = False
    for (row_a, col_a), (row_b, col_b) in tree + opened:
        walls[row_a + row_b + 1, col_a + col_b + 1] = False
    return Maze(walls=walls, block_m=block_m)
