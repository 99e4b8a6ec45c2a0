"""Compute the optimizer's training data once: odometry, motion features and place codes of whole trajectories.

    python -m training.featurise --world maze2d
    python -m training.featurise --data drive_1.mcap drive_2.mcap --name my_robot

Images are far too many to keep (2000 a trajectory): what the local network and the place encoder make of them goes into
memory-mapped arrays, the features as float16. Run again, it goes on where it was stopped.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor
from tqdm import tqdm

from ngo_estimator.checkpoint import PlaceNetworks, load_local, load_place
from ngo_estimator.networks.local_pose_network import LocalPoseNetwork
from ngo_estimator.networks.pose_aggregation import PoseAggregationConfig
from training.common import runs
from training.data.data_source import OTHER_TRAIN_STORE, TRAIN_STORE, Domain
from training.data.drive_plan import Driven, driven_in_table
from training.data.streams import Batch, action_histories, images_of, mirrored
from training.data.worlds import DRAWN, OPTIMIZER_TRAIN_SEEDS, World, WorldName, world_named
from training.recordings.recording_source import RecordedArguments, check_source, open_recorded, run_script
from training.recordings.recording_streams import known_to, told, windows
from training.recordings.recording_tracks import Part, Track
from training.scoring.metrics import seen_from_first

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

_GROUP = 8  # mazes of one size
_MADE_WITH = "networks.json"
STORED = ("relative", "log_std", "motion", "codes", "origin_code", "truth")
"""The arrays of a feature store."""
_MOST_STEPS = 1000  # of a stretch of a recording
_CHUNK = 64  # steps at once: their activations stay in a CPU's cache (a fifth faster than 256)
_FOR_ONE_OTHER = 5  # trajectories of the world's driver
_BLOCK = PoseAggregationConfig(1).block


@dataclass(frozen=True)
class Arguments:
    """Settings of the feature store."""

    world: WorldName | None = None
    """World to train for."""
    recordings: tyro.conf.OmitArgPrefixes[RecordedArguments] = field(default_factory=RecordedArguments)
    """Recordings to train on instead."""
    trajectories: int = 960
    """Trajectories for training, each in a maze of its own that the local network has not seen; a fifth as many more of
    a driver that the optimizer alone learns from, where the world has one."""
    validation_trajectories: int = 24
    """Trajectories of the validation split for each table of results."""
    test_trajectories: int = 0
    """Trajectories of the test split for each table of results."""
    weights: Path = runs.WEIGHTS
    """Folder with NAME/local_pose_network.safetensors and NAME/place_encoder.safetensors."""
    out: Path = runs.ROOT / "runs"
    """Folder that gets NAME/features/."""
    part: int = 0
    """This process makes the groups of mazes whose number leaves this rest ..."""
    parts: int = 1
    """... when divided by this: several processes can share the work."""

    def __post_init__(self) -> None:
        check_source(self.world, self.recordings)


class Networks(NamedTuple):
    """What makes features of frames."""

    local: LocalPoseNetwork
    place: PlaceNetworks


def features_of(
    world: World, episode: Episode, weights: Path, networks: tuple[LocalPoseNetwork, PlaceNetworks] | None = None
) -> dict[str, np.ndarray]:
    """What the estimator makes of an episode in ``frames - 1`` steps, and the true poses after each of them."""
    local, place = networks or (load_local(weights, world.name)[0], load_place(weights, world.name)[0])
    images = images_of(world, episode)
    actions = {"action": action_histories(episode.actions)} if world.actions else {}
    return step_features(lambda index: images[index], actions, episode.poses_xyyaw, Networks(local, place))


def features_of_track(domain: Domain, track: Track, networks: Networks, mirror: bool = False) -> dict[str, np.ndarray]:
    """The same of a track of a recording, or of what its mirror image would have given."""
    told_steps = known_to(domain, told(track, slice(None)))
    poses = track.poses_xyyaw
    if mirror:
        told_steps, poses = mirrored(told_steps), seen_from_first(poses) * np.array([1.0, -1.0, -1.0])

    def frames(index: slice) -> Tensor:
        return track.frames(index).flip(-2) if mirror else track.frames(index)

    return step_features(frames, told_steps, poses, networks)


@torch.inference_mode()
def step_features(
    frames: Callable[[slice], Tensor], told_steps: Batch, poses_xyyaw: np.ndarray, networks: Networks
) -> dict[str, np.ndarray]:
    """Features of ``steps`` steps, the place code of the first frame, and the true poses after each step, seen from it.

    Args:
        frames: gives images of a range of frames ``(n, height, width, channels)``.
        told_steps: ``action`` ``(steps, n)``, the latest ones of each step, and ``twist`` ``(steps, 3)``, where the
            networks take them.
        poses_xyyaw: ``(steps + 1, 3)``.
    """
    parts: list[tuple[Tensor, ...]] = []
    for chunk in torch.arange(len(poses_xyyaw) - 1).split(_CHUNK):
        images = frames(slice(int(chunk[0]), int(chunk[-1]) + 2))
        side = {name: value[chunk] for name, value in told_steps.items()}
        relative, log_std, motion = networks.local(images[:-1], images[1:], side.get("action"), side.get("twist"))
        parts.append((relative, log_std, motion, networks.place.encoder(images[1:])))
    relative, log_std, motion, codes = (torch.cat(column).numpy() for column in zip(*parts, strict=True))
    return {
        "relative": relative,
        "log_std": log_std,
        "motion": motion.astype(np.float16),
        "codes": codes.astype(np.float16),
        "origin_code": networks.place.encoder(frames(slice(0, 1))).numpy().astype(np.float16),
        "truth": seen_from_first(poses_xyyaw)[1:],
    }


def driven_in(arguments: Arguments, world: World) -> dict[str, Driven]:
    """The trajectories of each store that is to be made."""
    seeds = list(OPTIMIZER_TRAIN_SEEDS[: arguments.trajectories])
    found = {TRAIN_STORE: Driven(seeds, seeds, DRAWN, world.driver)}
    if world.optimizer_driver is not None:
        others = list(OPTIMIZER_TRAIN_SEEDS[len(seeds) : len(seeds) + -(-len(seeds) // _FOR_ONE_OTHER)])
        found[OTHER_TRAIN_STORE] = Driven(others, others, DRAWN, world.optimizer_driver)
    for split, count in (("validation", arguments.validation_trajectories), ("test", arguments.test_trajectories)):
        for table in world.tables:
            found[f"{split}_{table}"] = driven_in_table(world, table, split, count)
    return found


def _groups(count: int, part: int, parts: int) -> list[int]:
    """The first trajectory of each group that falls to this process."""
    return list(range(0, count, _GROUP))[part::parts]


def main(arguments: Arguments) -> None:
    """Make the arrays ``WORLD/features/STORE/NAME.npy`` of shape ``(trajectories, steps, ...)``.

    The stores are ``train``, ``train_policy`` in worlds where the optimizer learns from another driver as well, and for
    each table of results ``validation_TABLE`` and ``test_TABLE``; of recordings ``train`` and ``validation``, stretches
    that overlap, and their mirror images.
    """
    if arguments.world is None:
        _main_recorded(arguments)
        return
    world = world_named(arguments.world)
    folder = arguments.weights / world.name
    local, local_description = load_local(folder, world.name)
    place, place_description = load_place(folder, world.name)
    features, chosen = arguments.out / world.name / "features", driven_in(arguments, world)
    for split, driven in chosen.items():
        _check_count(features / split, len(driven.seeds))
    for split, driven in chosen.items():
        if not driven.seeds:
            continue
        store = features / split
        store.mkdir(parents=True, exist_ok=True)
        check_networks(store, local_description, place_description)
        (store / _MADE_WITH).write_text(json.dumps([local_description["sha256"], place_description["sha256"]]))
        part = (arguments.part, arguments.parts)
        fill(store, world, driven, part, lambda e: features_of(world, e, folder, (local, place)))


def _check_count(store: Path, count: int) -> None:
    """Refuse to make a store of other trajectories than those it was begun with, before others are made."""
    path = store / "relative.npy"
    if count and path.exists() and (begun := len(np.load(path, mmap_mode="r"))) != count:
        raise runs.RunError(
            f"{store} was begun with {begun} trajectories, {count} are asked for; expected as many, or {store.parent} "
            "removed to make all stores anew"
        )


def _main_recorded(arguments: Arguments) -> None:
    data = open_recorded(arguments.recordings, arguments.out)
    folder = arguments.weights / data.domain.name
    local, local_description = load_local(folder, data.domain.name)
    place, place_description = load_place(folder, data.domain.name)
    stores: tuple[tuple[str, Part, int], ...] = (
        (TRAIN_STORE, "optimizer", 8 * _BLOCK),
        ("validation", "validation", 2 * _BLOCK),
    )
    data.check_trained(local.config)
    for name, part, fewest in stores:
        found = windows(data.domain, data.tracks(part), _MOST_STEPS, fewest, _BLOCK)
        store = arguments.out / data.domain.name / "features" / name
        # Made in minutes: rather anew than from several versions of networks or recordings.
        shutil.rmtree(store, ignore_errors=True)
        store.mkdir(parents=True)
        (store / _MADE_WITH).write_text(json.dumps([local_description["sha256"], place_description["sha256"]]))
        for row, (track, mirror) in enumerate(tqdm(found.cuts, desc=f"{data.domain.name} {name}")):
            for key, value in features_of_track(data.domain, track, Networks(local, place), mirror).items():
                _array(store / f"{key}.npy", (len(found.cuts), *value.shape), value.dtype)[row] = value
        (store / "done.0of1.json").write_text(json.dumps(list(range(0, len(found.cuts), _GROUP))))


def fill(
    store: Path,
    world: World,
    driven: Driven,
    part: tuple[int, int],
    arrays_of: Callable[[Episode], dict[str, np.ndarray]],
) -> None:
    """Make arrays of a store from the episodes in the mazes of ``seeds``, those of this process that are not done."""
    progress = store / f"done.{part[0]}of{part[1]}.json"
    mine = set(json.loads(progress.read_text())) if progress.exists() else set()
    done = mine | _done(store)
    for first in tqdm(_groups(len(driven.seeds), *part), desc=f"{world.name} {store.name}"):
        if first in done:
            continue
        for offset, episode in enumerate(driven.episodes(world, slice(first, first + _GROUP))):
            for key, value in arrays_of(episode).items():
                _array(store / f"{key}.npy", (len(driven.seeds), *value.shape), value.dtype)[first + offset] = value
        mine.add(first)
        progress.write_text(json.dumps(sorted(mine)))


def check_networks(store: Path, local_description: dict[str, Any], place_description: dict[str, Any]) -> None:
    """Raise ``RunError`` if what is in ``store`` was made with other networks than those described."""
    path, networks = store / _MADE_WITH, [local_description["sha256"], place_description["sha256"]]
    if path.exists() and json.loads(path.read_text()) != networks:
        raise runs.RunError(f"{store} was made with other networks than the present ones; remove it to make it anew")


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
        raise runs.RunError(f"{store} lacks {missing}; expected a feature store: {hint}")
    arrays: dict[str, np.ndarray] = {name: np.load(store / f"{name}.npy", mmap_mode="r") for name in stored}
    count = len(arrays["relative"])
    if left := set(range(0, count, _GROUP)) - _done(store):
        raise runs.RunError(f"{store} lacks {len(left)} of {-(-count // _GROUP)} groups of trajectories: {hint}")
    return arrays


def _done(store: Path) -> set[int]:
    return {first for path in store.glob("done.*.json") for first in json.loads(path.read_text())}


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
        raise runs.RunError(f"{path} is of shape {array.shape}; expected {shape}: remove its folder to make it anew")
    return array


if __name__ == "__main__":
    run_script(main, Arguments, __doc__)
