"""Batches from recordings in the form of ``training.data.streams``; an epoch follows from its number."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.utils.data import IterableDataset, get_worker_info

from ngo_recordings.errors import RecordingError
from training.data.batches import ALL, Batch, Share, mirrored, relative_poses, reversed_in_time
from training.data.data_source import Domain
from training.recordings.recording_source import RecordedData
from training.recordings.recording_tracks import Track

REPEATS = 2  # How often an epoch shows each pair of frames, at most.
FEWEST_PLACES = 50  # Frames that must be seen from where the robot was before, for places to be learned.
_BATCHES_AN_EPOCH = 100  # at least, where there are enough pairs: small data wants small batches
_SMALLEST_BATCH = 32
_MOST_PAIRS = 200_000
_RETURN_RADII = 10.0  # a place is seen again after a way of so many of its radii
_EACH_RADIUS = 8.0  # frames that count as different ones are a radius divided by this apart, or turned by a bit
_EACH_RAD = math.radians(5.0)


def side_information(track: Track, index: np.ndarray | slice) -> Batch:
    """Actions, with those before them, or velocities of some steps."""
    result = {}
    if track.histories is not None:
        result["action"] = track.histories[index]
    if track.twists is not None:
        result["twist"] = torch.from_numpy(np.array(track.twists[index]))
    return result


def known_side_information(domain: Domain, batch: Batch) -> Batch:
    """A batch without the control inputs that the domain's networks do not take."""
    unknown = {name for name, used in (("action", domain.actions > 0), ("twist", domain.twist)) if not used}
    return {name: value for name, value in batch.items() if name not in unknown}


class RecordedPairs(IterableDataset[Batch]):
    """Batches of consecutive frames, shuffled over all tracks; every second batch is mirrored, as in ``PairStream``."""

    def __init__(
        self, domain: Domain, tracks: Sequence[Track], epoch: int, datapoints: int, batch_size: int, share: Share = ALL
    ) -> None:
        self.domain, self.tracks, self.epoch, self.share = domain, tracks, epoch, share
        self.index = np.array([(k, step) for k, track in enumerate(tracks) for step in range(len(track) - 1)])
        wanted = min(datapoints, REPEATS * len(self.index))
        self.batch_size = min(batch_size, max(_SMALLEST_BATCH, wanted // _BATCHES_AN_EPOCH), len(self.index))
        self.count = max(1, wanted // self.batch_size)

    def __len__(self) -> int:
        return math.ceil(self.count / self.share.ranks)

    def __iter__(self) -> Iterator[Batch]:
        rng = np.random.default_rng([self.epoch, 1])
        passes = -(-self.count * self.batch_size // len(self.index))
        order = np.concatenate([rng.permutation(len(self.index)) for _ in range(passes)])
        worker = get_worker_info()
        own = range(self.share.rank, len(self) * self.share.ranks, self.share.ranks)
        for count in own if worker is None else list(own)[worker.id :: worker.num_workers]:
            chosen = np.take(order, np.arange(count * self.batch_size, (count + 1) * self.batch_size), mode="wrap")
            yield self._batch(self.index[chosen], count)

    def _batch(self, index: np.ndarray, count: int) -> Batch:
        parts = [pairs_at(self.tracks[k], np.sort(index[index[:, 0] == k, 1])) for k in np.unique(index[:, 0])]
        batch = known_side_information(
            self.domain, {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
        )
        if self.domain.reverses and count % 8 in (2, 5):
            batch = reversed_in_time(batch)
        return mirrored(batch) if self.domain.mirrors and count % 2 else batch


def pairs_at(track: Track, steps: np.ndarray) -> Batch:
    """Frames before and after some steps of a track, and the motion between them."""
    relative = relative_poses(track.poses_xyyaw)[torch.from_numpy(steps)]
    return {
        "earlier": track.frames(steps),
        "later": track.frames(steps + 1),
        "relative": relative,
        **side_information(track, steps),
    }


def track_pairs(domain: Domain, track: Track) -> list[Batch]:
    """All steps of a track in order, in batches."""
    parts = np.array_split(np.arange(len(track) - 1), -(-len(track) // 256))
    return [known_side_information(domain, pairs_at(track, steps)) for steps in parts]


class RecordedSteps:
    """The data of the local pose network."""

    def __init__(self, data: RecordedData, datapoints: int, batch_size: int) -> None:
        self.data, self.domain, self.datapoints, self.batch_size = data, data.domain, datapoints, batch_size
        self._validation: list[Batch] = []

    def pairs(self, epoch: int, share: Share) -> IterableDataset[Batch]:
        """One epoch."""
        return RecordedPairs(self.domain, self.data.tracks("train"), epoch, self.datapoints, self.batch_size, share)

    def validation(self) -> list[Batch]:
        """All steps of the parts that the networks do not learn from, in batches."""
        if not self._validation:
            for track in self.data.tracks("optimizer", "validation"):
                self._validation += track_pairs(self.domain, track)
        return self._validation

    def unseen(self) -> list[Batch]:
        """Steps to calibrate with: there are no others."""
        return self.validation()

    def typical(self) -> Tensor:
        """Relative poses of the training part."""
        return torch.cat([relative_poses(track.poses_xyyaw) for track in self.data.tracks("train")])


@dataclass(frozen=True)
class Revisited:
    """Pairs of frames of one recording that show one place, ``pairs`` ``(n, 2, 2)``: track and frame of each."""

    tracks: list[Track]
    pairs: np.ndarray

    @property
    def places(self) -> int:
        """How many different frames are in a pair."""
        return len(np.unique(self.pairs.reshape(-1, 2), axis=0))


def revisited(domain: Domain, tracks: Sequence[Track]) -> list[Revisited]:
    """For each recording the pairs of frames of one place, a way of ten place radii or more apart."""
    result = []
    for number in sorted({track.recording for track in tracks}):
        own = [track for track in tracks if track.recording == number]
        poses = np.concatenate([track.poses_xyyaw for track in own])
        index = np.array([(k, frame) for k, track in enumerate(own) for frame in range(len(track))])
        moved = np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
        along = np.concatenate(([0.0], np.cumsum(moved)))
        kept = _different(poses, along, domain.place_radius_m / _EACH_RADIUS)
        poses, index, along = poses[kept], index[kept], along[kept]
        near = cKDTree(poses[:, :2]).query_pairs(domain.place_radius_m, output_type="ndarray")
        near.sort(axis=1)
        turn = np.abs(np.remainder(poses[near[:, 0], 2] - poses[near[:, 1], 2] + np.pi, 2 * np.pi) - np.pi)
        apart = along[near[:, 1]] - along[near[:, 0]] >= _RETURN_RADII * domain.place_radius_m
        near = near[apart & (turn <= domain.heading_limit_rad)]
        if len(near) > _MOST_PAIRS:
            near = near[np.sort(np.random.default_rng(number).choice(len(near), _MOST_PAIRS, replace=False))]
        if len(near):
            result.append(Revisited(own, index[near]))
    return result


def _different(poses: np.ndarray, along: np.ndarray, each_m: float) -> np.ndarray:
    """Indices of frames without those that show what the one before shows: a robot may stand for minutes."""
    kept = [0]
    for k in range(1, len(poses)):
        turn = abs((poses[k, 2] - poses[kept[-1], 2] + math.pi) % math.tau - math.pi)
        if along[k] - along[kept[-1]] >= each_m or turn >= _EACH_RAD:
            kept.append(k)
    return np.array(kept)


class RecordedPlacePairs(IterableDataset[Batch]):
    """Batches of pairs of frames of one place, each from one recording; every second one is mirrored.

    As of ``PlaceStream``. Whether frames of two recordings show one place is not known, so no batch holds both.
    """

    def __init__(
        self,
        domain: Domain,
        found: Sequence[Revisited],
        epoch: int,
        batches: int,
        batch_size: int,
        share: Share = ALL,
    ) -> None:
        self.domain, self.found, self.epoch, self.share = domain, found, epoch, share
        self.batches, self.batch_size = batches, batch_size

    def __len__(self) -> int:
        return math.ceil(self.batches / self.share.ranks)

    def __iter__(self) -> Iterator[Batch]:
        worker = get_worker_info()
        own = range(self.share.rank, len(self) * self.share.ranks, self.share.ranks)
        weights = np.array([one.places for one in self.found], dtype=np.float64)
        for count in own if worker is None else list(own)[worker.id :: worker.num_workers]:
            rng = np.random.default_rng([self.epoch, 2, count])
            one = self.found[rng.choice(len(self.found), p=weights / weights.sum())]
            chosen = one.pairs[rng.choice(len(one.pairs), min(self.batch_size, len(one.pairs)), replace=False)]
            swap = rng.random(len(chosen)) < 0.5
            chosen[swap] = chosen[swap, ::-1]
            batch = _places(one.tracks, chosen)
            yield mirrored(batch) if self.domain.mirrors and count % 2 else batch


def _places(tracks: Sequence[Track], pairs: np.ndarray) -> Batch:
    def frames(side: int) -> Tensor:
        return torch.stack([tracks[k].frames(np.array([frame]))[0] for k, frame in pairs[:, side]])

    poses = [[tracks[k].poses_xyyaw[frame] for k, frame in pair] for pair in pairs]
    return {
        "a": frames(0),
        "b": frames(1),
        "poses": torch.from_numpy(np.array(poses)).float(),
        "maze": torch.zeros(len(pairs), dtype=torch.int64),
    }


class RecordedPlaces:
    """The data of the place encoder."""

    def __init__(self, data: RecordedData, batches: int, batch_size: int, validation_batches: int) -> None:
        self.domain, self.batch_size, self.validation_batches = data.domain, batch_size, validation_batches
        self.train = revisited(data.domain, data.tracks("train"))
        self.unseen = revisited(data.domain, data.tracks("optimizer", "validation"))
        self.places = sum(one.places for one in self.train)
        self.batches = min(batches, max(4, REPEATS * 2 * self.places // batch_size))
        self._validation: list[Batch] = []

    @property
    def too_few(self) -> str | None:
        """Why places cannot be learned, in words; None: they can."""
        if self.places >= FEWEST_PLACES:
            return None
        return (
            f"{self.places} frames of the training part show a place that the robot had passed before; expected "
            f"{FEWEST_PLACES} or more: drive rounds, or raise --place-radius-m ({self.domain.place_radius_m:.2f})"
        )

    def pairs(self, epoch: int, share: Share) -> IterableDataset[Batch]:
        """One epoch."""
        return RecordedPlacePairs(self.domain, self.train, epoch, self.batches, self.batch_size, share)

    def validation(self) -> list[Batch]:
        """Batches of the parts that the networks do not learn from; none where no place is seen twice there."""
        if not self._validation and self.unseen:
            count = min(self.validation_batches, max(1, sum(len(one.pairs) for one in self.unseen) // self.batch_size))
            self._validation = list(RecordedPlacePairs(self.domain, self.unseen, 0, count, self.batch_size))
        return self._validation


@dataclass(frozen=True)
class Windows:
    """Equally long stretches of tracks, of ``steps`` steps, each also in a mirror where that is allowed."""

    steps: int
    cuts: list[tuple[Track, bool]]


def windows(domain: Domain, tracks: Sequence[Track], most: int, fewest: int, block: int) -> Windows:
    """Windows that overlap, as long as most of the tracks allow, in whole blocks.

    Raises ``RecordingError`` where no track has ``fewest`` steps.
    """
    lengths = sorted((len(track) - 1 for track in tracks), reverse=True)
    total, along, steps = sum(lengths), 0, 0
    for length in lengths:  # half of all steps lie in tracks of this length or more
        steps, along = length, along + length
        if 2 * along >= total:
            break
    steps = min(steps, most) // block * block
    while True:
        if steps < fewest:
            raise RecordingError(
                f"the longest stretch without a gap has {max(lengths, default=0)} steps; expected {fewest} or more: "
                "record longer"
            )
        cuts = []
        for track in tracks:
            spare = len(track) - 1 - steps
            if spare >= 0:
                starts = np.unique(np.linspace(0, spare, 1 + min(7, spare // (4 * block))).astype(int))
                cuts += [track.cut(int(start), int(start) + steps + 1) for start in starts]
        if len(cuts) >= 4 or steps * 3 // 4 // block * block < fewest:
            break
        steps = steps * 3 // 4 // block * block
    sides = (False, True) if domain.mirrors else (False,)
    return Windows(steps, [(cut, side) for cut in cuts for side in sides])
