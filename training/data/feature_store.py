"""The feature store: memory-mapped arrays of whole trajectories, filled by one process or several."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from training.common import records
from training.data import episodes
from training.data.data_source import Domain
from training.data.drive_plan import Drives
from training.data.worlds import World

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

STORED = ("relative", "log_std", "motion", "codes", "origin_code", "truth")  # The arrays of a feature store.

NETWORKS_FILE = "networks.json"  # File of a store with the hashes of the networks that made its features.


def groups_of(count: int, part: int, parts: int) -> list[int]:
    """The first trajectory of each group that falls to this process."""
    return list(range(0, count, episodes.GROUP))[part::parts]


def check_count(store: Path, count: int) -> None:
    """Raise ``RunError`` where a store was begun with another number of trajectories."""
    path = store / "relative.npy"
    if count and path.exists() and (begun := len(np.load(path, mmap_mode="r"))) != count:
        raise records.RunError(
            f"{store} was begun with {begun} trajectories, {count} are asked for; expected as many, or {store.parent} "
            "removed to make all stores anew"
        )


def fill(
    store: Path,
    world: World,
    drives: Drives,
    part: tuple[int, int],
    arrays_of: Callable[[Episode], dict[str, np.ndarray]],
) -> None:
    """Drive the trajectories of a store that are not done yet, and write what ``arrays_of`` makes of each.

    Args:
        part: number of this process and how many processes share the work.
    """
    progress = store / f"done.{part[0]}of{part[1]}.json"
    mine = set(json.loads(progress.read_text())) if progress.exists() else set()
    done = mine | _done(store)
    for first in tqdm(groups_of(len(drives.seeds), *part), desc=f"{world.name} {store.name}"):
        if first in done:
            continue
        for offset, episode in enumerate(drives.episodes(world, slice(first, first + episodes.GROUP))):
            write_row(store, first + offset, len(drives.seeds), arrays_of(episode))
        mine.add(first)
        progress.write_text(json.dumps(sorted(mine)))


def check_networks(store: Path, local_description: dict[str, Any], place_description: dict[str, Any]) -> None:
    """Raise ``RunError`` if what is in ``store`` was made with other networks than those described."""
    path, networks = store / NETWORKS_FILE, [local_description["sha256"], place_description["sha256"]]
    if path.exists() and json.loads(path.read_text()) != networks:
        raise records.RunError(f"{store} was made with other networks than the present ones; remove it to make it anew")


def begin_store(store: Path, local_description: dict[str, Any], place_description: dict[str, Any]) -> None:
    """Make the folder of a store, or go on with it, for features of these networks; raises as ``check_networks``."""
    check_networks(store, local_description, place_description)
    store.mkdir(parents=True, exist_ok=True)
    (store / NETWORKS_FILE).write_text(json.dumps([local_description["sha256"], place_description["sha256"]]))


def training_stores(
    folder: Path,
    names: Sequence[str],
    domain: Domain,
    local_description: dict[str, Any],
    place_description: dict[str, Any],
) -> tuple[list[Path], list[Path]]:
    """The stores of these names in ``folder``, and those to be measured on; raises as ``check_networks``."""
    train, validation = ([folder / name for name in some] for some in (names, domain.validation_stores))
    for store in (*train, *validation):
        check_networks(store, local_description, place_description)
    return train, validation


def open_store(store: Path, stored: Sequence[str] = STORED) -> dict[str, np.ndarray]:
    """The arrays of a whole feature store, memory-mapped; raises ``RunError`` if it is not whole."""
    hint = "run `python -m training.featurise` first, with as many trajectories as the other stores were made with"
    if missing := [name for name in stored if not (store / f"{name}.npy").exists()]:
        raise records.RunError(f"{store} lacks {missing}; expected a feature store: {hint}")
    arrays: dict[str, np.ndarray] = {name: np.load(store / f"{name}.npy", mmap_mode="r") for name in stored}
    count = len(arrays["relative"])
    groups = set(groups_of(count, 0, 1))
    if left := groups - _done(store):
        raise records.RunError(f"{store} lacks {len(left)} of {len(groups)} groups of trajectories: {hint}")
    return arrays


def write_row(store: Path, row: int, rows: int, arrays: dict[str, np.ndarray]) -> None:
    """Write the arrays of one trajectory of ``rows``."""
    for name, value in arrays.items():
        stored_array(store / f"{name}.npy", (rows, *value.shape), value.dtype)[row] = value


def _done(store: Path) -> set[int]:
    return {first for path in store.glob("done.*.json") for first in json.loads(path.read_text())}


def stored_array(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    """A memory-mapped array to write to, made where there is none; raises ``RunError`` if it has another shape."""
    if not path.exists():
        # Under its name only once it is whole, and never over the one that another process has begun to fill.
        unfinished = path.with_name(f"{path.name}.{os.getpid()}")
        np.lib.format.open_memmap(unfinished, "w+", dtype, shape).flush()
        with contextlib.suppress(FileExistsError):
            os.link(unfinished, path)
        unfinished.unlink()
    array: np.memmap = np.load(path, mmap_mode="r+")
    if array.shape != shape:
        raise records.RunError(f"{path} is of shape {array.shape}; expected {shape}: remove its folder to make it anew")
    return array
