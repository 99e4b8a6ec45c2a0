"""Loop search of a trajectory that grows: each new meta-pose is compared once, with the window and the key frames.

Candidates are chosen and measured as ``find_loops`` and ``find_overlaps`` do in a whole trajectory. A measurement is
made once and kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numba import njit
from torch import Tensor

from ngo_estimator.data.row_buffers import SlidingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import all_between
from ngo_estimator.graph.frames import Frames
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames
from ngo_estimator.loops.loop_closure import Loops, LoopSearch, may_show_one_place
from ngo_estimator.loops.overlaps import LEAST_SHARED, OVERLAP_LOGIT, shared_views
from ngo_estimator.loops.pair_measurement import OVERLAP_VIEWS, VIEWS, PairViews, measure_overlaps, registered
from ngo_estimator.loops.place_ambiguity import looks_like_everything, places_by_odometry
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.networks.place_encoder import PairHead

MARGIN = 4
"""Frames before and behind a block whose codes a key frame keeps, for the views of a loop."""

_KEY_FRAMES_PER_POSE = 2
"""Candidates among the key frames for each meta-pose."""

_MOST_TO_KEY_FRAMES = 128
"""Most loops from key frames to the window, and most loops between key frames."""

_Offsets = tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class _EarlierFrame:
    """An earlier frame to measure from: its node, number and similarity, and its pose ``(3,)`` seen from the node.

    ``codes`` and ``poses`` ``(views, ...)`` are of the frames near it, seen from the node.
    """

    node: int
    frame: int
    similarity: float
    pose: np.ndarray
    codes: np.ndarray
    poses: np.ndarray


@dataclass(frozen=True)
class _Candidates:
    """Earlier ``frames`` that look like the one before ``node``, the views of these pairs, and what the pair head says.

    ``measured`` ``(views, n, 3)``, ``log_scale`` ``(views, n, 2)`` and ``logit`` ``(views, n)`` are the pair head's.
    """

    frames: list[_EarlierFrame]
    node: int
    views: PairViews
    measured: Tensor
    log_scale: Tensor
    logit: Tensor


class OnlineLoops:
    """Finds and keeps the loops of a trajectory.

    Args:
        frames: of the trajectory; their owner appends to them.
        window: blocks in the window.
    """

    def __init__(self, pair_head: PairHead, search: LoopSearch, block: int, window: int, frames: Frames) -> None:
        self._pair_head, self._search, self._block = pair_head, search, block
        self._frames = frames
        keep = window * block + 2 * block + MARGIN
        self._codes = SlidingRows((pair_head.config.code_length,), np.float32, keep)
        self._embeddings = SlidingRows((pair_head.config.embedding_size,), np.float32, keep)
        self._kept = PlaceLoops.none()
        self._candidates: _Candidates | None = None
        # Pairs of nodes that stay apart: shared walls are looked for again in the newest blocks.
        self._dropped = np.zeros((0, 2), np.int64)

    def __len__(self) -> int:
        return len(self._kept)

    SAVED = ("_codes", "_embeddings", "_kept")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        frames, newest = len(self._frames) - 1, int(self._kept.end.max(initial=0)) * self._block
        require(len(self._codes) == len(self._embeddings) == frames, f"there are not {frames} place codes")
        require(newest <= frames, f"a loop ends at frame {newest} of {frames}")

    def append(self, place_code: np.ndarray) -> None:
        """Take the place code of the next frame; zeros are those of a frame that closes no loops."""
        self._codes.append(place_code)
        # ``look`` embeds all frames of a block at once.
        self._embeddings.append(np.zeros(self._pair_head.config.embedding_size, np.float32))

    def _embed(self, first: int) -> None:
        """Embed the codes after the steps of the block that begins with number ``first``."""
        codes = self._codes.slice(first, first + self._block)
        embeddings = self._pair_head.embed(torch.from_numpy(codes)).numpy()
        embeddings[~codes.any(axis=1)] = 0.0  # like nothing, not even like other such codes
        self._embeddings.replace(first, embeddings)

    def codes(self, first: int) -> np.ndarray:
        """Place codes ``(n, code_length)`` of the frames after the steps from number ``first`` on, without a copy."""
        return self._codes.slice(first)

    @torch.inference_mode()
    def look(self, block: int, first: int, keys: KeyFrames) -> None:
        """Look for earlier frames like the last one of the newest block, whose number is ``block``, for ``measure``.

        There are none where it looks like everything (``place_ambiguity``).

        Args:
            first: number of the first block in the window.
        """
        self._candidates = None
        offsets = VIEWS[: self._search.views]
        if frames := self._frames_alike(block, first, keys, offsets):
            views = self._views(frames, block + 1, offsets)
            self._candidates = _Candidates(frames, block + 1, views, *self._pair_head(views.a, views.b))

    def _frames_alike(self, block: int, first: int, keys: KeyFrames, offsets: _Offsets) -> list[_EarlierFrame]:
        """The candidates of ``look``; key frames last."""
        end, last = block + 1, block * self._block + self._block - 1
        self._embed(block * self._block)
        embedding = self._embeddings.slice(last)[0]
        if not embedding.any():
            return []
        in_window = np.arange(first, end - self._search.min_separation)
        frames = []
        if len(in_window):
            seen = self._embeddings.slice(first * self._block, (in_window[-1] + 1) * self._block)
            similarity = (seen @ embedding).reshape(-1, self._block)
            if self._looks_like_everything(similarity.reshape(-1), first * self._block):
                return []
            similarity = self._possible(similarity, in_window, last)
            for index, step, value in self._most_similar(similarity, in_window, self._search.per_pose):
                node = int(in_window[index])
                frames.append(self._in_window(node, node * self._block + step, value, last, offsets))
        if len(keys):
            similarity = self._possible(keys.embeddings @ embedding, keys.nodes, last)
            for index, step, value in self._most_similar(similarity, keys.nodes, _KEY_FRAMES_PER_POSE):
                frames.append(self._of_key_frame(keys.frame(index), step, value, offsets))
        return frames

    @torch.inference_mode()
    def measure(self) -> PlaceLoops:
        """Loops to the frames that ``look`` found last, measured by their places; those from key frames last."""
        candidates, self._candidates = self._candidates, None
        if candidates is None:
            return PlaceLoops.none()
        frames = candidates.frames
        measured = candidates.measured, candidates.log_scale
        measurement = registered(self._pair_head, candidates.views, *measured, self._search.registrations)
        of_frame = torch.from_numpy(np.stack([frame.pose for frame in frames])).float()
        found = PlaceLoops.found(
            np.array([frame.node for frame in frames]),
            candidates.node,
            np.array([frame.frame for frame in frames]),
            measurement._replace(measured=se2.compose(of_frame, measurement.measured)),
            candidates.logit[0].double().numpy(),
            np.array([frame.similarity for frame in frames]),
            overlap=False,
        )
        self._kept = self._kept.extended(found)
        return found

    def _looks_like_everything(self, similarity: np.ndarray, first: int) -> bool:
        """Whether the newest frame looks like most places, by its similarity to the frames after step ``first`` on."""
        at = torch.from_numpy(self._frames.odometry[first + 1 : first + 1 + len(similarity), :2])
        places = places_by_odometry(at, 2.0 * self._pair_head.config.offset_scale_m)
        alike = torch.from_numpy(similarity)
        return bool(looks_like_everything(alike, places, torch.ones_like(alike, dtype=torch.bool)))

    def _possible(self, similarity: np.ndarray, blocks: np.ndarray, last: int) -> np.ndarray:
        """Similarity ``(n, frames)`` of the frames of blocks to the one after step ``last``, 0 for impossible ones."""
        if not self._search.drift_m:
            return similarity
        odometry, steps = self._frames.odometry, blocks[:, None] * self._block + np.arange(self._block)
        earlier, newest = (torch.from_numpy(odometry[number + 1]) for number in (steps, last))
        possible = may_show_one_place(se2.between(earlier, newest), torch.from_numpy(last - steps), self._search)
        return np.where(possible.numpy(), similarity, 0.0)

    def _most_similar(self, similarity: np.ndarray, blocks: np.ndarray, count: int) -> list[tuple[int, int, float]]:
        """Index in ``blocks``, frame of the block and value of the best of ``similarity`` ``(n, frames)``."""
        similarity = np.where(similarity == 0.0, -np.inf, similarity)  # frames that close no loops
        best = similarity.max(axis=1)
        found: list[tuple[int, int, float]] = []
        # As ``each_from_elsewhere``, whose calls of torch cost more than their arithmetic for a single row.
        while len(found) < min(count, len(best)) and (value := float(best[index := int(best.argmax())])) > -np.inf:
            found.append((index, int(similarity[index].argmax()), value))
            best[np.abs(blocks - blocks[index]) <= self._search.min_apart] = -np.inf
        return found

    def _in_window(self, node: int, frame: int, similarity: float, last: int, offsets: _Offsets) -> _EarlierFrame:
        """A frame of the window, seen from ``node``; ``last`` is the newest frame."""
        at = np.clip(frame + _at(offsets, 0), 0, last)
        odometry = self._frames.odometry
        poses = _seen_from(odometry[node * self._block], odometry[np.append(at, frame) + 1])
        return _EarlierFrame(node, frame, similarity, poses[-1], self._codes.at(at), poses[:-1])

    def _of_key_frame(self, key: KeyFrame, step: int, similarity: float, offsets: _Offsets) -> _EarlierFrame:
        """A frame that a key frame keeps: ``step`` steps behind the first frame of its block, -1 for its own frame."""
        before = max(0, MARGIN - key.node * self._block)
        at = np.clip(MARGIN + step + _at(offsets, 0), before, len(key.codes) - 1)
        frame = key.node * self._block + step
        return _EarlierFrame(key.node, frame, similarity, key.poses[MARGIN + step], key.codes[at], key.poses[at])

    def _views(self, frames: list[_EarlierFrame], node: int, offsets: _Offsets) -> PairViews:
        """Views of the pairs of these frames and the one before ``node``."""
        last = node * self._block - 1
        at = np.clip(last + _at(offsets, 1), 0, last)
        odometry = self._frames.odometry
        codes = torch.from_numpy(np.stack([frame.codes for frame in frames], axis=1))
        later = torch.from_numpy(self._codes.at(at)).unsqueeze(1).expand_as(codes)
        from_frame = np.stack([_seen_from(frame.pose, frame.poses) for frame in frames], axis=1)
        to_end = torch.from_numpy(_seen_from(odometry[at + 1], odometry[last + 1])).float().unsqueeze(1)
        return PairViews(codes, later, torch.from_numpy(from_frame).float(), to_end.expand(-1, len(frames), -1))

    @torch.inference_mode()
    def find_overlaps(self, block: int, first: int, nodes: np.ndarray, keys: KeyFrames | None = None) -> PlaceLoops:
        """Loops that end behind the block of this number, from nodes that share its walls under the current poses.

        They replace the overlaps from the window to this block that were found under earlier poses.

        Args:
            first: number of the first block in the window.
            nodes: poses of the nodes in the map ``(n, 3)``, those behind this block among them.
            keys: key frames to look among; by default none.
        """
        scans = self._pair_head.config.registration
        if scans is None or self._search.overlaps == 0:
            return PlaceLoops.none()
        end, last = block + 1, (block + 1) * self._block - 1
        before = self._kept.overlap & (self._kept.end == end) & (self._kept.start >= first)
        if before.any():
            self._kept = self._kept[~before]
        in_window = np.arange(max(1, first), end - self._search.min_separation + 1)
        # The origin, the first key frame, has no code of its own.
        frames = [] if keys is None else [keys.frame(k) for k in range(1, len(keys))]
        earlier = in_window if keys is None else np.concatenate((keys.nodes[1:], in_window))
        if len(earlier) == 0:
            return PlaceLoops.none()
        codes = np.concatenate(
            (*[key.codes[MARGIN - 1 : MARGIN] for key in frames], self._codes.at(in_window * self._block - 1))
        )
        relative = torch.from_numpy(_seen_from(nodes[earlier], nodes[end])).float()
        ranges, newest = (self._ranges(torch.from_numpy(c)) for c in (codes, self._codes.slice(last, last + 1)[0]))
        share = shared_views(scans, ranges, newest.expand_as(ranges), relative).numpy()
        share[earlier > end - self._search.min_separation] = -np.inf
        best = self._most_similar(share[:, None], earlier, self._search.per_pose)
        chosen = [index for index, _, value in best if value >= LEAST_SHARED]
        found = PlaceLoops.none()
        if chosen:
            # A node's own frame is the last one before its block.
            pairs = [
                self._of_key_frame(frames[k], -1, 0.0, OVERLAP_VIEWS)
                if k < len(frames)
                else self._in_window(int(earlier[k]), int(earlier[k]) * self._block - 1, 0.0, last, OVERLAP_VIEWS)
                for k in chosen
            ]
            views = self._views(pairs, end, OVERLAP_VIEWS)
            of_ranges = views._replace(a=self._ranges(views.a), b=self._ranges(views.b))
            measurement, registered = measure_overlaps(scans, of_ranges, relative[chosen], self._search.registrations)
            embeddings = self._pair_head.embed(torch.stack((views.a[0], views.b[0])))
            found = PlaceLoops.found(
                earlier[chosen],
                end,
                np.array([pair.frame for pair in pairs]),
                measurement,
                np.full(len(pairs), OVERLAP_LOGIT),
                (embeddings[0] * embeddings[1]).sum(-1).double().numpy(),
                overlap=True,
            )[registered.numpy()]
            found = found[~(found.pairs[:, None] == self._dropped).all(2).any(1)]
        self._kept = self._kept.extended(found)
        return found

    def _ranges(self, codes: Tensor) -> Tensor:
        return codes[..., self._pair_head.config.code_size :].contiguous()

    def limit_drift(self, found: PlaceLoops, most_drift: np.ndarray) -> None:
        """Set how far the loops that were found last may be off at most: variances ``(n, 3)``."""
        newest = slice(len(self._kept) - len(found), None)
        if not np.array_equal(self._kept.pairs[newest], found.pairs):
            raise ValueError("other loops were found since; expected the loops that were found last")
        self._kept.most_drift[newest] = most_drift

    def key_frame(self, node: int, relative: np.ndarray, variance: np.ndarray) -> KeyFrame:
        """The key frame that ``node`` becomes when it leaves the window."""
        first = node * self._block
        at = np.maximum(np.arange(first - MARGIN, first + self._block + MARGIN), 0)
        odometry = self._frames.odometry
        embeddings = self._embeddings.slice(first, first + self._block).copy()
        poses = _seen_from(odometry[first], odometry[at + 1])
        return KeyFrame(node, relative, variance, embeddings, self._codes.at(at), poses)

    def places(self, first: int, keys: KeyFrames, poses: np.ndarray) -> PlaceMap:
        """The frames whose codes are kept: those from step number ``first`` on, and those of the key frames.

        Args:
            poses: of all frames in the map ``(frames, 3)``.
        """
        kept = [keys.frame(index) for index in range(len(keys))]
        around = [np.arange(-MARGIN, self._block + MARGIN) + key.node * self._block for key in kept]
        numbers = np.concatenate((*(np.maximum(at, 0) for at in around), np.arange(first, len(self._codes))))
        codes = np.concatenate((*(key.codes for key in kept), self._codes.slice(first)))
        return PlaceMap.of_steps(numbers, codes, poses)

    def leave(self, first: int) -> None:
        """Forget loops that nobody believes, when the window begins at node ``first`` and they lie before it."""
        self._kept = self._kept.without_doubtful(first, _MOST_TO_KEY_FRAMES)

    def reattach(self, nodes: np.ndarray, stay: np.ndarray, poses: np.ndarray, variance: np.ndarray) -> None:
        """Hang the loops of key frames that go upon the ones before them; arguments as of ``PlaceLoops.reattached``."""
        self._kept = self._kept.reattached(nodes, stay, poses, variance, self._block)

    def loops(self, keys: np.ndarray, first: int, blocks: int) -> tuple[Loops, np.ndarray]:
        """The loops for the optimizer, and their numbers for ``weigh`` and ``edges``.

        Args:
            keys: nodes of the key frames ``(n,)``, which stand before the window that begins at node ``first``.
            blocks: blocks of the whole trajectory.
        """
        kept = self._kept
        within, behind = kept.start >= first, kept.end <= first
        numbers = np.concatenate(
            (
                np.flatnonzero(behind),
                kept.best(np.flatnonzero(~within & ~behind), _MOST_TO_KEY_FRAMES),
                kept.best(np.flatnonzero(within & ~kept.overlap), self._search.most),
                kept.best(np.flatnonzero(within & kept.overlap), self._search.overlaps),
            )
        )
        at_ends = self._embeddings.slice(first * self._block, blocks * self._block)[self._block - 1 :: self._block]
        return kept[numbers].for_optimizer(keys, first, at_ends), numbers

    def weigh(self, numbers: np.ndarray, weights: np.ndarray, information: np.ndarray) -> None:
        """Keep the optimizer's weights ``(n,)`` and information ``(n, 3)`` of the loops of ``loops``."""
        self._kept.weight[:], self._kept.information[:] = 0.0, -1.0
        self._kept.weight[numbers], self._kept.information[numbers] = weights, information

    def weighed(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What ``weigh`` was given last, of these loops; a weight is negative where it was not given any."""
        return self._kept.weight.take(numbers), self._kept.information.take(numbers, axis=0)

    def ties(self) -> tuple[np.ndarray, np.ndarray]:
        """Nodes that each loop joins ``(n, 2)``, the earlier one first, and its last weight ``(n,)``."""
        return self._kept.pairs, self._kept.weight

    def recall(self, first: int) -> None:
        """Forget what the frames after the steps from number ``first`` on look like, and their loops."""
        self._codes.slice(first)[:] = 0.0
        self._embeddings.slice(first)[:] = 0.0
        self._kept = self._kept[self._kept.end * self._block <= first]

    def drop(self, which: Callable[[np.ndarray], np.ndarray]) -> int:
        """Forget the loops that ``which`` chooses by the frames that they join ``(n, 2)``; returns how many."""
        chosen = which(self.edges(np.arange(len(self._kept)))[0])
        self._dropped = np.concatenate((self._dropped, self._kept.pairs[chosen]))
        self._kept = self._kept[~chosen]
        return int(chosen.sum())

    def edges(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames that these loops join ``(n, 2)``, and the later one seen from the earlier ``(n, 3)``."""
        kept = self._kept
        return _edges(self._frames.odometry, kept.pairs, kept.frame, kept.relative, numbers, self._block)


@njit(cache=True)
def _edges(
    odometry: np.ndarray,
    pairs: np.ndarray,
    frame: np.ndarray,
    measured: np.ndarray,
    numbers: np.ndarray,
    block: int,
) -> tuple[np.ndarray, np.ndarray]:
    frames = np.empty((len(numbers), 2), np.int64)
    begins = np.empty((len(numbers), 3))
    for k, number in enumerate(numbers):
        frames[k] = frame[number] + 1, pairs[number, 1] * block
        begins[k] = odometry[pairs[number, 0] * block]
    return frames, all_between(all_between(begins, odometry[frames[:, 0]]), measured[numbers])


def _at(offsets: _Offsets, which: int) -> np.ndarray:
    return np.array([view[which] for view in offsets])


def _seen_from(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    return all_between(*(np.ascontiguousarray(rows, np.float64).reshape(-1, 3) for rows in (poses, others)))
