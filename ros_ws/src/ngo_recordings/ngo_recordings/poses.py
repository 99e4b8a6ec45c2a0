"""Poses in space over time: tracks that are interpolated, trees of transforms, and what is planar of a pose."""

from __future__ import annotations

import math
import warnings
from bisect import bisect_left
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ngo_recordings.bounds import check_regular
from ngo_recordings.errors import RecordingError

# Stamps that went through a text file come back rounded; so close they are the same.
_SAME_NS = 1_000_000
_LONGEST_QUATERNION = 1e100  # the square of a longer one may overflow
# Nanoseconds of a later stamp do not fit into 64 bits.
_END_OF_TIME_S = 9.2e9


@dataclass(frozen=True)
class Pose:
    """Position ``(3,)`` in m and orientation of one frame in another."""

    position: np.ndarray
    rotation: Rotation

    def __matmul__(self, other: Pose) -> Pose:
        """``a_from_c = a_from_b @ b_from_c``."""
        return Pose(self.position + self.rotation.apply(other.position), self.rotation * other.rotation)

    def inverse(self) -> Pose:
        """The other way round."""
        back = self.rotation.inv()
        return Pose(-back.apply(self.position), back)

    def planar(self) -> tuple[np.ndarray, np.ndarray]:
        """``(x, y, yaw)``, and what that leaves out: ``(z, roll, pitch)``; yaw is the direction of x from above."""
        matrix = self.rotation.as_matrix()
        yaw = math.atan2(matrix[1, 0], matrix[0, 0])
        roll = math.atan2(matrix[2, 1], matrix[2, 2])
        pitch = math.asin(min(1.0, max(-1.0, -matrix[2, 0])))
        x, y, z = self.position.tolist()
        return np.array([x, y, yaw]), np.array([z, roll, pitch])


def make_pose(position: tuple[float, float, float], quaternion_xyzw: tuple[float, float, float, float]) -> Pose | None:
    """A pose of numbers; None where they are none, as of a tracker that has lost its target."""
    values = np.array([*position, *quaternion_xyzw])
    if not np.isfinite(values).all() or not 1e-6 <= math.hypot(*values[3:]) <= _LONGEST_QUATERNION:
        return None
    return Pose(values[:3], Rotation.from_quat(values[3:]))


class PoseTrack:
    """Poses at rising stamps; between two that are at most gap_ns apart, they are interpolated."""

    def __init__(self, gap_ns: int) -> None:
        self._gap_ns = gap_ns
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest_ns(self) -> int | None:
        """Newest stamp."""
        return self._stamps[-1] if self._stamps else None

    def add(self, stamp_ns: int, pose: Pose) -> None:
        """Add a pose; one that comes late goes to its place, one of a known stamp replaces what was there."""
        if not self._stamps or stamp_ns > self._stamps[-1]:
            self._stamps.append(stamp_ns)
            self._poses.append(pose)
            return
        index = bisect_left(self._stamps, stamp_ns)
        if self._stamps[index] == stamp_ns:
            self._poses[index] = pose
        else:
            self._stamps.insert(index, stamp_ns)
            self._poses.insert(index, pose)

    def at(self, stamp_ns: int) -> Pose | None:
        """The pose at a stamp, on a straight line and the shortest turn between two; None where the gap is too wide."""
        index = bisect_left(self._stamps, stamp_ns)
        if index < len(self._stamps) and self._stamps[index] == stamp_ns:
            return self._poses[index]
        if 0 < index < len(self._stamps) and self._stamps[index] - self._stamps[index - 1] <= self._gap_ns:
            before, after = self._poses[index - 1], self._poses[index]
            share = (stamp_ns - self._stamps[index - 1]) / (self._stamps[index] - self._stamps[index - 1])
            turn = (before.rotation.inv() * after.rotation).as_rotvec()
            return Pose(
                before.position + share * (after.position - before.position),
                before.rotation * Rotation.from_rotvec(share * turn),
            )
        for near in (index - 1, index):
            if 0 <= near < len(self._stamps) and abs(self._stamps[near] - stamp_ns) <= _SAME_NS:
                return self._poses[near]
        return None

    def forget_before(self, stamp_ns: int) -> None:
        """Drop what no stamp from stamp_ns on needs."""
        # In larger pieces: each takes time in proportion to what is left.
        keep = bisect_left(self._stamps, stamp_ns) - 1
        if keep > 256:
            del self._stamps[:keep], self._poses[:keep]

    def clear(self) -> None:
        """Drop all."""
        self._stamps.clear()
        self._poses.clear()


class TransformTree:
    """Transforms by child frame, looked up through the tree at any stamp for which all of them are known."""

    def __init__(self, gap_ns: int) -> None:
        self._gap_ns = gap_ns
        self._static: dict[str, tuple[str, Pose]] = {}
        self._moving: dict[str, tuple[str, PoseTrack]] = {}

    def add(self, parent: str, child: str, stamp_ns: int, parent_from_child: Pose, static: bool) -> None:
        """Add a transform; a child has one parent, the newest."""
        if static:
            self._static[child] = (parent, parent_from_child)
            return
        if child not in self._moving or self._moving[child][0] != parent:
            self._moving[child] = (parent, PoseTrack(self._gap_ns))
        self._moving[child][1].add(stamp_ns, parent_from_child)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Pose | None:
        """Pose of frame source in frame target; None where no chain of transforms joins them at this stamp."""
        up_from_target, up_from_source = self.above(target), self.above(source)
        # As tf2 walks: where transforms go round, first from the source up to the target.
        shared = [frame for frame in up_from_source if frame in up_from_target]
        common = target if target in shared else next(iter(shared), None)
        if common is None:
            return None
        common_from_source = self._up(up_from_source, common, stamp_ns)
        common_from_target = self._up(up_from_target, common, stamp_ns)
        if common_from_source is None or common_from_target is None:
            return None
        return common_from_target.inverse() @ common_from_source

    def known_until_ns(self, target: str, source: str) -> int | None:
        """Newest stamp at which the chain may be known; None where there is no chain."""
        newest_ns = self.newest_ns(target, source)
        return None if newest_ns is None else min(newest_ns.values(), default=2**63 - 1)

    def newest_ns(self, target: str, source: str) -> dict[str, int] | None:
        """Newest stamps of what moves in the chain, by child frame; None where there is no chain."""
        up_from_target, up_from_source = self.above(target), self.above(source)
        shared = set(up_from_target) & set(up_from_source)
        if not shared:
            return None
        chain = {*up_from_target, *up_from_source} - shared
        return {frame: self._moving[frame][1].newest_ns or 0 for frame in chain if frame in self._moving}

    def frames(self) -> set[str]:
        """Names of all frames."""
        edges = [*self._static.items(), *self._moving.items()]
        return {frame for child, (parent, _) in edges for frame in (child, parent)}

    def forget_before(self, stamp_ns: int, child: str | None = None) -> None:
        """Drop what no stamp from stamp_ns on needs, of one child frame or of all."""
        for name, (_, track) in self._moving.items():
            if child in (None, name):
                track.forget_before(stamp_ns)

    def clear(self, child: str | None = None) -> None:
        """Drop what moves, of one child frame or of all; static transforms stay."""
        if child is None:
            self._moving.clear()
        else:
            self._moving.pop(child, None)

    def joined(self, one: str, other: str) -> bool:
        """Whether a chain of transforms joins two frames."""
        return not set(self.above(one)).isdisjoint(self.above(other))

    def between(self, one: str, other: str) -> list[str]:
        """The frames of the chain that joins two, the uppermost included; none where no chain does."""
        above_one, above_other = self.above(one), self.above(other)
        top = next((frame for frame in above_one if frame in above_other), None)
        if top is None:
            return []
        return [*above_one[: above_one.index(top)], top, *above_other[: above_other.index(top)]]

    def root(self, frame: str) -> str:
        """The uppermost frame above a frame, which may be itself."""
        return self.above(frame)[-1]

    def parent(self, frame: str) -> str | None:
        """The frame above a frame; None where there is none."""
        edge = self._moving.get(frame) or self._static.get(frame)
        return edge[0] if edge else None

    def above(self, frame: str) -> list[str]:
        """The frame itself, its parent, and so on."""
        found = [frame]
        while (parent := self.parent(found[-1])) is not None and parent not in found:
            found.append(parent)
        return found

    def _up(self, ancestors: list[str], to: str, stamp_ns: int) -> Pose | None:
        """Pose of the first of the ancestors in another of them."""
        total = Pose(np.zeros(3), Rotation.identity())
        for frame in ancestors[: ancestors.index(to)]:
            moving = self._moving.get(frame)
            step = moving[1].at(stamp_ns) if moving else self._static[frame][1]
            if step is None:
                return None
            total = step @ total
        return total


def read_tum(path: Path, gap_ns: int) -> PoseTrack:
    """Poses of a file in the TUM format, ``timestamp tx ty tz qx qy qz qw`` (s, m).

    Raises RecordingError where it is not.
    """
    check_regular(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is told below
            rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read as a TUM file: {' '.join(str(error).split())}") from None
    if not len(rows) or rows.shape[1] != 8:
        raise RecordingError(f"{path} has {len(rows)} rows of {rows.shape[1]} numbers; expected 8: t x y z qx qy qz qw")
    stamps = rows[:, 0]
    if not ((stamps >= 0.0) & (stamps < _END_OF_TIME_S)).all():  # NaN compares false
        wrong = stamps[~((stamps >= 0.0) & (stamps < _END_OF_TIME_S))][0]
        raise RecordingError(f"{path} has the stamp {wrong:g} s; expected seconds from 0 to {_END_OF_TIME_S:g}")
    track = PoseTrack(gap_ns)
    for stamp_s, *values in rows.tolist():
        pose = make_pose((values[0], values[1], values[2]), (values[3], values[4], values[5], values[6]))
        if pose is not None:
            track.add(round(stamp_s * 1e9), pose)
    return track
