"""Fit what tells input that is unlike what the networks learned from.

    python -m training.train_familiarity --world maze2d
    python -m training.train_familiarity --data drive_1.mcap drive_2.mcap --name my_robot

The networks stay as they are. Statistics of their features, and the motion that actions or wheels tell, are fitted to
drives that the local network has not seen. Limits are the 99.9th percentiles on other drives. One factor says how much
deviations grow where input is unfamiliar. It is the smallest with which the truth lies within three deviations for 97 %
of the poses of drives with faults (frozen, repeating, noisy, lost and black input).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import FAMILIARITY, LOCAL, PLACE, load_local, load_place
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.networks.familiarity import (
    DISTANCES,
    NO_LIMIT,
    Familiarity,
    FamiliarityConfig,
    change,
    look,
    look_size,
    told_vector,
)
from training.common import records
from training.common.command_line import check_at_least, run_command
from training.common.training import save_weights
from training.data.batches import action_histories, relative_poses, seen_from_first
from training.data.episodes import simulate
from training.data.faults import FAULTS, SensedDrive, faulted
from training.data.features import Networks
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, VALIDATION_SEEDS, World, world_named
from training.recordings.recording_source import DataArguments, open_recorded
from training.scoring.consistency import estimates_of, odometry_covariances
from training.scoring.metrics import within

FACTORS = (0.7, 1.0, 1.4, 2.0)
"""Factors that are tried. Less than the first is not consistent on Doom maps that nothing was trained on."""

_WANTED = 0.97
_MARGIN = 1.25
"""Recordings are few: other drives of the place exceed the percentile of one by up to 15 %, faults 4 to 30 times."""
_NEEDS_TOLD = ("frozen", "repeating")  # such frames are familiar: only who is told of motion can know
_WINDOWS = (64, 256)  # steps over which errors of what is told are counted: those that last grow with them
_CLEAR = 0.1  # of the deviation of steps: what tells a component this well is taken alone
_CHUNK = 64


@dataclass(frozen=True)
class Arguments(DataArguments):
    """Settings of the fit."""

    drives: int = 64  # Worlds: drives that are fitted to, each in a maze that the local network has not seen.
    limit_drives: int = 32  # Worlds: validation drives that give the limits.
    fault_drives: int = 4  # Drives that get each fault.
    frames: int = 400  # Frames of a drive.
    weights: Path = records.WEIGHTS  # Folder with NAME/*.safetensors, which gets NAME/familiarity.safetensors.
    out: Path = records.ROOT / "runs"  # Folder of recordings that were read.

    def __post_init__(self) -> None:
        super().__post_init__()
        check_at_least(self, drives=1, limit_drives=1, fault_drives=1, frames=2 * _WINDOWS[0])


@dataclass(frozen=True)
class Seen:
    """What the networks make of a drive of ``n`` steps; the names are those of ``Familiarity.distances``."""

    looks: Tensor
    motions: Tensor
    told: Tensor
    relative: Tensor
    change: Tensor
    truth: Tensor


def main(arguments: Arguments) -> Familiarity:
    """Fit, write ``familiarity.safetensors`` and its JSON, and return it."""
    name = arguments.name
    folder = arguments.weights / name
    (local, about_local), (place, about_place) = load_local(folder, name), load_place(folder, name)
    networks = Networks(local, place)
    if arguments.world is None:
        data = open_recorded(arguments.recordings, arguments.out, (local, about_local))
        fitted, limiting = (
            [SensedDrive(track.frames(slice(None)), track.poses_xyyaw, track.actions, track.twists) for track in tracks]
            for tracks in (data.tracks("optimizer"), data.tracks("validation"))
        )
    else:
        world = world_named(arguments.world)
        fitted, limiting = _simulated(world, arguments)
    size, motion_size = look_size(place.encoder), local.config.feature_size
    config = FamiliarityConfig(size, motion_size, local.config.actions, local.config.twist)
    with torch.inference_mode():
        seen = [see(networks, config, drive) for drive in fitted if len(drive.poses_xyyaw) > 1]
        held_out = [see(networks, config, drive) for drive in limiting if len(drive.poses_xyyaw) > 1]
    familiarity = fit(config, seen, held_out, _MARGIN if arguments.world is None else 1.0)
    long = [drive for drive in limiting if len(drive.poses_xyyaw) >= 2 * _WINDOWS[0]][: arguments.fault_drives]
    disagreement, shares = fit_disagreement(networks, familiarity, name, long)
    familiarity = with_config(familiarity, dataclasses.replace(familiarity.config, disagreement=disagreement))
    details: dict[str, Any] = {
        f"{LOCAL}_sha256": about_local["sha256"],
        f"{PLACE}_sha256": about_place["sha256"],
        "training": records.record("train_familiarity", arguments),
        "metrics": {"validation": {f"within_three_deviations_{kind}": share for kind, share in shares.items()}},
    }
    save_weights(folder, familiarity, FAMILIARITY, details)
    limits = {kind: round(limit, 3) for kind, limit in zip(DISTANCES, familiarity.config.limits, strict=True)}
    print(f"{name}: limits {limits}, factor {disagreement}, within three deviations {shares}")
    if missed := inconsistent(shares):
        print(f"{name}: deviations stay too small with {missed}: the largest factor, {FACTORS[-1]}, is not enough")
    return familiarity


def _simulated(world: World, arguments: Arguments) -> tuple[list[SensedDrive], list[SensedDrive]]:
    from training.data.doom_drives import CALIBRATION  # training on recordings does without the simulators

    def drives(seeds: Iterable[int]) -> list[SensedDrive]:
        # Each in a maze of a size of its own, as they are drawn from the first seed.
        return [
            SensedDrive.of_episode(world, episode)
            for seed in seeds
            for episode in simulate(driven(world, seed), [seed], arguments.frames)
        ]

    first = len(VALIDATION_SEEDS) // 2 - arguments.limit_drives  # no table takes these
    fitted = OPTIMIZER_TRAIN_SEEDS[: -CALIBRATION if world.name == "doom" else None]  # training levels alone
    return drives(fitted[-arguments.drives :]), drives(VALIDATION_SEEDS[first : first + arguments.limit_drives])


def driven(world: World, seed: int) -> World:
    """The world; for every third seed with the driver from whom the optimizer learns as well, where there is one."""
    if world.optimizer_driver is None or seed % 3:
        return world
    return dataclasses.replace(world, driver=world.optimizer_driver)


def see(networks: Networks, config: FamiliarityConfig, drive: SensedDrive) -> Seen:
    """What the networks make of a drive."""
    images, parts = drive.images, []
    actions = None if drive.actions is None or not config.actions else action_histories(drive.actions)
    twists = None if drive.twists is None or not config.twist else torch.from_numpy(np.array(drive.twists)).float()
    for at in torch.arange(len(images) - 1).split(_CHUNK):
        earlier, later = images[at], images[at + 1]
        some = None if actions is None else actions[at], None if twists is None else twists[at]
        told = told_vector(config, *some, len(at))
        parts.append(
            (
                look(networks.place.encoder.early(later)),
                told,
                change(earlier, later),
                *networks.local(earlier, later, *some),
            )
        )
    looks, told_steps, changes, *steps = (torch.cat(column) for column in zip(*parts, strict=True))
    relative, _ = networks.local.remembered(*steps)
    return Seen(looks, steps[2], told_steps, relative, changes, relative_poses(drive.poses_xyyaw))


def fit(config: FamiliarityConfig, seen: list[Seen], held_out: list[Seen], margin: float = 1.0) -> Familiarity:
    """Fit everything but ``disagreement``; limits are ``margin`` times the 99.9th percentile of the held-out drives."""
    familiarity = Familiarity(config)
    looks, motions, told, truth = (
        torch.cat([getattr(one, name) for one in seen]) for name in ("looks", "motions", "told", "truth")
    )
    familiarity.fit(looks, motions, told, truth)
    spread = truth.std(0).clamp(min=1e-6)
    residual = (truth - familiarity.told_motion(told)).std(0).clamp(min=1e-6)
    share = torch.where(residual < _CLEAR * spread, 1.0, 0.5) * config.is_told
    std = residual  # where nothing is told, it is the motion of a step, and those of a stretch add up
    if config.is_told:
        std = torch.maximum(residual, told_std([(familiarity.told_motion(one.told), one.truth) for one in seen]))
    usual = float(torch.cat([one.change for one in seen]).median())
    config = dataclasses.replace(
        config, usual_change=max(usual, 1e-9), told_std=tuple(std.tolist()), told_share=tuple(share.tolist())
    )
    familiarity = with_config(familiarity, config)
    averaged = [running_mean(distances_of(familiarity, one), config.memory) for one in held_out]
    limits = np.percentile(np.concatenate(averaged), 99.9, axis=0)
    limits = np.where(limits > 0.0, margin * limits, NO_LIMIT)
    return with_config(familiarity, dataclasses.replace(config, limits=tuple(map(float, limits))))


def told_std(pairs: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Deviation of a step ``(3,)`` whose independent errors add up to those of told motions over windows of steps.

    The largest one of all windows, for errors that last add up faster.
    """
    found = torch.zeros(3)
    for window in _WINDOWS:
        squares = []
        for told, truth in pairs:
            for at in range(0, len(told) - window + 1, window // 2):
                ends = [se2.r2g(steps[at : at + window].double())[-1] for steps in (told, truth)]
                squares.append(se2.wrapped(se2.between(*ends)).square())
        if squares:
            mean = torch.stack(squares).mean(0)
            std = torch.cat((mean[:2].mean().expand(2), mean[2:])).div(window).sqrt().float()
            found = torch.maximum(found, std)
    return found


def distances_of(familiarity: Familiarity, seen: Seen) -> np.ndarray:
    """Distances ``(n, 4)`` of a drive."""
    with torch.inference_mode():
        found: np.ndarray = (
            familiarity.distances(seen.looks, seen.motions, seen.told, seen.relative, seen.change).double().numpy()
        )
    return found


def running_mean(distances: np.ndarray, memory: int) -> np.ndarray:
    """The mean of distances ``(n, 4)`` as ``FamiliarityWatch`` keeps it."""
    mean, found = np.zeros(distances.shape[1]), []
    for row in distances:
        mean = mean + (row - mean) / memory
        found.append(mean)
    return np.stack(found)


def with_config(familiarity: Familiarity, config: FamiliarityConfig) -> Familiarity:
    """The same tensors with another configuration."""
    changed = Familiarity(config)
    changed.load_state_dict(familiarity.state_dict())
    return changed


def fit_disagreement(
    networks: Networks, familiarity: Familiarity, world: str, drives: list[SensedDrive]
) -> tuple[float, dict[str, float]]:
    """The smallest factor with which drives with each fault are consistent, and the shares of their poses within.

    Without drives nothing is known of any factor: it stays as it is, and there are no shares.
    """
    if not drives:
        return familiarity.config.disagreement, {}
    kinds = [kind for kind in FAULTS if familiarity.config.is_told or kind not in _NEEDS_TOLD]
    shares: dict[str, float] = {}
    for factor in FACTORS:
        config = dataclasses.replace(familiarity.config, disagreement=factor)
        core = LocalOdometry(networks.local, networks.place, world, with_config(familiarity, config))
        shares = {kind: float(np.mean([_share(core, *one, kind) for one in enumerate(drives)])) for kind in kinds}
        if min(shares.values()) >= _WANTED:
            return factor, shares
    return FACTORS[-1], shares


def inconsistent(shares: dict[str, float]) -> str:
    """The faults with which too few poses are within three deviations, and their shares; empty where there are none."""
    return ", ".join(f"{kind} ({share:.1%})" for kind, share in shares.items() if share < _WANTED)


def _share(core: LocalOdometry, seed: int, drive: SensedDrive, kind: str) -> float:
    steps = estimates_of(core, faulted(drive, kind, len(drive.poses_xyyaw) // 4, seed))
    odometry = np.stack([step.odom_xyyaw for step in steps])
    return within(odometry, odometry_covariances(odometry, steps), seen_from_first(drive.poses_xyyaw)[1:])


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
