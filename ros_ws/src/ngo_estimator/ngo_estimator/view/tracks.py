"""Trajectories of several frames, brought into the one of the corrected trajectory and compared."""

from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.geometry.planar_motion import between, compose, transformed

RESTART_NS = 1_000_000_000
"""A stamp that jumps back by this means a restarted source, for the view as for the estimators."""


class Track:
    """Stamped planar poses in order of time. A restarted source begins the track anew."""

    def __init__(self) -> None:
        self._begin()

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def stamps_ns(self) -> np.ndarray:
        """Stamps ``(n,)`` in nanoseconds, increasing."""
        return self._stamps.values

    @property
    def poses_xyyaw(self) -> np.ndarray:
        """Poses ``(n, 3)`` in the track's own frame: m, m, rad."""
        return self._poses.values

    def append(self, stamp_ns: int, pose_xyyaw: np.ndarray) -> None:
        """Add a pose ``(3,)``; one that is not newer than the last is dropped."""
        if len(self) and stamp_ns <= (newest := int(self.stamps_ns[-1])):
            if stamp_ns > newest - RESTART_NS:
                return
            self._begin()
        self._stamps.append(stamp_ns)
        self._poses.append(pose_xyyaw)

    def _begin(self) -> None:
        self._stamps, self._poses = GrowingRows((), np.int64), GrowingRows((3,), np.float64)


@dataclass(frozen=True, eq=False)
class StampedPoses:
    """Poses ``(n, 3)`` (m, m, rad) at increasing stamps ``(n,)`` in nanoseconds."""

    stamps_ns: np.ndarray
    poses_xyyaw: np.ndarray

    def at(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Poses ``(m, 3)`` between the two nearest ones, at stamps within the span of these."""
        times, own = stamps_ns - self.stamps_ns[0], self.stamps_ns - self.stamps_ns[0]
        x, y, yaw = self.poses_xyyaw.T
        return np.stack([np.interp(times, own, values) for values in (x, y, np.unwrap(yaw))], axis=1)

    def covers(self, stamps_ns: np.ndarray) -> np.ndarray:
        """Which of the stamps ``(m,)`` lie in the span of these."""
        return (stamps_ns >= self.stamps_ns[0]) & (stamps_ns <= self.stamps_ns[-1])


def begun_with_identity(track: Track, corrected: StampedPoses) -> StampedPoses:
    """The odometry with the identity in the first frame of the corrected trajectory.

    ``local_node`` publishes no odometry for the first frame, where it is the identity. A track that began later than
    the second frame, or earlier than the first, stays as it is.
    """
    stamps, poses = track.stamps_ns, track.poses_xyyaw
    first = corrected.stamps_ns[:2]
    if first[0] < stamps[0] <= first[-1]:
        return StampedPoses(np.append(first[0], stamps), np.vstack([np.zeros(3), poses]))
    return StampedPoses(stamps, poses)


def placed(track: StampedPoses, corrected: StampedPoses) -> StampedPoses | None:
    """A track in the frame of the corrected trajectory: both have the same pose at the first stamp that they share.

    None where they share no time.
    """
    shared = np.flatnonzero(track.covers(corrected.stamps_ns))
    if not len(shared):
        return None
    stamp = corrected.stamps_ns[shared[:1]]
    map_from_track = compose(corrected.poses_xyyaw[shared[0]], between(track.at(stamp)[0], np.zeros(3)))
    xy = transformed(map_from_track, np.ascontiguousarray(track.poses_xyyaw[:, :2]))
    return StampedPoses(track.stamps_ns, np.column_stack([xy, track.poses_xyyaw[:, 2] + map_from_track[2]]))


def position_rmse_m(track: StampedPoses, truth: StampedPoses, stamps_ns: np.ndarray) -> float | None:
    """RMSE of the positions at those of the stamps ``(n,)`` that both cover; None where there is none."""
    stamps = stamps_ns[track.covers(stamps_ns) & truth.covers(stamps_ns)]
    if not len(stamps):
        return None
    off = track.at(stamps)[:, :2] - truth.at(stamps)[:, :2]
    return float(np.sqrt((off**2).sum(axis=1).mean()))
