"""Sightings by place codes: a frame compared with the frames of a map, as the search for loops compares two frames.

Candidates look most like the newest frame, or lie near where it should be. The pair head measures them, and their
ranges are registered.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.relative_step import UNFAMILIAR, RelativeStep
from ngo_estimator.data.row_buffers import SlidingRows
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.loops.overlaps import LEAST_SHARED, OVERLAP_LOGIT, shared_views
from ngo_estimator.loops.pair_measurement import (
    OVERLAP_VIEWS,
    VIEWS,
    PairMeasurement,
    PairViews,
    measure_overlaps,
    measure_pairs,
)
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.loop_gates import RobustLoopGate
from ngo_estimator.slam.sightings import Sightings, SightingsAlone

_LOOK_PLACES = 0.4  # motion between frames that are compared (places)
_KEPT = 16  # frames: views reach back that far and less
_LOOKED_AT = 256  # most similar frames of the map, among which places are distinguished
_NEAR = 64  # frames around the expected pose whose ranges are compared
_APART_RAD = 0.5  # two frames that are turned so much from each other are two candidates
_FLOOR_M, _FLOOR_RAD = 1e-3, 1e-4  # of a sighting's deviations: the map is no better


class PlaceMatcher(SightingsAlone):
    """Compares frames by their place codes with those of a map.

    Args:
        search: of the loops, whose views and registration are taken.
        candidates: places that the newest frame is compared with.
    """

    def __init__(self, pair_head: PairHead, places: PlaceMap, search: LoopSearch, candidates: int = 8) -> None:
        if places.codes.shape[1] != pair_head.config.code_length:
            raise ValueError(
                f"place codes of the map have {places.codes.shape[1]} numbers; expected {pair_head.config.code_length}"
            )
        self.search_every = 1
        self.place_m = pair_head.config.offset_scale_m
        self.look_m = _LOOK_PLACES * self.place_m
        self._pair_head, self._search, self._candidates = pair_head, search, candidates
        self._poses = torch.from_numpy(places.poses.astype(np.float64))
        self._map_codes = torch.from_numpy(np.asarray(places.codes, np.float32))
        with torch.inference_mode():
            self._embeddings = pair_head.embed(self._map_codes)
        change = np.flatnonzero(np.diff(places.runs)) + 1
        first, end = np.append(0, change), np.append(change, len(places.runs))
        self._first = torch.from_numpy(np.repeat(first, end - first))
        self._last = torch.from_numpy(np.repeat(end - 1, end - first))
        self.reset()

    def reset(self) -> None:
        """Forget all frames but those of the map."""
        self._codes = SlidingRows((self._map_codes.shape[1],), np.float32, _KEPT)
        self._odometry = SlidingRows((3,), np.float64, _KEPT)

    def append(self, step: RelativeStep, odometry: np.ndarray) -> bool:
        """Take the next frame and its pose ``(3,)`` by odometry; whether it is familiar, and worth a look."""
        self._codes.append(step.place_code)
        self._odometry.append(odometry)
        return step.unlikeness <= UNFAMILIAR

    @torch.inference_mode()
    def everywhere(self) -> Sightings:
        """Hypotheses of the newest frame's pose, wherever it may be."""
        return self._by_places(self._places(self._similarity()))

    @torch.inference_mode()
    def around(self, expected: np.ndarray) -> Sightings:
        """Hypotheses of the newest frame's pose, which should be near ``expected`` ``(3,)``."""
        there = torch.from_numpy(expected)
        return self._by_places(self._nearby(self._similarity(), there)).and_also(self._by_overlaps(there))

    def _similarity(self) -> Tensor:
        newest = torch.from_numpy(self._codes.slice(len(self._codes) - 1))
        return self._embeddings @ self._pair_head.embed(newest)[0]

    def _by_places(self, chosen: Tensor) -> Sightings:
        if len(chosen) == 0:
            return Sightings.none()
        views = self._views(chosen, VIEWS[: self._search.views])
        return self._seen_from(chosen, *measure_pairs(self._pair_head, views, self._search.registrations))

    def _places(self, similarity: Tensor) -> Tensor:
        """The most similar frames of the map, each of another place."""
        best = similarity.topk(min(_LOOKED_AT, len(similarity))).indices
        poses = self._poses[best]
        apart = torch.cdist(poses[:, :2], poses[:, :2]) > 0.5 * self.place_m
        apart |= se2.wrap(poses[:, None, 2] - poses[None, :, 2]).abs() > _APART_RAD
        left = torch.ones(len(best), dtype=torch.bool)
        chosen: list[int] = []
        while len(chosen) < self._candidates and bool(left.any()):
            first = int(left.int().argmax())
            chosen.append(first)
            left &= apart[first]
        return best[chosen]

    def _nearby(self, similarity: Tensor, expected: Tensor) -> Tensor:
        """The most similar frames of those around a pose."""
        near = (self._poses[:, :2] - expected[:2]).norm(dim=-1) < self.place_m
        near = near.nonzero()[:, 0]
        return near[similarity[near].topk(min(2, len(near))).indices]

    def _sharing(self, expected: Tensor) -> Tensor:
        """The frames of the map that share most of what should be seen at a pose."""
        scans = self._pair_head.config.registration
        if scans is None or self._search.registrations == 0:
            return torch.zeros(0, dtype=torch.int64)
        far = (self._poses[:, :2] - expected[:2]).norm(dim=-1)
        near = far.topk(min(_NEAR, len(far)), largest=False).indices
        ranges = self._ranges(self._map_codes[near])
        newest = self._ranges(torch.from_numpy(self._codes.slice(len(self._codes) - 1))).expand_as(ranges)
        share = shared_views(scans, ranges, newest, se2.between(self._poses[near], expected).float())
        best = share.topk(min(2, len(share)))
        return near[best.indices[best.values >= LEAST_SHARED]]

    def _by_overlaps(self, expected: Tensor) -> Sightings:
        scans, chosen = self._pair_head.config.registration, self._sharing(expected)
        if scans is None or len(chosen) == 0:
            return Sightings.none()
        views = self._views(chosen, OVERLAP_VIEWS)
        start = se2.between(self._poses[chosen], expected).float()
        of_ranges = views._replace(a=self._ranges(views.a), b=self._ranges(views.b))
        measured, registered = measure_overlaps(scans, of_ranges, start, self._search.registrations)
        found = self._seen_from(chosen, measured, torch.full((len(chosen),), OVERLAP_LOGIT))
        return found.where(registered.numpy())

    def _ranges(self, codes: Tensor) -> Tensor:
        return codes[..., self._pair_head.config.code_size :].contiguous()

    def _views(self, chosen: Tensor, offsets: tuple[tuple[int, int], ...]) -> PairViews:
        """Views of the pairs of these frames of the map and the newest frame."""
        newest = len(self._codes) - 1
        at = [torch.clamp(chosen + a, self._first[chosen], self._last[chosen]) for a, _ in offsets]
        recent = np.maximum(newest + np.array([b for _, b in offsets]), max(0, newest + 1 - _KEPT))
        codes = torch.from_numpy(self._codes.at(recent)).unsqueeze(1).expand(-1, len(chosen), -1)
        odometry = torch.from_numpy(self._odometry.at(recent))
        to_newest = se2.between(odometry, torch.from_numpy(self._odometry.slice(newest))).float()
        return PairViews(
            torch.stack([self._map_codes[index] for index in at]),
            codes,
            torch.stack([se2.between(self._poses[chosen], self._poses[index]) for index in at]).float(),
            to_newest.unsqueeze(1).expand(-1, len(chosen), -1),
        )

    def _seen_from(self, chosen: Tensor, measurement: PairMeasurement, logit: Tensor) -> Sightings:
        poses = se2.compose(self._poses[chosen], measurement.measured.double()).numpy()
        deviation = measurement.log_scale.double().exp().numpy()
        position = (RobustLoopGate.POSITION_NOISE * deviation[:, 0]) ** 2 + _FLOOR_M**2
        heading = (RobustLoopGate.HEADING_NOISE * deviation[:, 1]) ** 2 + _FLOOR_RAD**2
        covariance = np.stack((position, position, heading), axis=-1)[..., None] * np.eye(3)
        return Sightings(poses, covariance, torch.sigmoid(logit.double()).numpy())
