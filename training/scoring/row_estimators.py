"""The estimators of the rows of the tables: from features to trajectories."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import load_optimizer, load_place, load_smoother
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import Loops, LoopSearch
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from training.baselines import loop_factors
from training.baselines.graph_settings import REGISTRATIONS, load_settings
from training.baselines.loop_factors import MoreLoops, Seen
from training.baselines.pose_graph import PoseGraphSettings, optimize
from training.scoring.table_rows import ROWS, Sources

Arrays = dict[str, np.ndarray]  # Arrays of a feature store ``(trajectories, steps, ...)``.

Array = TypeVar("Array", np.ndarray, Tensor)

_BLOCK = PoseAggregationConfig(1).block
_TOGETHER = 8  # trajectories that are optimised at once


@dataclass(frozen=True)
class Estimator:
    """One way to get trajectories: a function, and all that its result depends on beside code and data.

    ``poses`` maps arrays ``(trajectories, steps, ...)`` to global poses ``(trajectories, steps, 3)`` after each step,
    seen from the first frame, float64. ``identity`` names weights by their hash, and settings.
    """

    poses: Callable[[Arrays], np.ndarray]
    identity: str


Prepared = dict[tuple[int, int, LoopSearch], tuple[tuple[Tensor, Tensor], Loops]]
"""Odometry and loops of some trajectories, by the number of the first, their length and the search: the costly part,
and the same for all optimizers with one pair head and one search."""


def estimators(row: str, seeds: int, sources: Sources, prepared: Prepared | None = None) -> list[Estimator]:
    """The estimators of a row: one, or one for each training seed.

    ``prepared`` keeps what the rows of one table have in common; None where nothing is to be kept.
    """
    if row not in ROWS:
        raise ValueError(f"row is {row!r}; expected one of {', '.join(ROWS)}")
    kind = ROWS[row]
    if row == "local" or kind.odometry is not None:
        return [Estimator(local, row)]
    if kind.own_networks:
        own = sources.of_row(row, 0)
        return [_trained(own, own.networks)]
    if kind.form is not None:
        return [_trained(sources, sources.row_folder(row, seed), prepared) for seed in range(seeds)]
    place, description = load_place(sources.networks, sources.world.name)
    if row == "registered":
        return [Estimator(lambda arrays: registered(arrays, place.pair_head), f"{row} {description['sha256']}")]
    identity, smoother = f"{row} {description['sha256']} {place.config.registration}", None
    if kind.smoothed:
        smoother, smooths = load_smoother(sources.networks, sources.world.name)
        identity += f" {smooths['sha256']}"
        if row == "smoothed":
            return [Estimator(partial(smoothed, smoother), identity)]
    form = "registered" if kind.registered else "smoothed" if kind.smoothed else "loops"
    settings = load_settings(sources.settings_file(form))
    poses = pose_graph(settings, place.pair_head, kind.registered, smoother)
    return [Estimator(poses, f"{identity} {json.dumps(dataclasses.asdict(settings))}")]


def prefix(arrays: dict[str, Array], steps: int) -> dict[str, Array]:
    """The arrays after this number of steps; the first frame's place code stays."""
    return {name: array[:, :steps] for name, array in arrays.items()}


def local(arrays: Arrays) -> np.ndarray:
    """The odometry alone."""
    return se2.r2g(_float64(arrays["relative"])).numpy()


def registered(arrays: Arrays, pair_head: PairHead) -> np.ndarray:
    """The odometry as our optimizer takes it."""
    seen = seen_in(prefix(arrays, _whole(arrays["relative"].shape[1], _BLOCK)))
    steps, _ = loop_factors.registered_odometry(pair_head, seen, LoopSearch(registrations=REGISTRATIONS), _BLOCK)
    return _with_tail(se2.r2g(_float64(steps)), _float64(arrays["relative"])).numpy()


def smoothed(smoother: OdometrySmoother, arrays: Arrays) -> np.ndarray:
    """The odometry as our optimizer smooths it, from what was seen of each trajectory and nothing that follows."""
    whole = prefix(arrays, _whole(arrays["relative"].shape[1], _BLOCK))
    steps, _ = loop_factors.smoothed_odometry(smoother, whole["relative"], whole["log_std"], whole["motion"])
    return _with_tail(se2.r2g(_float64(steps)), _float64(arrays["relative"])).numpy()


def seen_in(arrays: Arrays, relative: np.ndarray | None = None) -> Seen:
    """Inputs of the search for loops, with the odometry of the arrays or another one."""
    steps = arrays["relative"] if relative is None else relative
    return Seen(steps, arrays["log_std"], arrays["codes"], arrays["origin_code"])


def _trained(sources: Sources, optimizer_folder: Path, prepared: Prepared | None = None) -> Estimator:
    place, description = load_place(sources.networks, sources.world.name)
    optimizer, trained = load_optimizer(optimizer_folder, sources.world.name)
    if trained.get("place_encoder_sha256") != description["sha256"]:
        raise ValueError(
            f"{optimizer_folder} was trained on features of other networks than the present ones; remove it to make "
            "it anew"
        )
    smooths = trained.get("odometry_smoother_sha256")  # where networks were tuned together, its copy has changed
    if smooths is not None and load_smoother(sources.networks, sources.world.name)[1]["sha256"] != smooths:
        raise ValueError(
            f"{optimizer_folder} has another smoother than the one in {sources.networks}; remove it to make it anew"
        )
    identity = f"{trained['sha256']} {description['sha256']} {place.config.registration}"
    return Estimator(optimized_by(optimizer, place.pair_head, prepared), identity)


def optimized_by(
    optimizer: NeuralGraphOptimizer,
    pair_head: PairHead,
    prepared: Prepared | None = None,
) -> Callable[[Arrays], np.ndarray]:
    """``optimize_offline`` for many trajectories at once; ``prepared`` is of the same ones and the same pair head."""

    def odometry_and_loops(first: int, whole: dict[str, Tensor]) -> tuple[tuple[Tensor, Tensor], Loops | None]:
        odometry = whole["relative"], whole["log_std"]
        if not optimizer.config.loops:
            return odometry, None
        key = first, odometry[0].shape[1], optimizer.config.search
        if prepared is not None and key in prepared:
            return prepared[key]
        odometry = optimizer.registered(*odometry, whole["codes"], pair_head, whole["origin_code"][:, 0])
        loops = optimizer.find_loops(odometry[0], whole["codes"], pair_head)
        if prepared is not None:
            prepared[key] = odometry, loops
        return odometry, loops

    @torch.inference_mode()
    def poses(arrays: Arrays) -> np.ndarray:
        parts = []
        for first in range(0, len(arrays["relative"]), _TOGETHER):
            some = {name: _float32(array[first : first + _TOGETHER]) for name, array in arrays.items()}
            whole = prefix(some, _whole(some["relative"].shape[1], optimizer.block))
            odometry, loops = odometry_and_loops(first, whole)
            result = optimizer(*odometry, whole["motion"], loops)
            parts.append(_with_tail(result.poses.double(), some["relative"].double()))
        return torch.cat(parts).numpy()

    return poses


def pose_graph(
    settings: PoseGraphSettings,
    pair_head: PairHead,
    registers: bool = False,
    smoother: OdometrySmoother | None = None,
) -> Callable[[Arrays], np.ndarray]:
    """The classical rows: GTSAM with the loops that are found, on odometry that is registered or smoothed before."""

    def poses(arrays: Arrays) -> np.ndarray:
        whole = prefix(arrays, _whole(arrays["relative"].shape[1], settings.block))
        seen = seen_in(whole, settings.calibrated(whole["relative"]))
        steps = whole["relative"], whole["log_std"]
        if registers:
            steps = loop_factors.registered_odometry(pair_head, seen, settings.search, settings.block)
        if smoother is not None:
            steps = loop_factors.smoothed_odometry(smoother, *steps, whole["motion"])
        loops = loop_factors.found_loops(pair_head, seen, settings.search, settings.block)
        more: Sequence[MoreLoops | None] = [None] * len(loops)
        if settings.search.overlaps:
            moved = settings.calibrated(steps[0])
            more = loop_factors.overlaps_of(pair_head, whole["codes"], moved, settings.search, settings.block)
        graphs = zip(*steps, loops, more, strict=True)
        solved = [optimize(relative, std, found, settings, of) for relative, std, found, of in graphs]
        left = torch.from_numpy(settings.calibrated(arrays["relative"]))
        return _with_tail(torch.from_numpy(np.stack(solved)), left).numpy()

    return poses


def _whole(steps: int, block: int) -> int:
    if steps < block:
        raise ValueError(f"{steps} steps make no meta-pose; expected at least {block}")
    return steps // block * block


def _with_tail(poses: Tensor, relative: Tensor) -> Tensor:
    """Poses of the first steps, followed by the odometry ``(trajectories, steps, 3)`` of the others."""
    left = relative[:, poses.shape[1] :]
    return poses if left.shape[1] == 0 else torch.cat((poses, se2.compose(poses[:, -1:], se2.r2g(left))), dim=1)


def _float32(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float32))


def _float64(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(array, dtype=np.float64))
