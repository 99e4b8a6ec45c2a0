"""Key scans that look the same way are alike."""

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.loops.key_scan_views import KeyScanViews

POSES = np.array(((0.0, 0.0, 0.0), (0.0, 0.0, np.pi), (0.1, 0.0, 0.0)))
AHEAD = np.array(((4.0, 0.5), (4.0, -0.5)))


def scan(stamp_ns: int) -> KeyScan:
    return KeyScan(stamp_ns, AHEAD, np.tile((1.0, 0.0), (2, 1)), np.zeros(3), np.zeros(1), np.ones(1), 10.0)


def seen(count: int) -> KeyScanViews:
    views = KeyScanViews()
    for k in range(count):
        views.append(scan(k))
    return views


def test_the_key_scan_most_alike_looks_the_same_way() -> None:
    views = seen(3)
    np.testing.assert_allclose(views.at(POSES), ((4.0, 0.0), (-4.0, 0.0), (4.1, 0.0)), atol=1e-12)
    assert views.most_alike(POSES, AHEAD, POSES[1]) == 1
    assert views.most_alike(POSES, AHEAD, POSES[0]) == 0
    views.thin(np.array((False, True, True)))
    assert views.most_alike(POSES[1:], AHEAD, POSES[0]) == 1


def test_views_of_a_map_leave_those_of_its_first_scans_as_they_are() -> None:
    views, scans = seen(2), [scan(k) for k in range(3)]
    whole = views.of_map(scans)
    whole.thin(np.array((True, False, True)))
    assert len(whole) == len(views) == 2 and whole.profiles[1].any()
