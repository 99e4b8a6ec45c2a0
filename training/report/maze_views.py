"""The mazes of a table's trajectories, for figures."""

import numpy as np
import torch

from ngo_estimator.geometry import se2
from ngo_sim.mazes import Maze
from training.data import episodes
from training.data.worlds import World


def maze_and_start(world: World, table: str, split: str, index: int) -> tuple[Maze, np.ndarray]:
    """The maze of a trajectory of a table's feature store, and its first pose ``(3,)`` in the maze."""
    mazes, seeds = world.table_mazes(table, split), world.table_seeds(table, split)
    first = mazes[index // episodes.GROUP * episodes.GROUP]
    env = world.make_random(np.random.default_rng(first), world.tables[table].size)
    options = {} if mazes[index] == seeds[index] else {"maze_seed": mazes[index]}
    try:
        _, info = env.reset(seed=seeds[index], options=options)
        unwrapped: object = env.unwrapped
        return unwrapped.maze, np.array(info["pose_xyyaw"])  # type: ignore[attr-defined]
    finally:
        env.close()


def in_maze(start: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Poses ``(steps, 3)`` seen from the first frame, as poses ``(steps + 1, 3)`` in the maze with that frame."""
    placed = se2.compose(torch.from_numpy(start), torch.from_numpy(np.array(poses, dtype=np.float64))).numpy()
    return np.concatenate((start[None], placed))
