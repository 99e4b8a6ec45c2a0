"""Make the feature store: odometry, motion features and place codes of whole trajectories.

    python -m training.featurise --world maze2d
    python -m training.featurise --data drive_1.mcap drive_2.mcap --name my_robot

Smoother and optimizer learn from this store. Images of a trajectory are not kept: the local network and the place
encoder turn them into features once, in memory-mapped arrays. Run it again to continue after a stop.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from ngo_estimator.checkpoint import PlaceNetworks, load_local, load_place
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from training.common import records
from training.common.command_line import run_command
from training.data.data_source import MIRRORED_STORE, OTHER_TRAIN_STORE, TRAIN_STORE
from training.data.drive_plan import Drives, drives_of_table
from training.data.episodes import mirrored_episode
from training.data.feature_store import begin_store, check_count, fill, groups_of, write_row
from training.data.features import Networks, features_of
from training.data.worlds import DRAWN, OPTIMIZER_TRAIN_SEEDS, World, world_named
from training.recordings.recording_features import features_of_track
from training.recordings.recording_source import DataArguments, TrainedLocal, open_recorded
from training.recordings.recording_streams import windows
from training.recordings.recording_tracks import Part

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

_MOST_STEPS = 1000  # of a stretch of a recording
_FOR_ONE_OTHER = 5  # trajectories of the world's driver
_BLOCK = PoseAggregationConfig(1).block


@dataclass(frozen=True)
class Arguments(DataArguments):
    """Settings of the feature store."""

    trajectories: int = 960
    """Training trajectories, each in a maze that the local network has not seen. Some worlds add a fifth of this
    number, driven by another driver, for the optimizer alone."""
    mirror_drives: bool = False
    """Worlds: whether they are kept a second time, as a mirror shows them, for the memory of the local network."""
    validation_trajectories: int = 24  # Trajectories of the validation split for each table of results.
    test_trajectories: int = 0  # Trajectories of the test split for each table of results.
    weights: Path = records.WEIGHTS
    """Folder with NAME/local_pose_network.safetensors and NAME/place_encoder.safetensors."""
    out: Path = records.ROOT / "runs"  # Folder that gets NAME/features/.
    part: int = 0  # Number of this process, from 0, where several share the work.
    parts: int = 1  # Number of processes that share the work.


def planned_drives(arguments: Arguments, world: World) -> dict[str, Drives]:
    """The trajectories of each store."""
    seeds = list(OPTIMIZER_TRAIN_SEEDS[: arguments.trajectories])
    found = {TRAIN_STORE: Drives(seeds, seeds, DRAWN, world.driver)}
    if arguments.mirror_drives:
        found[MIRRORED_STORE] = found[TRAIN_STORE]
    if world.optimizer_driver is not None:
        others = list(OPTIMIZER_TRAIN_SEEDS[len(seeds) : len(seeds) + -(-len(seeds) // _FOR_ONE_OTHER)])
        found[OTHER_TRAIN_STORE] = Drives(others, others, DRAWN, world.optimizer_driver)
    for split, count in (("validation", arguments.validation_trajectories), ("test", arguments.test_trajectories)):
        for table in world.tables:
            found[f"{split}_{table}"] = drives_of_table(world, table, split, count)
    return found


def main(arguments: Arguments) -> None:
    """Make the arrays ``WORLD/features/STORE/NAME.npy`` of shape ``(trajectories, steps, ...)``.

    The stores are ``train``, ``train_policy`` in worlds where the optimizer learns from another driver as well, and for
    each table of results ``validation_TABLE`` and ``test_TABLE``; of recordings ``train`` and ``validation``, stretches
    that overlap, and their mirror images.
    """
    folder, name = arguments.weights / arguments.name, arguments.name
    local, place = load_local(folder, name), load_place(folder, name)
    if arguments.world is None:
        _of_recordings(arguments, local, place)
        return
    world, networks = world_named(arguments.world), (local[0], place[0])
    features, chosen = arguments.out / name / "features", planned_drives(arguments, world)
    for split, drives in chosen.items():
        check_count(features / split, len(drives.seeds))
    for split, drives in chosen.items():
        if not drives.seeds:
            continue
        begin_store(features / split, local[1], place[1])

        def arrays_of(episode: Episode, in_mirror: bool = split == MIRRORED_STORE) -> dict[str, np.ndarray]:
            seen = mirrored_episode(world, episode) if in_mirror else episode
            return features_of(world, seen, folder, networks)

        fill(features / split, world, drives, (arguments.part, arguments.parts), arrays_of)


def _of_recordings(arguments: Arguments, local: TrainedLocal, place: tuple[PlaceNetworks, dict[str, Any]]) -> None:
    data = open_recorded(arguments.recordings, arguments.out, local)
    name, networks = arguments.name, Networks(local[0], place[0])
    if networks.place.config.image != networks.local.config.image:
        raise records.RunError(
            f"the place encoder of {name} takes {networks.place.config.image}, its local network "
            f"{networks.local.config.image}; expected one sensor: train the place encoder anew"
        )
    stores: tuple[tuple[str, Part, int], ...] = (
        (TRAIN_STORE, "optimizer", 8 * _BLOCK),
        ("validation", "validation", 2 * _BLOCK),
    )
    for split, part, fewest in stores:
        found = windows(data.domain, data.tracks(part), _MOST_STEPS, fewest, _BLOCK)
        store = arguments.out / name / "features" / split
        # Made in minutes: rather anew than from several versions of networks or recordings.
        shutil.rmtree(store, ignore_errors=True)
        begin_store(store, local[1], place[1])
        for row, (track, mirror) in enumerate(tqdm(found.cuts, desc=f"{name} {split}")):
            write_row(store, row, len(found.cuts), features_of_track(data.domain, track, networks, mirror))
        (store / "done.0of1.json").write_text(json.dumps(groups_of(len(found.cuts), 0, 1)))


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
