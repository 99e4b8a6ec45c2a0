"""The rows of the table of relocalisation: ways to say where a robot is in a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.loops.pair_measurement import VIEWS, PairViews, measure_pairs
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.slam.localisation import Localiser
from ngo_estimator.slam.place_matcher import PlaceMatcher
from training.data.worlds import World
from training.scoring.kidnapped import FRAMES, Features, KnownMap, Row
from training.scoring.online_estimate import steps_of

RowName = Literal["ours", "nearest_code", "oracle_place"]

ROWS: tuple[RowName, ...] = ("ours", "nearest_code", "oracle_place")

LEAST_SIMILARITY = {"maze2d": 0.99, "maze3d": 0.99}
"""Similarity of the nearest code from which on its pose is claimed, as chosen on validation mazes."""

_TURN_M = 0.5  # of a place: what a turn of one radian counts where the nearest frame is chosen


@dataclass(frozen=True)
class Networks:
    """What our rows take of a world's weights."""

    world: str
    pair_head: PairHead
    search: LoopSearch

    @classmethod
    def load(cls, world: World, weights: Path) -> Networks:
        """The networks in the folder of all weights."""
        optimizer, _ = load_optimizer(weights / world.name, world.name)
        place, _ = load_place(weights / world.name, world.name)
        return cls(world.name, place.pair_head, optimizer.config.search)


def row_of(name: str, networks: Networks, known: KnownMap, second: Features) -> Row:
    """The row called ``name``, prepared for a map and a second drive."""
    makers = {
        "ours": _ours,
        "nearest_code": _nearest_code,
        "oracle_place": _oracle_place,
    }
    return makers[name](networks, known, second)


def _ours(networks: Networks, known: KnownMap, second: Features) -> Row:
    places = PlaceMap(known.poses, known.codes, np.zeros(len(known.codes), np.int64))
    localiser = Localiser(PlaceMatcher(networks.pair_head, places, networks.search))
    steps = list(steps_of(second))

    def claims(start: int) -> list[np.ndarray | None]:
        localiser.reset()
        chosen = steps[start : start + FRAMES]
        return [localiser.update(step, step.relative_xyyaw, step.covariance).pose_xyyaw for step in chosen]

    return claims


@torch.inference_mode()
def _nearest_code(networks: Networks, known: KnownMap, second: Features) -> Row:
    codes = [torch.from_numpy(x.astype(np.float32)) for x in (second["codes"], known.codes)]
    seen, mapped = map(networks.pair_head.embed, codes)
    similarity, nearest = (seen @ mapped.T).max(dim=1)
    least = LEAST_SIMILARITY[networks.world]
    poses = [known.poses[k] if value >= least else None for value, k in zip(similarity.tolist(), nearest, strict=True)]
    return lambda start: poses[start : start + FRAMES]


@torch.inference_mode()
def _oracle_place(networks: Networks, known: KnownMap, second: Features) -> Row:
    """The truly nearest frame of the map, known by a miracle, and the measurement of the pair where it is believed."""
    truth, mapped = second["poses"][1:], known.truth
    turn = np.abs((truth[:, None, 2] - mapped[None, :, 2] + np.pi) % (2.0 * np.pi) - np.pi)
    away = np.linalg.norm(truth[:, None, :2] - mapped[None, :, :2], axis=-1) + _TURN_M * known.place_m * turn
    earlier, later = torch.from_numpy(away.argmin(1)), torch.arange(len(truth))
    views = _views(networks, known, second, earlier, later)
    measured, logit = measure_pairs(networks.pair_head, views, networks.search.registrations)
    poses = se2.compose(torch.from_numpy(known.poses)[earlier], measured.measured.double()).numpy()
    claimed = [pose if value > 0.0 else None for pose, value in zip(poses, logit.tolist(), strict=True)]
    return lambda start: claimed[start : start + FRAMES]


def _views(networks: Networks, known: KnownMap, second: Features, earlier: Tensor, later: Tensor) -> PairViews:
    """Views of pairs of frames of the map and steps of the second drive, as of pairs of one trajectory."""
    mapped, codes = (torch.from_numpy(x.astype(np.float32)) for x in (known.codes, second["codes"]))
    poses, odometry = torch.from_numpy(known.poses), se2.r2g(torch.from_numpy(second["relative"].astype(np.float64)))
    offsets = VIEWS[: networks.search.views]
    a = [(earlier + before).clamp(0, len(poses) - 1) for before, _ in offsets]
    b = [(later + before).clamp(0, len(odometry) - 1) for _, before in offsets]
    return PairViews(
        torch.stack([mapped[at] for at in a]),
        torch.stack([codes[at] for at in b]),
        torch.stack([se2.between(poses[earlier], poses[at]) for at in a]).float(),
        torch.stack([se2.between(odometry[at], odometry[later]) for at in b]).float(),
    )
