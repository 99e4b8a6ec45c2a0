"""Loop candidates of a trajectory that grows: each new meta-pose is compared once, with the window and the key frames.

What ``find_loops`` finds in a whole trajectory is found here a meta-pose at a time, for what is measured once stays.
"""

from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.data.row_buffers import GrowingRows, SlidingRows
from ngo_estimator.geometry import se2
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.online.key_frames import KeyFrame, KeyFrames
from ngo_estimator.optimizer.loop_closure import SMALLEST_SPREAD, VIEWS, Loops, LoopSearch, fuse_views
from ngo_estimator.optimizer.overlaps import LEAST_SHARED, OVERLAP_LOGIT, OVERLAP_VIEWS, measure_overlaps, shared_views

MARGIN = 4
"""Frames before and behind a block whose codes a key frame keeps, for the views of a loop."""

_KEY_FRAMES_PER_POSE = 2
"""Candidates among the key frames for each meta-pose."""

_MOST_TO_KEY_FRAMES = 128
"""Loops that reach behind the window, at most, and as many that lie behind it whole."""

_BELIEVED = 0.1
"""A loop whose weight is less when it leaves the window is forgotten."""

_UNWEIGHED = -1.0
"""Weight of a loop that no optimisation has seen."""

_EARLIER, _LATER = (np.array([view[k] for view in OVERLAP_VIEWS]) for k in (0, 1))


@dataclass(frozen=True)
class Candidates:
    """Loop candidates ``(n,)``: node ``end`` as seen from the earlier node ``start``, both counted in blocks.

    ``frame`` is the earlier frame, as a number of steps before it; ``measured`` ``(n, 3)``, ``log_scale``, ``spread``
    ``(n, 2)``, ``logit`` and ``similarity`` as in ``Loops``; ``most_drift`` ``(n, 3)`` likewise, infinite where the
    odometry says enough; ``weight`` what the optimizer gave it last, negative before it did; ``overlap`` whether it was
    found by poses.
    """

    start: np.ndarray
    end: np.ndarray
    frame: np.ndarray
    measured: np.ndarray
    log_scale: np.ndarray
    spread: np.ndarray
    logit: np.ndarray
    similarity: np.ndarray
    most_drift: np.ndarray
    weight: np.ndarray
    overlap: np.ndarray

    @classmethod
    def none(cls) -> "Candidates":
        """No candidates."""
        widths = {"measured": 3, "most_drift": 3, "log_scale": 2, "spread": 2}
        types = {"start": np.int64, "end": np.int64, "frame": np.int64, "overlap": np.bool_}
        shapes = [(f.name, (0, widths[f.name]) if f.name in widths else (0,)) for f in fields(cls)]
        return cls(**{name: np.zeros(shape, types.get(name, np.float64)) for name, shape in shapes})

    def __len__(self) -> int:
        return len(self.start)

    def where(self, which: np.ndarray) -> "Candidates":
        """Those of a boolean mask or of some indices."""
        return Candidates(**{f.name: getattr(self, f.name)[which] for f in fields(self)})

    def and_also(self, others: "Candidates") -> "Candidates":
        """These and, behind them, the others."""
        return Candidates(
            **{f.name: np.concatenate((getattr(self, f.name), getattr(others, f.name))) for f in fields(self)}
        )


class OnlineLoops:
    """Finds and keeps the loop candidates of a trajectory.

    Args:
        odometry: global poses of all frames by odometry, the first frame's in front; whoever makes this appends to it.
        window: blocks in the window.
    """

    def __init__(self, pair_head: PairHead, search: LoopSearch, block: int, window: int, odometry: GrowingRows) -> None:
        self._pair_head, self._search, self._block = pair_head, search, block
        self._odometry = odometry
        keep = window * block + 2 * block + MARGIN
        self._codes = SlidingRows((pair_head.config.code_length,), np.float32, keep)
        self._embeddings = SlidingRows((pair_head.config.embedding_size,), np.float32, keep)
        self._candidates = Candidates.none()

    def append(self, place_code: np.ndarray) -> None:
        """Take the place code of the next frame."""
        self._codes.append(place_code)
        with torch.inference_mode():
            self._embeddings.append(self._pair_head.embed(torch.from_numpy(self._codes.slice(len(self._codes) - 1))[0]))

    def codes(self, first: int) -> np.ndarray:
        """Place codes ``(n, code_length)`` of the frames after the steps from number ``first`` on, without a copy."""
        return self._codes.slice(first)

    @torch.inference_mode()
    def find(self, block: int, first: int, keys: KeyFrames) -> Candidates:
        """Candidates that end behind the block of this number, the newest; those to key frames last.

        Args:
            first: number of the first block in the window.
        """
        last = block * self._block + self._block - 1
        embedding = self._embeddings.slice(last)[0]
        oldest, newest = first, block - self._search.min_separation
        parts = []
        if newest >= oldest:
            in_window = self._embeddings.slice(oldest * self._block, (newest + 1) * self._block)
            similarity = (in_window @ embedding).reshape(-1, self._block)
            for index, step, value in self._most_similar(
                similarity, np.arange(oldest, newest + 1), self._search.per_pose
            ):
                parts.append(self._in_window((oldest + index) * self._block + step, last, value))
        if len(keys):
            similarity = keys.embeddings @ embedding
            for index, step, value in self._most_similar(similarity, keys.nodes, _KEY_FRAMES_PER_POSE):
                parts.append(self._of_key_frame(keys.frame(index), step, last, value))
        found = self._measured(parts, block + 1) if parts else Candidates.none()
        self._candidates = self._candidates.and_also(found)
        return found

    def _most_similar(self, similarity: np.ndarray, blocks: np.ndarray, count: int) -> list[tuple[int, int, float]]:
        """Index among ``blocks``, frame in the block and similarity of the best, each from elsewhere."""
        step = similarity.argmax(axis=1)
        best = similarity.max(axis=1)
        chosen = []
        for _ in range(count):
            index = int(best.argmax())
            if best[index] == -np.inf:
                break
            chosen.append((index, int(step[index]), float(best[index])))
            best[np.abs(blocks - blocks[index]) <= self._search.min_apart] = -np.inf
        return chosen

    def _in_window(self, frame: int, last: int, similarity: float) -> "_Pair":
        node = frame // self._block
        at = np.clip(frame + self._offsets(0), 0, last)
        odometry = self._odometry.values
        poses = _seen_from(odometry[node * self._block], odometry[np.append(at, frame) + 1])
        return _Pair(node, frame, similarity, self._codes.at(at), poses[:-1], poses[-1])

    def _of_key_frame(self, key: KeyFrame, step: int, last: int, similarity: float) -> "_Pair":
        at = np.clip(MARGIN + step + self._offsets(0), max(0, MARGIN - key.node * self._block), len(key.codes) - 1)
        return _Pair(
            key.node, key.node * self._block + step, similarity, key.codes[at], key.poses[at], key.poses[MARGIN + step]
        )

    def _offsets(self, which: int) -> np.ndarray:
        return np.array([view[which] for view in VIEWS[: self._search.views]])

    def _measured(self, pairs: list["_Pair"], node: int) -> Candidates:
        """Measure pairs whose later frame is the one before ``node``, all in one batch."""
        last = node * self._block - 1
        at = np.clip(last + self._offsets(1), 0, last)
        odometry = self._odometry.values
        to_end = torch.from_numpy(_seen_from(odometry[at + 1], odometry[last + 1])).float()  # (views, 3)
        codes = torch.from_numpy(np.stack([pair.codes for pair in pairs], axis=1))  # (views, n, code_length)
        later = torch.from_numpy(self._codes.at(at)).unsqueeze(1).expand_as(codes)
        measured, log_scale, logit = self._pair_head(codes, later)
        from_frame = torch.from_numpy(np.stack([_seen_from(p.pose, p.poses) for p in pairs], axis=1)).float()
        measured = se2.compose(se2.compose(from_frame, measured), to_end.unsqueeze(1))
        spread = torch.full_like(log_scale[0], float(np.log(SMALLEST_SPREAD)))
        if len(at) > 1:
            fused, fused_scale, spread = fuse_views(measured, log_scale)
        else:
            fused, fused_scale = measured[0], log_scale[0]
        # The first view is of the candidate's own frames.
        fused, fused_scale = self._pair_head.register(
            codes[0], later[0], fused, fused_scale, self._search.registrations
        )
        similarity = np.array([pair.similarity for pair in pairs])
        return _candidates(pairs, node, (fused, fused_scale, spread), logit[0].double().numpy(), similarity, False)

    @torch.inference_mode()
    def find_overlaps(self, block: int, first: int, nodes: np.ndarray, keys: KeyFrames | None = None) -> Candidates:
        """Candidates that end behind the block of this number, at nodes that share what is seen there.

        What ``overlaps.find_overlaps`` finds in a whole trajectory. Those to nodes of the window that were found under
        earlier poses are let go.

        Args:
            first: number of the first block in the window.
            nodes: poses of the nodes in the map ``(n, 3)``, those behind this block among them.
            keys: key frames to look among as well; by default there is none.
        """
        scans = self._pair_head.config.registration
        if scans is None or self._search.overlaps == 0:
            return Candidates.none()
        end, last = block + 1, (block + 1) * self._block - 1
        before = self._candidates.overlap & (self._candidates.end == end) & (self._candidates.start >= first)
        self._candidates = self._candidates.where(~before)
        in_window = np.arange(max(1, first), end - self._search.min_separation + 1)
        # The origin has no code of its own.
        frames = [] if keys is None else [keys.frame(k) for k in range(len(keys)) if keys.nodes[k]]
        earlier = np.concatenate((np.array([key.node for key in frames], np.int64), in_window))
        if len(earlier) == 0:
            return Candidates.none()
        codes = np.concatenate(
            (*[key.codes[MARGIN - 1 : MARGIN] for key in frames], self._codes.at(in_window * self._block - 1))
        )
        relative = torch.from_numpy(_seen_from(nodes[earlier], nodes[end])).float()
        at_end = self._codes.slice(last, last + 1)[0]
        ranges, newest = (torch.from_numpy(self._ranges(c)) for c in (codes, at_end))
        share = shared_views(scans, ranges, newest.expand_as(ranges), relative).numpy()
        share[earlier > end - self._search.min_separation] = -np.inf
        chosen = [
            index
            for index, _, value in self._most_similar(share[:, None], earlier, self._search.per_pose)
            if value >= LEAST_SHARED
        ]
        found = Candidates.none()
        if chosen:
            pairs = [
                self._key_node(frames[k]) if k < len(frames) else self._node_in_window(int(earlier[k]), last)
                for k in chosen
            ]
            found = self._measured_overlaps(pairs, end, relative[chosen])
        self._candidates = self._candidates.and_also(found)
        return found

    def _ranges(self, codes: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(codes[..., self._pair_head.config.code_size :])

    def _node_in_window(self, node: int, last: int) -> "_Pair":
        frame = node * self._block - 1
        at = np.clip(frame + _EARLIER, 0, last)
        odometry = self._odometry.values
        poses = _seen_from(odometry[frame + 1], odometry[at + 1])
        return _Pair(node, frame, 0.0, self._codes.at(at), poses, np.zeros(3))

    def _key_node(self, key: KeyFrame) -> "_Pair":
        at = np.clip(MARGIN - 1 + _EARLIER, max(0, MARGIN - key.node * self._block), len(key.codes) - 1)
        return _Pair(key.node, key.node * self._block - 1, 0.0, key.codes[at], key.poses[at], np.zeros(3))

    def _measured_overlaps(self, pairs: list["_Pair"], node: int, start: Tensor) -> Candidates:
        """Register pairs whose later frame is the one before ``node``, as seen from the earlier one at first."""
        scans = self._pair_head.config.registration
        assert scans is not None
        last = node * self._block - 1
        at = np.clip(last + _LATER, 0, last)
        odometry = self._odometry.values
        to_end = torch.from_numpy(_seen_from(odometry[at + 1], odometry[last + 1])).float().unsqueeze(1)
        codes = np.stack([pair.codes for pair in pairs], axis=1)  # (views, n, code_length)
        newest = np.broadcast_to(self._codes.at(at)[:, None], codes.shape)
        measured, log_scale, spread, registered = measure_overlaps(
            scans,
            torch.from_numpy(self._ranges(codes)),
            torch.from_numpy(self._ranges(newest)),
            torch.from_numpy(np.stack([pair.poses for pair in pairs], axis=1)).float(),
            to_end.expand(-1, len(pairs), -1),
            start,
            self._search.registrations,
        )
        embeddings = [self._pair_head.embed(torch.from_numpy(c[0].copy())) for c in (codes, newest)]
        similarity = (embeddings[0] * embeddings[1]).sum(-1).double().numpy()
        logit = np.full(len(pairs), OVERLAP_LOGIT)
        found = _candidates(pairs, node, (measured, log_scale, spread), logit, similarity, True)
        return found.where(registered.numpy())

    def limit_drift(self, found: Candidates, most_drift: np.ndarray) -> None:
        """Say of the candidates that were found last how far they may be off at most: ``(n, 3)``, variances."""
        newest = self._candidates.where(np.arange(len(self._candidates) - len(found), len(self._candidates)))
        if not (np.array_equal(newest.start, found.start) and np.array_equal(newest.end, found.end)):
            raise ValueError("others were found since; expected the candidates that were found last")
        self._candidates.most_drift[len(self._candidates) - len(found) :] = most_drift

    def key_frame(self, node: int, relative: np.ndarray, variance: np.ndarray) -> KeyFrame:
        """The key frame that ``node`` becomes when it leaves the window."""
        first = node * self._block
        at = np.maximum(np.arange(first - MARGIN, first + self._block + MARGIN), 0)
        odometry = self._odometry.values
        embeddings = self._embeddings.slice(first, first + self._block).copy()
        poses = _seen_from(odometry[first], odometry[at + 1])
        return KeyFrame(node, relative, variance, embeddings, self._codes.at(at), poses)

    def leave(self, first: int) -> None:
        """Let go of the candidates behind the window, which begins at node ``first``, but for the ones believed."""
        behind = self._candidates.end <= first
        if behind.any():
            weight, logit = self._candidates.weight, self._candidates.logit
            # Those found while nothing is optimised are as good as the pair head says.
            believed = np.where(weight == _UNWEIGHED, logit > 0.0, weight >= _BELIEVED)
            kept = self._best(np.flatnonzero(behind & believed), _MOST_TO_KEY_FRAMES)
            self._candidates = self._candidates.where(np.concatenate((kept, np.flatnonzero(~behind))))

    def reattach(self, nodes: np.ndarray, stay: np.ndarray, poses: np.ndarray, variance: np.ndarray) -> None:
        """Hang the loops of key frames that go upon the ones before them.

        Args:
            nodes: of the key frames ``(n,)`` before some go, with their ``poses`` ``(n, 3)`` and the ``variance``
                ``(n, 3)`` of what leads from each to the next.
            stay: which of them stay ``(n,)``.
        """
        staying = np.flatnonzero(stay)
        target = staying[np.searchsorted(staying, np.arange(len(nodes)), side="right") - 1]
        drift = np.concatenate((np.zeros((1, 3)), np.cumsum(variance, axis=0)))
        c = self._candidates
        measured, log_scale, frame = c.measured.copy(), c.log_scale.copy(), c.frame.copy()
        ends = {"start": c.start.copy(), "end": c.end.copy()}
        for name, old in ends.items():
            index = np.searchsorted(nodes, old)
            gone = np.flatnonzero((index < len(nodes)) & (old <= nodes[-1]))
            gone = gone[target[index[gone]] != index[gone]]
            here, there = index[gone], target[index[gone]]
            moved = torch.from_numpy(measured[gone])
            ends_at = [torch.from_numpy(poses[k]) for k in (there, here)]
            if name == "start":
                moved = se2.compose(se2.between(*ends_at), moved)
                frame[gone] = nodes[there] * self._block - 1
            else:
                moved = se2.compose(moved, se2.between(*reversed(ends_at)))
            more = drift[here] - drift[there]
            # Errors of the heading on the way swing what lies behind them.
            lever = np.square(moved.numpy()[:, :2]).sum(1) + np.square(poses[here] - poses[there])[:, :2].sum(1)
            scales = np.stack((more[:, :2].mean(1) + more[:, 2] * lever, more[:, 2]), axis=1)
            measured[gone] = moved.numpy()
            log_scale[gone] = 0.5 * np.log(np.exp(2.0 * log_scale[gone]) + scales)
            old[gone] = nodes[there]
        moved_loops = {**vars(c), **ends, "frame": frame, "measured": measured, "log_scale": log_scale}
        self._candidates = Candidates(**moved_loops)
        distinct = ends["start"] < ends["end"]
        # Of several loops between the same two key frames the likeliest one says nearly all.
        order = np.lexsort((-c.logit, ends["end"], ends["start"]))
        again = (np.diff(ends["start"][order]) == 0) & (np.diff(ends["end"][order]) == 0)
        distinct[order[1:][again & (ends["end"][order[1:]] <= nodes[-1])]] = False
        self._candidates = self._candidates.where(distinct)

    def loops(self, keys: np.ndarray, first: int, blocks: int) -> tuple[Loops, np.ndarray]:
        """What the optimizer sees, and the numbers of these candidates, for ``weigh`` and ``edges``.

        Args:
            keys: nodes of the key frames ``(n,)``, which stand before the window that begins at node ``first``.
            blocks: blocks of the whole trajectory.
        """
        within, behind = self._candidates.start >= first, self._candidates.end <= first
        overlap = self._candidates.overlap
        numbers = np.concatenate(
            (
                np.flatnonzero(behind),
                self._best(np.flatnonzero(~within & ~behind), _MOST_TO_KEY_FRAMES),
                self._best(np.flatnonzero(within & ~overlap), self._search.most),
                self._best(np.flatnonzero(within & overlap), self._search.overlaps),
            )
        )
        c = self._candidates.where(numbers)
        start, end = (_index(nodes, keys, first) for nodes in (c.start, c.end))
        at_ends = self._embeddings.slice(first * self._block, blocks * self._block)[self._block - 1 :: self._block]
        loops = Loops(
            start=_batch(start),
            end=_batch(end - 1),
            frame=_batch(c.frame),
            measured=_batch(c.measured).float(),
            log_scale=_batch(c.log_scale).float(),
            spread=_batch(c.spread).float(),
            logit=_batch(c.logit).float().clamp(min=-20.0),
            similarity=_batch(c.similarity).float(),
            valid=torch.ones(1, len(c), dtype=torch.bool),
            embeddings=_batch(at_ends),
            length=_batch(c.end - c.start),
            most_drift=_batch(c.most_drift).float(),
        )
        return loops, numbers

    def _best(self, numbers: np.ndarray, most: int) -> np.ndarray:
        """Those with the highest belief, of equal ones those that are measured best, in their present order."""
        if len(numbers) <= most:
            return numbers
        logit, heading = self._candidates.logit[numbers], self._candidates.log_scale[numbers, 1]
        best: np.ndarray = np.sort(numbers[np.lexsort((heading, -logit))[:most]])
        return best

    def weigh(self, numbers: np.ndarray, weights: np.ndarray) -> None:
        """Keep what the optimizer gave the candidates of ``loops``."""
        self._candidates.weight[:] = 0.0
        self._candidates.weight[numbers] = weights

    def edges(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames that these candidates join ``(n, 2)``, and the later one as seen from the earlier ``(n, 3)``."""
        start, frame, end = (getattr(self._candidates, name)[numbers] for name in ("start", "frame", "end"))
        odometry = torch.from_numpy(self._odometry.values)
        offset = se2.between(odometry[start * self._block], odometry[frame + 1])
        measured = se2.compose(se2.inverse(offset), torch.from_numpy(self._candidates.measured[numbers]))
        return np.stack((frame + 1, end * self._block), axis=1), measured.numpy()


@dataclass(frozen=True)
class _Pair:
    """An earlier frame to measure from: its node, codes and poses ``(views, ...)`` near it, its pose in the node."""

    node: int
    frame: int
    similarity: float
    codes: np.ndarray
    poses: np.ndarray
    pose: np.ndarray


def _candidates(
    pairs: list[_Pair],
    node: int,
    measurement: tuple[Tensor, Tensor, Tensor],
    logit: np.ndarray,
    similarity: np.ndarray,
    overlap: bool,
) -> Candidates:
    """Candidates of pairs that end at ``node``; ``measurement`` as of ``fuse_views``, seen from the earlier frames."""
    measured, log_scale, spread = measurement
    of_frame = torch.from_numpy(np.stack([pair.pose for pair in pairs])).float()
    count = len(pairs)
    return Candidates(
        start=np.array([pair.node for pair in pairs]),
        end=np.full(count, node),
        frame=np.array([pair.frame for pair in pairs]),
        measured=se2.compose(of_frame, measured).double().numpy(),
        log_scale=log_scale.double().numpy(),
        spread=spread.double().numpy(),
        logit=logit,
        similarity=similarity,
        most_drift=np.full((count, 3), np.inf),
        weight=np.full(count, _UNWEIGHED),
        overlap=np.full(count, overlap),
    )


def _index(nodes: np.ndarray, keys: np.ndarray, first: int) -> np.ndarray:
    """Index of nodes among the key frames and, behind them, the window's nodes."""
    return np.where(nodes >= first, len(keys) + nodes - first, np.searchsorted(keys, nodes))


def _seen_from(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    return se2.between(torch.from_numpy(poses), torch.from_numpy(others)).numpy()


def _batch(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values)).unsqueeze(0)
