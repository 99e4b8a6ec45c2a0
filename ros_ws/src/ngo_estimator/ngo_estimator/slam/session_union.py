"""Saved sessions of lidars in one map: each is driven again behind the first, from a place that nobody knows.

What ties a session to the map is what ties a robot that was carried: the search in the own map (``own_map``), and the
corrector, which may refuse it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.graph.pose_graph import OPEN
from ngo_estimator.slam.scan_trajectory import ScanTrajectory

_NOTHING = np.zeros(0, np.float32)

_PAUSE_NS = 1_000_000_000
"""Between two sessions of which the later one in the map did not come later."""


@dataclass(frozen=True)
class Union:
    """One ``trajectory`` of several sessions.

    ``left_out`` are the numbers of those that it does not hold, as nothing says where they lie in its map. ``later_ns``
    is by how much the stamps of each are later than they were: 0 where they came after those before it.
    """

    trajectory: ScanTrajectory
    left_out: Sequence[int]
    later_ns: Sequence[int]


def united(sessions: Sequence[ScanTrajectory]) -> Union:
    """Lay sessions into the map of the first one; those given stay as they are.

    A session that does not meet the map is tried again when another one has made it larger.

    Raises:
        ValueError: there are fewer than two sessions, or one of them has no frame.
    """
    empty = [number for number, session in enumerate(sessions) if session.trajectory() is None]
    if len(sessions) < 2 or empty:
        raise ValueError(f"{len(sessions)} sessions, without frames: {empty}; expected two or more with frames")
    union, later_ns = sessions[0].restored(sessions[0].state()), [0] * len(sessions)
    waiting, grew = list(range(1, len(sessions))), True
    while grew:
        grew = False
        for number in list(waiting):
            grown, later = _with(union, sessions[number])
            if grown.newest().lost_since_ns is None:
                union, later_ns[number], grew = grown, later, True
                waiting.remove(number)
    return Union(union, waiting, later_ns)


def _with(union: ScanTrajectory, session: ScanTrajectory) -> tuple[ScanTrajectory, int]:
    """The union with a session behind it, wherever that lies; and by how much its stamps are later (ns)."""
    grown = union.restored(union.state())
    first, *steps = replayed_steps(session)
    ended_ns = grown.newest().stamp_ns
    later_ns = 0 if first.stamp_ns > ended_ns else ended_ns + _PAUSE_NS - first.stamp_ns
    grown.begin_segment(_later(first, later_ns))
    for step in steps:
        grown.update(_later(step, later_ns))
    grown.finish()
    return grown, later_ns


def replayed_steps(session: ScanTrajectory) -> Iterator[RelativeStep]:
    """The steps of a session as its odometry had them; the first, which nobody measured, ends at the first frame."""
    log, graph = session.log, session.back_end.graph
    stamps, frames = log.stamps_ns.values.tolist(), graph.frames.odometry
    variance = log.odometry_std.values.astype(np.float64) ** 2
    keys = {frame: key for key, frame in enumerate(graph.frames.nodes.tolist())}
    opens = set(graph.segment_frames.tolist())
    for frame, stamp_ns in enumerate(stamps):
        yield RelativeStep(
            stamp_ns,
            stamps[frame - 1] if frame else stamp_ns - 1,
            between(frames[frame - 1], frames[frame]) if frame else np.zeros(3),
            np.diag(variance[frame - 1]) if frame else OPEN,
            stamps[0],
            log.odometry.values[frame].copy(),
            _NOTHING,
            _NOTHING,
            key=session.back_end.key_step(keys[frame]) if frame in keys else None,
            segment=frame in opens,
        )


def _later(step: RelativeStep, by_ns: int) -> RelativeStep:
    """A step whose stamps are later."""
    key = step.key and replace(
        step.key,
        scan=replace(step.key.scan, stamp_ns=step.key.scan.stamp_ns + by_ns),
        from_key_stamp_ns=step.key.from_key_stamp_ns + by_ns,
    )
    names = ("stamp_ns", "from_stamp_ns", "origin_stamp_ns")
    return replace(step, **{name: getattr(step, name) + by_ns for name in names}, key=key)
