"""Rooms that look alike are noticed on the way through them; a ring of corridors that differ is not ambiguous."""

import numpy as np

from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_settings import ScanLoopConfig
from ngo_estimator.slam.alike_places import MOST_ALIKE, alike_share
from tests.unit.ngo_estimator.loops.buildings import HALLWAY, ROUND, outline, scan_at, way

ROOM = np.concatenate(
    (
        [(0, 2, 0, 7), (0, 7, 6, 7), (6, 7, 6, 2), (0, 2, 2, 2), (3, 2, 6, 2), (6, 2, 7, 2), (0, 0, 7, 0)],
        outline((4, 5), (5.2, 5), (5.2, 5.8), (4, 5.8)),
        outline((0.6, 4), (1.4, 4.3), (1.1, 5)),
    )
)
"""With a stretch of the corridor before its door; the next one is 7 m farther."""
IN_AND_OUT = ((0.5, 1), (2.5, 1), (2.5, 4.2), (2.5, 1))


def share(walls: np.ndarray, poses: np.ndarray) -> float:
    random = np.random.default_rng(0)
    scans = [scan_at(walls, pose, random) for pose in poses]
    views = KeyScanViews().of_map(scans)
    return alike_share(np.arange(len(poses)), scans, views, poses, ScanLoopConfig())


def test_rooms_that_look_alike_are_noticed_and_corners_of_a_ring_are_told_apart() -> None:
    rooms = np.concatenate([ROOM + (x, 0, x, 0) for x in (0, 7, 14)])
    through = way(*[(x + dx, y) for x in (0, 7, 14) for dx, y in IN_AND_OUT])
    assert share(rooms, through) > MOST_ALIKE
    assert share(HALLWAY, way(*ROUND, ROUND[0])) < MOST_ALIKE
