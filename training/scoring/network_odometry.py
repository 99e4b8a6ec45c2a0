"""The odometry of rows with a network of their own, on the trajectories of a table."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import LOCAL, load_local
from training.baselines.deepvo import DEEPVO, load_deepvo, trajectory_steps
from training.common import records
from training.data.batches import seen_from_first
from training.data.drive_plan import drives_of_table
from training.data.episodes import images_of
from training.data.feature_store import fill, open_store
from training.scoring.table_rows import ROWS, Sources

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

ARRAYS = ("relative", "truth")
"""Arrays of a store of odometry: steps, and true poses after each of them, ``(trajectories, steps, 3)``."""

_MADE_WITH = "networks.json"
_TOGETHER = 256  # pairs of frames that go through a network at once


def open_odometry(store: Path) -> dict[str, np.ndarray]:
    """The ``ARRAYS`` of a whole store, memory-mapped; raises ``RunError`` if it is not whole."""
    return open_store(store, stored=ARRAYS)


def make_odometry(row: str, sources: Sources, split: str, table: str, count: int) -> None:
    """Drive through the first ``count`` trajectories of a table and keep what a row's own network makes of them.

    Raises:
        RunError: the store was made with another network.
    """
    own, world = sources.of_row(row, 0), sources.world
    steps_of, sha256 = _network(str(ROWS[row].odometry), own.networks, world.name)
    store = own.store_folder(split, table)
    made_with = store / _MADE_WITH
    if made_with.exists() and json.loads(made_with.read_text()) != [sha256]:
        raise records.RunError(f"{store} was made with another network than the present one; remove it to make it anew")
    store.mkdir(parents=True, exist_ok=True)
    made_with.write_text(json.dumps([sha256]))

    def arrays_of(episode: "Episode") -> dict[str, np.ndarray]:
        relative = steps_of(images_of(world, episode)).numpy()
        return {"relative": relative, "truth": seen_from_first(episode.poses_xyyaw)[1:]}

    fill(store, world, drives_of_table(world, table, split, count), (0, 1), arrays_of)


def _network(kind: str, folder: Path, world: str) -> tuple[Callable[[Tensor], Tensor], str]:
    """A function from images ``(steps + 1, height, width, channels)`` to steps ``(steps, 3)``, and the hash."""
    if kind == DEEPVO:
        deepvo, description = load_deepvo(folder, world)
        return lambda images: trajectory_steps(deepvo, images), description["sha256"]
    if kind != LOCAL:
        raise ValueError(f"kind is {kind!r}; expected {LOCAL} or {DEEPVO}")
    local, description = load_local(folder, world)

    @torch.inference_mode()
    def steps_of(images: Tensor) -> Tensor:
        pairs = zip(images[:-1].split(_TOGETHER), images[1:].split(_TOGETHER), strict=True)
        steps = [local(earlier, later) for earlier, later in pairs]
        return local.remembered(*(torch.cat(part) for part in zip(*steps, strict=True)))[0]

    return steps_of, description["sha256"]
