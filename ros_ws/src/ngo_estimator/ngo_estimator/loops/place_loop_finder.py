"""Finds loops of each new meta-pose: to frames that look like its own, and to nodes that share its walls.

Candidates are chosen and measured as ``find_loops`` and ``find_overlaps`` do in a whole trajectory. A measurement is
made once and kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.row_buffers import SlidingRows
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import all_between
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames
from ngo_estimator.graph.path_covariance import path_covariances
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.loops.loop_closure import Loops, LoopSearch, may_show_one_place
from ngo_estimator.loops.overlaps import LEAST_SHARED, OVERLAP_LOGIT, shared_views
from ngo_estimator.loops.pair_measurement import OVERLAP_VIEWS, VIEWS, PairViews, measure_overlaps, measure_pairs
from ngo_estimator.loops.place_ambiguity import looks_like_everything, places_by_odometry
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.networks.place_encoder import PairHead

MARGIN = 4  # Frames before and behind a block whose codes a key frame keeps, for the views of a loop.

_KEY_FRAMES_PER_POSE = 2  # Candidates among the key frames for each meta-pose.

_MOST_TO_KEY_FRAMES = 128  # Most loops from key frames to the window, and most loops between key frames.

_AGAIN = 8
"""Blocks after which what shares a frame's walls is looked for once more: its pose knows of loops that came later."""

_MOST_DRIFT = 4.0
"""How much the variance between a key frame and the newest pose is taken to be more than the graph says."""

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


class PlaceLoopFinder:
    """Finds and keeps the loops of a trajectory.

    Args:
        window: blocks in the window.
        graph: its nodes are those of ``keys`` and then those of the window; their owner adds to both.
        scale: factor of the graph's variances.
    """

    def __init__(
        self,
        pair_head: PairHead,
        search: LoopSearch,
        block: int,
        window: int,
        graph: PoseGraph,
        keys: KeyFrames,
        scale: float,
    ) -> None:
        self._pair_head, self._search, self._block, self._scale = pair_head, search, block, scale
        self._graph, self._keys = graph, keys
        keep = window * block + 2 * block + MARGIN
        self._codes = SlidingRows((pair_head.config.code_length,), np.float32, keep)
        self._embeddings = SlidingRows((pair_head.config.embedding_size,), np.float32, keep)
        self.loops = PlaceLoops.none()
        # Pairs of frames that stay apart: shared walls are looked for again in the newest blocks.
        self._dropped = np.zeros((0, 2), np.int64)

    SAVED = ("_codes", "_embeddings", "loops", "_dropped")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        frames, nodes = len(self._graph.frames) - 1, len(self._graph)
        require(len(self._codes) == len(self._embeddings) == frames, f"there are not {frames} place codes")
        newest = int(self.loops.end.max(initial=0))
        require(newest < nodes, f"a loop ends at node {newest} of {nodes}")

    @property
    def _begins(self) -> np.ndarray:
        """The numbers ``(nodes,)`` of the steps with which the blocks behind the nodes begin."""
        return self._graph.frames.nodes

    @property
    def _odometry(self) -> np.ndarray:
        return self._graph.frames.odometry

    def append(self, place_code: np.ndarray) -> None:
        """Take the place code of the next frame; zeros are those of a frame that closes no loops."""
        self._codes.append(place_code)
        # ``find`` embeds all frames of a block at once.
        self._embeddings.append(np.zeros(self._pair_head.config.embedding_size, np.float32))

    def codes(self, first: int) -> np.ndarray:
        """Place codes ``(n, code_length)`` of the frames after the steps from number ``first`` on, without a copy."""
        return self._codes.slice(first)

    def find(self, fresh: bool) -> np.ndarray:
        """Loops of the newest node; ``fresh``: poses are good enough to say what frames share.

        Returns:
            Which of ``loops`` ``(n,)`` these are.
        """
        newest, window = len(self._graph) - 1, len(self._keys)
        overlaps = fresh and self._search.overlaps > 0
        if overlaps and newest - _AGAIN > window:
            self._find_overlaps(newest - _AGAIN, window)
        known = len(self.loops)
        self._find_places(newest)
        if overlaps:
            self._find_overlaps(newest, 1)
        new = np.arange(known, len(self.loops))
        self._limit_drift(new[self.loops.start[new] < window])
        return new

    def _limit_drift(self, new: np.ndarray) -> None:
        """Limit how far these loops from key frames may be off.

        The odometry alone would let a pose of long ago lie anywhere; the loops that were closed since say more.
        """
        loops, graph = self.loops, self._graph
        closed = loops[loops.weight > BELIEVED]
        if len(new) and len(closed):
            covariance = path_covariances(
                graph.poses,
                np.concatenate((graph.edges, closed.pairs)),
                np.concatenate((graph.step_covariance, np.eye(3) / closed.information[:, None])),
                loops.pairs[new],
            )
            loops.most_drift[new] = _MOST_DRIFT * self._scale * np.diagonal(covariance, axis1=1, axis2=2)

    def _find_places(self, node: int) -> None:
        """Loops to earlier frames like that of the newest node.

        There are none where it looks like everything (``place_ambiguity``).
        """
        offsets = VIEWS[: self._search.views]
        frames = self._frames_alike(node, offsets)
        if not frames:
            return
        views = self._views(frames, node, offsets)
        measurement, logit = measure_pairs(self._pair_head, views, self._search.registrations)
        of_frame = torch.from_numpy(np.stack([frame.pose for frame in frames])).float()
        found = PlaceLoops.found(
            np.array([frame.node for frame in frames]),
            node,
            np.array([frame.frame for frame in frames]),
            measurement._replace(measured=se2.compose(of_frame, measurement.measured)),
            logit.double().numpy(),
            np.array([frame.similarity for frame in frames]),
            overlap=False,
        )
        self.loops = self.loops.extended(found)

    def _frames_alike(self, end: int, offsets: _Offsets) -> list[_EarlierFrame]:
        """Earlier frames like that of the newest node ``end``; key frames last."""
        window, last = len(self._keys), int(self._begins[end]) - 1
        self._embed(last + 1 - self._block)
        embedding = self._embeddings.slice(last)[0]
        if not embedding.any():
            return []
        in_window = np.arange(window, end - self._search.min_separation)
        frames = []
        if len(in_window):
            first = int(self._begins[window])
            seen = self._embeddings.slice(first, first + len(in_window) * self._block)
            similarity = (seen @ embedding).reshape(-1, self._block)
            if self._looks_like_everything(similarity.reshape(-1), first):
                return []
            similarity = self._possible(similarity, in_window, last)
            for index, step, value in self._most_similar(similarity, in_window, self._search.per_pose):
                node = int(in_window[index])
                frames.append(self._in_window(node, int(self._begins[node]) + step, value, last, offsets))
        if window:
            keys = np.arange(window)
            similarity = self._possible(self._keys.embeddings @ embedding, keys, last)
            for index, step, value in self._most_similar(similarity, keys, _KEY_FRAMES_PER_POSE):
                frames.append(self._of_key_frame(index, step, value, offsets))
        return frames

    def _embed(self, first: int) -> None:
        """Embed the codes after the steps of the block that begins with number ``first``."""
        codes = self._codes.slice(first, first + self._block)
        embeddings = self._pair_head.embed(torch.from_numpy(codes)).numpy()
        embeddings[~codes.any(axis=1)] = 0.0  # like nothing, not even like other such codes
        self._embeddings.replace(first, embeddings)

    def _looks_like_everything(self, similarity: np.ndarray, first: int) -> bool:
        """Whether the newest frame looks like most places, by its similarity to the frames after step ``first`` on."""
        at = torch.from_numpy(self._odometry[first + 1 : first + 1 + len(similarity), :2])
        places = places_by_odometry(at, 2.0 * self._pair_head.config.offset_scale_m)
        alike = torch.from_numpy(similarity)
        return bool(looks_like_everything(alike, places, torch.ones_like(alike, dtype=torch.bool)))

    def _possible(self, similarity: np.ndarray, nodes: np.ndarray, last: int) -> np.ndarray:
        """Similarity ``(n, frames)`` of the frames of blocks to the one after step ``last``, 0 for impossible ones."""
        if not self._search.drift_m:
            return similarity
        steps = self._begins[nodes][:, None] + np.arange(self._block)
        earlier, newest = (torch.from_numpy(self._odometry[number + 1]) for number in (steps, last))
        possible = may_show_one_place(se2.between(earlier, newest), torch.from_numpy(last - steps), self._search)
        return np.where(possible.numpy(), similarity, 0.0)

    def _most_similar(self, similarity: np.ndarray, nodes: np.ndarray, count: int) -> list[tuple[int, int, float]]:
        """Index in ``nodes``, frame of the block and value of the best of ``similarity`` ``(n, frames)``."""
        similarity = np.where(similarity == 0.0, -np.inf, similarity)  # frames that close no loops
        best, begins, apart = similarity.max(axis=1), self._begins[nodes], self._search.min_apart * self._block
        found: list[tuple[int, int, float]] = []
        # As ``each_from_elsewhere``, whose calls of torch cost more than their arithmetic for a single row.
        while len(found) < min(count, len(best)) and (value := float(best[index := int(best.argmax())])) > -np.inf:
            found.append((index, int(similarity[index].argmax()), value))
            best[np.abs(begins - begins[index]) <= apart] = -np.inf
        return found

    def _in_window(self, node: int, frame: int, similarity: float, last: int, offsets: _Offsets) -> _EarlierFrame:
        """A frame of the window, seen from ``node``; ``last`` is the newest frame."""
        at = np.clip(frame + _at(offsets, 0), 0, last)
        poses = _seen_from(self._odometry[self._begins[node]], self._odometry[np.append(at, frame) + 1])
        return _EarlierFrame(node, frame, similarity, poses[-1], self._codes.at(at), poses[:-1])

    def _of_key_frame(self, node: int, step: int, similarity: float, offsets: _Offsets) -> _EarlierFrame:
        """A frame that a key frame keeps: ``step`` steps behind the first frame of its block, -1 for its own frame."""
        key, begins = self._keys.frame(node), int(self._begins[node])
        at = np.clip(MARGIN + step + _at(offsets, 0), max(0, MARGIN - begins), len(key.codes) - 1)
        return _EarlierFrame(node, begins + step, similarity, key.poses[MARGIN + step], key.codes[at], key.poses[at])

    def _views(self, frames: list[_EarlierFrame], node: int, offsets: _Offsets) -> PairViews:
        """Views of the pairs of these frames and that of ``node``."""
        last = int(self._begins[node]) - 1
        at = np.clip(last + _at(offsets, 1), 0, last)
        codes = torch.from_numpy(np.stack([frame.codes for frame in frames], axis=1))
        later = torch.from_numpy(self._codes.at(at)).unsqueeze(1).expand_as(codes)
        from_frame = np.stack([_seen_from(frame.pose, frame.poses) for frame in frames], axis=1)
        to_end = torch.from_numpy(_seen_from(self._odometry[at + 1], self._odometry[last + 1])).float().unsqueeze(1)
        return PairViews(codes, later, torch.from_numpy(from_frame).float(), to_end.expand(-1, len(frames), -1))

    def _find_overlaps(self, end: int, first: int) -> None:
        """Loops to the node ``end`` from those from number ``first`` on that share its walls under the current poses.

        They replace the overlaps from the window to this node that were found under earlier poses.
        """
        scans, window, begins = self._pair_head.config.registration, len(self._keys), self._begins
        if scans is None:
            return
        last = int(begins[end]) - 1
        self.loops = self.loops[~(self.loops.overlap & (self.loops.end == end) & (self.loops.start >= window))]
        # The origin has no code of its own.
        earlier = np.arange(max(1, first), end)
        earlier = earlier[begins[earlier] <= begins[end] - self._search.min_separation * self._block]
        if len(earlier) == 0:
            return
        keys, poses = earlier[earlier < window], self._graph.poses
        of_keys = [self._keys.frame(key).codes[MARGIN - 1 : MARGIN] for key in keys.tolist()]
        codes = np.concatenate((*of_keys, self._codes.at(begins[earlier[len(keys) :]] - 1)))
        relative = torch.from_numpy(_seen_from(poses[earlier], poses[end])).float()
        ranges, newest = (self._ranges(torch.from_numpy(c)) for c in (codes, self._codes.slice(last, last + 1)[0]))
        share = shared_views(scans, ranges, newest.expand_as(ranges), relative).numpy()
        best = self._most_similar(share[:, None], earlier, self._search.per_pose)
        chosen = [index for index, _, value in best if value >= LEAST_SHARED]
        if not chosen:
            return
        # A node's own frame is the last one before its block.
        pairs = [
            self._of_key_frame(node, -1, 0.0, OVERLAP_VIEWS)
            if node < window
            else self._in_window(node, int(begins[node]) - 1, 0.0, last, OVERLAP_VIEWS)
            for node in earlier[chosen].tolist()
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
        apart = (begins[found.pairs][:, None] == self._dropped).all(2).any(1)
        self.loops = self.loops.extended(found[~apart])

    def _ranges(self, codes: Tensor) -> Tensor:
        return codes[..., self._pair_head.config.code_size :].contiguous()

    def key_frame(self) -> KeyFrame:
        """The key frame that the window's first node becomes."""
        first = int(self._begins[len(self._keys)])
        at = np.maximum(np.arange(first - MARGIN, first + self._block + MARGIN), 0)
        embeddings = self._embeddings.slice(first, first + self._block).copy()
        poses = _seen_from(self._odometry[first], self._odometry[at + 1])
        return KeyFrame(embeddings, self._codes.at(at), poses)

    def places(self, poses: np.ndarray) -> PlaceMap:
        """The frames whose codes are kept: those of the window, and those of the key frames.

        Args:
            poses: of all frames in the map ``(frames, 3)``.
        """
        kept, first = [self._keys.frame(key) for key in range(len(self._keys))], int(self._begins[len(self._keys)])
        around = [np.arange(-MARGIN, self._block + MARGIN) + self._begins[key] for key in range(len(kept))]
        numbers = np.concatenate((*(np.maximum(at, 0) for at in around), np.arange(first, len(self._codes))))
        codes = np.concatenate((*(key.codes for key in kept), self._codes.slice(first)))
        return PlaceMap.of_steps(numbers, codes, poses)

    def leave(self) -> None:
        """Forget loops that nobody believes, when the window has moved on and they lie before it."""
        self.loops = self.loops.without_doubtful(len(self._keys), _MOST_TO_KEY_FRAMES)

    def thin(self, keep: np.ndarray, keys: int) -> None:
        """Hang loops upon the ``keys`` key frames before those that are not among ``keep`` ``(nodes,)``."""
        variance = np.diagonal(self._graph.step_covariance[:keys], axis1=1, axis2=2)
        self.loops = self.loops.thinned(keep, self._graph.poses[:keys], variance, self._begins)

    def chosen(self) -> np.ndarray:
        """Which of ``loops`` ``(n,)`` the optimizer is given."""
        kept, window = self.loops, len(self._keys)
        within, behind = kept.start >= window, kept.end <= window
        return np.concatenate(
            (
                np.flatnonzero(behind),
                kept.best(np.flatnonzero(~within & ~behind), _MOST_TO_KEY_FRAMES),
                kept.best(np.flatnonzero(within & ~kept.overlap), self._search.most),
                kept.best(np.flatnonzero(within & kept.overlap), self._search.overlaps),
            )
        )

    def lengths(self, loops: PlaceLoops) -> np.ndarray:
        """Blocks on each loop ``(n,)``."""
        lengths: np.ndarray = (self._begins[loops.end] - self._begins[loops.start]) // self._block
        return lengths

    def for_optimizer(self, loops: PlaceLoops, valid: np.ndarray) -> Loops:
        """The loops as the networks take them; which of them are ``valid`` ``(n,)``."""
        first, last = (int(self._begins[node]) for node in (len(self._keys), -1))
        at_ends = self._embeddings.slice(first, last)[self._block - 1 :: self._block]
        return loops.for_optimizer(self.lengths(loops), valid, at_ends)

    def weigh(self, rows: np.ndarray, weights: np.ndarray, information: np.ndarray) -> None:
        """Keep the optimizer's weights ``(n,)`` and information ``(n, 3)`` of these loops."""
        self.loops.weight[:], self.loops.information[:] = 0.0, -1.0
        self.loops.weight[rows], self.loops.information[rows] = weights, information

    def recall(self, first: int) -> None:
        """Forget what the frames after the steps from number ``first`` on look like, and their loops."""
        self._codes.slice(first)[:] = 0.0
        self._embeddings.slice(first)[:] = 0.0
        self.loops = self.loops[self._begins[self.loops.end] <= first]

    def drop(self, chosen: np.ndarray) -> int:
        """See ``LoopFinder.drop``."""
        self._dropped = np.concatenate((self._dropped, self._begins[self.loops.pairs[chosen]]))
        self.loops = self.loops[~chosen]
        return int(chosen.sum())

    def edges(self, loops: PlaceLoops) -> tuple[np.ndarray, np.ndarray]:
        """Frames that these loops join ``(n, 2)``, and the later one seen from the earlier ``(n, 3)``."""
        odometry = self._odometry
        frames = loops.frames(self._begins)
        in_block = all_between(odometry[self._begins[loops.start]], odometry[frames[:, 0]])
        return frames, all_between(in_block, loops.relative)


def _at(offsets: _Offsets, which: int) -> np.ndarray:
    return np.array([view[which] for view in offsets])


def _seen_from(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    return all_between(*(np.ascontiguousarray(rows, np.float64).reshape(-1, 3) for rows in (poses, others)))
