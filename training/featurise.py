"""Compute the optimizer's training data once: odometry, motion features and place codes of whole trajectories.

    python -m training.featurise --world maze2d

Images are far too many to keep (2000 a trajectory): what the local network and the place encoder make of them goes into
memory-mapped arrays, the features as float16. Run again, it goes on where it was stopped.
"""

import contextlib
import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local, load_place
from ngo_estimator.compass import Compass, load_compass, read_frames
from ngo_estimator.compass_closure import frames_to_read
from ngo_estimator.pose_aggregation import PoseAggregationConfig
from ngo_sim.episodes import Episode
from training import runs
from training.metrics import seen_from_first
from training.streams import images_of, simulate
from training.worlds import DRAWN, OPTIMIZER_TRAIN_SEEDS, MazeSize, World, WorldName, world_named

_GROUP = 8  # mazes of one size
_MADE_WITH = "networks.json"
_COMPASS = ("compass", "compass_log_scale")
_BLOCK = PoseAggregationConfig(1).block


@dataclass(frozen=True)
class Arguments:
    """Settings of the feature store."""

    world: WorldName
    """World to train for."""
    trajectories: int = 960
    """Trajectories for training, each in a maze of its own that the local network has not seen."""
    validation_trajectories: int = 24
    """Trajectories of the validation split for each table of results."""
    test_trajectories: int = 0
    """Trajectories of the test split for each table of results."""
    weights: Path = runs.WEIGHTS
    """Folder with WORLD/local_pose_network.safetensors and WORLD/place_encoder.safetensors."""
    out: Path = runs.ROOT / "runs"
    """Folder that gets WORLD/features/."""
    compass: Path | None = None
    """Folder with WORLD/compass.safetensors, for stores that also hold the readings of a compass."""
    part: int = 0
    """This process makes the groups of mazes whose number leaves this rest ..."""
    parts: int = 1
    """... when divided by this: several processes can share the work."""


@torch.inference_mode()
def features_of(world: World, episode: Episode, weights: Path, networks: tuple | None = None) -> dict[str, np.ndarray]:
    """What the estimator makes of an episode in ``frames - 1`` steps, and the true poses after each of them."""
    local, place = networks or (load_local(weights, world.name)[0], load_place(weights, world.name)[0])
    images = images_of(world, episode)
    actions = torch.from_numpy(episode.actions).long() if world.actions else None
    parts: list[tuple[torch.Tensor, ...]] = []
    for chunk in torch.arange(len(images) - 1).split(256):
        action = None if actions is None else actions[chunk]
        relative, log_std, motion = local(images[chunk], images[chunk + 1], action)
        parts.append((relative, log_std, motion, place.encoder(images[chunk + 1])))
    relative, log_std, motion, codes = (torch.cat(column).numpy() for column in zip(*parts, strict=True))
    return {
        "relative": relative,
        "log_std": log_std,
        "motion": motion.astype(np.float16),
        "codes": codes.astype(np.float16),
        "truth": seen_from_first(episode.poses_xyyaw)[1:],
    }


@torch.inference_mode()
def readings_of(world: World, compass: Compass, episode: Episode) -> dict[str, np.ndarray]:
    """What a compass reads in the ``frames_to_read`` of an episode."""
    frames = frames_to_read(len(episode.actions), _BLOCK)
    readings, log_scale = read_frames(compass, images_of(world, episode)[frames])
    return {"compass": readings.numpy(), "compass_log_scale": log_scale.numpy()}


def _groups(seeds: list[int], part: int, parts: int) -> Iterator[tuple[int, list[int]]]:
    for number, first in enumerate(range(0, len(seeds), _GROUP)):
        if number % parts == part:
            yield first, seeds[first : first + _GROUP]


def main(arguments: Arguments) -> None:
    """Make the arrays ``WORLD/features/STORE/NAME.npy`` of shape ``(trajectories, steps, ...)``.

    The stores are ``train`` and, for each table of results, ``validation_TABLE`` and ``test_TABLE``.
    """
    world = world_named(arguments.world)
    folder = arguments.weights / world.name
    local, local_description = load_local(folder, world.name)
    place, place_description = load_place(folder, world.name)
    splits = {"train": (list(OPTIMIZER_TRAIN_SEEDS[: arguments.trajectories]), DRAWN)}
    for split, count in (("validation", arguments.validation_trajectories), ("test", arguments.test_trajectories)):
        for table, size in world.tables.items():
            splits[f"{split}_{table}"] = (list(world.table_seeds(table, split)[:count]), size)
    for split, (seeds, size) in splits.items():
        if not seeds:
            continue
        store = arguments.out / world.name / "features" / split
        store.mkdir(parents=True, exist_ok=True)
        check_networks(store, local_description, place_description)
        (store / _MADE_WITH).write_text(json.dumps([local_description["sha256"], place_description["sha256"]]))
        part = (arguments.part, arguments.parts)
        _fill(store, "done", world, seeds, size, part, lambda e: features_of(world, e, folder, (local, place)))
        if arguments.compass is not None:
            compass, _ = load_compass(arguments.compass / world.name, world.name)
            _fill(store, "compass_done", world, seeds, size, part, partial(readings_of, world, compass))


def _fill(
    store: Path,
    name: str,
    world: World,
    seeds: list[int],
    size: MazeSize,
    part: tuple[int, int],
    arrays_of: Callable[[Episode], dict[str, np.ndarray]],
) -> None:
    """Make arrays of a store from the episodes in the mazes of ``seeds``, those of this process that are not done."""
    progress = store / f"{name}.{part[0]}of{part[1]}.json"
    mine = set(json.loads(progress.read_text())) if progress.exists() else set()
    done = mine | _done(store, name)
    groups = list(_groups(seeds, *part))
    for first, group in tqdm(groups, desc=f"{world.name} {store.name}"):
        if first in done:
            continue
        for offset, episode in enumerate(simulate(world, group, world.episode_frames + 1, size)):
            for key, value in arrays_of(episode).items():
                _array(store / f"{key}.npy", (len(seeds), *value.shape), value.dtype)[first + offset] = value
        mine.add(first)
        progress.write_text(json.dumps(sorted(mine)))


def check_networks(store: Path, local_description: dict[str, Any], place_description: dict[str, Any]) -> None:
    """Raise ``ValueError`` if what is in ``store`` was made with other networks than those described."""
    path, networks = store / _MADE_WITH, [local_description["sha256"], place_description["sha256"]]
    if path.exists() and json.loads(path.read_text()) != networks:
        raise ValueError(f"{store} was made with other networks than the present ones; remove it to make it anew")


def open_store(store: Path, with_compass: bool = False) -> dict[str, np.ndarray]:
    """The arrays of a whole feature store, memory-mapped; raises ``ValueError`` if it is not whole."""
    names = ["relative", "log_std", "motion", "codes", "truth", *(_COMPASS if with_compass else ())]
    hint = "run `python -m training.featurise` first"
    if missing := [name for name in names if not (store / f"{name}.npy").exists()]:
        raise ValueError(f"{store} lacks {missing}; expected a feature store: {hint}")
    arrays: dict[str, np.ndarray] = {name: np.load(store / f"{name}.npy", mmap_mode="r") for name in names}
    count = len(arrays["relative"])
    for name in ["done", *(["compass_done"] if with_compass else [])]:
        if left := set(range(0, count, _GROUP)) - _done(store, name):
            raise ValueError(f"{store} lacks {len(left)} of {-(-count // _GROUP)} groups of trajectories: {hint}")
    return arrays


def _done(store: Path, name: str) -> set[int]:
    return {first for path in store.glob(f"{name}.*.json") for first in json.loads(path.read_text())}


def _array(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.memmap:
    if not path.exists():
        # Under its name only once it is whole, and never over the one that another process has begun to fill.
        unfinished = path.with_name(f"{path.name}.{os.getpid()}")
        np.lib.format.open_memmap(unfinished, "w+", dtype, shape).flush()
        with contextlib.suppress(FileExistsError):
            os.link(unfinished, path)
        unfinished.unlink()
    array: np.memmap = np.load(path, mmap_mode="r+")
    if array.shape != shape:
        raise ValueError(f"{path} is of shape {array.shape}; expected {shape}: remove its folder to make it anew")
    return array


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
