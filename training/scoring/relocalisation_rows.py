"""The rows of the table of relocalisation: ways to say where a robot is in a map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.slam.localisation import Localiser
from ngo_estimator.slam.place_matcher import PlaceMatcher
from training.data.worlds import World
from training.scoring.kidnapped import FRAMES, Features, KnownMap, Row
from training.scoring.online_estimate import steps_of

RowName = Literal["ours", "nearest_code"]

ROWS: tuple[RowName, ...] = ("ours", "nearest_code")

LEAST_SIMILARITY = {"maze2d": 0.99, "maze3d": 0.99}
"""Similarity of the nearest code from which on its pose is claimed, as chosen on validation mazes."""


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
    return {"ours": _ours, "nearest_code": _nearest_code}[name](networks, known, second)


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
