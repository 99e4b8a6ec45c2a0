"""Tracks of recordings without gaps, and their split into parts that never meet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from training.data.batches import action_histories
from training.recordings.recording_store import StoredRecording

Part = Literal["train", "optimizer", "validation", "test"]
PARTS: tuple[Part, ...] = ("train", "optimizer", "validation", "test")

GAP_S = 2.0
"""Between two parts of one recording nothing is used for so long: frames on either side of a border look alike."""
SHORTEST = 16  # Frames of a track.
_LONG_STEP = 2.5  # times the usual one: frames are missing


@dataclass(frozen=True)
class Track:
    """Frames without a gap, each with its true pose and what led to it.

    recording, first: which recording, and which of its frames is the first. images: ``(frames, height, width,
    channels)``, memory-mapped. poses_xyyaw ``(frames, 3)``. actions ``(frames - 1,)`` int64 and twists ``(frames - 1,
    3)``, where there are any: of the step to the next frame.
    """

    recording: int
    first: int
    images: np.ndarray
    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray
    actions: np.ndarray | None
    twists: np.ndarray | None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def frames(self, index: np.ndarray | slice) -> Tensor:
        """Images of some frames."""
        return torch.from_numpy(np.array(self.images[index]))

    @cached_property
    def histories(self) -> Tensor | None:
        """The latest actions of each step, as ``streams.action_histories`` gives them: every batch asks for them."""
        return None if self.actions is None else action_histories(np.array(self.actions))

    def cut(self, start: int, stop: int) -> Track:
        """The frames from ``start`` to before ``stop``."""
        return Track(
            self.recording,
            self.first + start,
            self.images[start:stop],
            self.stamps_ns[start:stop],
            self.poses_xyyaw[start:stop],
            None if self.actions is None else self.actions[start : stop - 1],
            None if self.twists is None else self.twists[start : stop - 1],
        )


def period_s(recordings: Sequence[StoredRecording]) -> float:
    """Median time between two frames."""
    steps = np.concatenate([np.diff(recording.stamps_ns) for recording in recordings])
    return float(np.median(steps[steps > 0])) / 1e9 if (steps > 0).any() else 0.0


def tracks_of(number: int, stored: StoredRecording, period: float) -> list[Track]:
    """The stretches of a recording in which nothing is missing."""
    steps_s = np.diff(stored.stamps_ns) / 1e9
    whole = (steps_s > 0.0) & (steps_s < _LONG_STEP * period)
    if stored.with_actions:
        whole &= stored.actions[1:] >= 0
    if stored.with_twist:
        whole &= np.isfinite(stored.twists[1:]).all(axis=1)
    known = np.isfinite(stored.poses_xyyaw).all(axis=1)
    whole &= known[1:] & known[:-1]
    borders = np.flatnonzero(~whole) + 1
    everything = Track(
        number,
        0,
        stored.images,
        stored.stamps_ns,
        stored.poses_xyyaw,
        stored.actions[1:].astype(np.int64) if stored.with_actions else None,
        stored.twists[1:].astype(np.float32) if stored.with_twist else None,
    )
    pieces = zip([0, *borders], [*borders, len(stored.stamps_ns)], strict=True)
    return [everything.cut(int(a), int(b)) for a, b in pieces if b - a >= SHORTEST]


@dataclass(frozen=True)
class Split:
    """Which tracks are for what, and in words how they were chosen."""

    tracks: dict[Part, list[Track]]
    words: tuple[str, ...]


def split(
    recordings: Sequence[StoredRecording], tracks: Sequence[Sequence[Track]], holdout: Sequence[int], period: float
) -> Split:
    """Deal the tracks of each recording out to the parts.

    ``test`` are the recordings of ``holdout``; where none are named, the last one of several, or the last quarter of a
    single one. Of four recordings or more that are left, one is for validation and one (in five) for the optimizer; of
    fewer, the first 65 % of each are for the networks, then 25 % for the optimizer, and 10 % for validation. Parts of
    one recording have a gap of ``GAP_S`` between them.
    """
    shares: dict[int, list[tuple[Part, float, float]]] = {}
    test = list(holdout) or ([len(tracks) - 1] if len(tracks) > 1 else [])
    left = [number for number in range(len(tracks)) if number not in test]
    until = 1.0 if test else 0.75
    shares.update({number: [("test", 0.0, 1.0)] for number in test})
    if not test:
        shares[0] = [("test", until, 1.0)]
    if len(left) >= 4:
        for_optimizer = max(1, len(left) // 5)
        counts: tuple[tuple[Part, int], ...] = (
            ("train", len(left) - 1 - for_optimizer),
            ("optimizer", for_optimizer),
            ("validation", 1),
        )
        dealt = [part for part, count in counts for _ in range(count)]
        shares.update({n: [(part, 0.0, 1.0)] for n, part in zip(left, dealt, strict=True)})
    else:
        a, b = 0.65 * until, 0.90 * until
        for number in left:
            by_time: list[tuple[Part, float, float]] = [
                ("train", 0.0, a),
                ("optimizer", a, b),
                ("validation", b, until),
            ]
            shares.setdefault(number, []).extend(by_time)
    found: dict[Part, list[Track]] = {part: [] for part in PARTS}
    words = []
    half_gap = math.ceil(0.5 * GAP_S / period)
    for part in PARTS:
        parts = []
        for number in sorted(shares):
            for _, first, last in (share for share in shares[number] if share[0] == part):
                found[part] += within(len(recordings[number].stamps_ns), tracks[number], first, last, half_gap)
                parts.append(recordings[number].name + ("" if last - first == 1.0 else f" {first:.0%} to {last:.0%}"))
        count = sum(len(track) for track in found[part])
        words.append(f"{part}: {count} frames of {', '.join(parts) or 'nothing'}")
    return Split(found, tuple(words))


def within(frames: int, tracks: Sequence[Track], first: float, last: float, half_gap: int) -> list[Track]:
    """The tracks between two shares of a recording's frames, half a gap away from a border inside it."""
    start = round(first * frames) + (half_gap if first > 0.0 else 0)
    stop = round(last * frames) - (half_gap if last < 1.0 else 0)
    result = []
    for track in tracks:
        a, b = max(start - track.first, 0), min(stop - track.first, len(track))
        if b - a >= SHORTEST:
            result.append(track.cut(a, b))
    return result
