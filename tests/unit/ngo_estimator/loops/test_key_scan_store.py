"""Key scans in bounded memory: nothing is lost by being compact, and the places seen most often are thinned."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.loops.key_scan_store import KeyScanStore
from ngo_estimator.loops.scan_settings import ScanGraphConfig, ScanLoopConfig
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.lidar_steps import HOUSE, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import ROOM, fan, scan_at

ANGLES = fan(181, 270.0)


def filled(poses: np.ndarray) -> KeyScanStore:
    store = KeyScanStore()
    for k, pose in enumerate(poses):
        store.append(scan_at(ROOM, np.array((1.0, 1.0, pose[2])), k, fan(31, 180.0)))
    store.compact()
    return store


def test_compact_key_scans_are_the_same() -> None:
    scans = [scan_at(ROOM, np.array((1.0, 1.0 + 0.1 * k, 0.2)), k, ANGLES) for k in range(5)]
    store = KeyScanStore()
    for scan in scans:
        store.append(scan)
        store.compact()
    assert len(store) == 5 and store.points == sum(len(scan.points) for scan in scans)
    for scan, kept in zip(scans, store[:], strict=True):
        assert kept.points.dtype == kept.normals.dtype == np.float64
        assert scan.points.tobytes() == kept.points.tobytes() and scan.normals.tobytes() == kept.normals.tobytes()
        assert scan.stamp_ns == kept.stamp_ns and not len(kept.ranges)
    assert sum(each.points.nbytes + each.normals.nbytes + each.ranges.nbytes for each in store._scans) < 0.5 * sum(
        scan.points.nbytes + scan.normals.nbytes + scan.ranges.nbytes for scan in scans
    )


def test_places_seen_once_are_kept_and_none_is_forgotten_whole() -> None:
    """Five times round a circle, and then a way of its own."""
    turn = np.linspace(0.0, 10.0 * math.pi, 300, endpoint=False)
    circle = np.column_stack((3.0 * np.sin(turn), -3.0 * np.cos(turn), turn))
    alone = np.column_stack((10.0 + 0.3 * np.arange(60), np.zeros(60), np.zeros(60)))
    poses = np.concatenate((circle, alone))
    store = filled(poses)
    gone = store.forget(180, poses, newest=15)
    assert 180 <= len(gone) < 180 + 15 and store.kept == 360 - len(gone) and max(gone) < 300
    assert all(len(store[k].points) == 0 for k in gone) and len(store) == 360
    kept = np.setdiff1d(np.arange(300), gone)
    away = np.linalg.norm(circle[:, None, :2] - circle[kept][None, :, :2], axis=-1).min(1)
    assert away.max() < 1.0  # every place of the circle is still there


def test_the_newest_stay_where_everything_was_seen_once() -> None:
    poses = np.column_stack((0.3 * np.arange(200), np.zeros(200), np.zeros(200)))
    store = filled(poses)
    gone = store.forget(150, poses, newest=30)
    assert max(gone) < 170 and 150 <= len(gone) <= 165
    assert sorted(store.forget(1000, poses, newest=30)) == [k for k in range(170) if k not in gone]
    assert store.forget(10, poses, newest=30) == []


def test_loops_are_found_where_scans_were_forgotten() -> None:
    """Three times round with room for less than one round and a half: drift is still taken out."""
    true = loop_way(3.0)
    odometry, generator = drifted(true, (0.01, 0.005, 0.004)), np.random.default_rng(0)

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return scan_at(HOUSE, true[k], stamp_ns, ANGLES, noise=(0.01, generator))

    trajectory = ScanTrajectory(ScanGraphConfig(most_scans=150, loops=ScanLoopConfig(every=4)))
    most = 0
    for step in lidar_steps(odometry, scan):
        assert trajectory.update(step).fault == ""
        most = max(most, trajectory._graph._scans.kept)
    trajectory.finish()
    whole = trajectory.trajectory()
    assert whole is not None and trajectory._graph.keys > 250 and most <= 170
    assert np.linalg.norm((whole.poses_xyyaw - true)[:, :2], axis=1).max() < 0.4
    assert len(trajectory.walls(5000)) > 2000


def test_compact_scans_change_no_result(monkeypatch: pytest.MonkeyPatch) -> None:
    true = loop_way(1.2)
    odometry, generator = drifted(true, (0.01, 0.005, 0.004)), np.random.default_rng(0)
    steps = list(lidar_steps(odometry, lambda k, ns: scan_at(HOUSE, true[k], ns, ANGLES, noise=(0.01, generator))))
    results = []
    for compact in (True, False):
        if not compact:
            monkeypatch.setattr(KeyScanStore, "compact", lambda _: None)
        trajectory = ScanTrajectory()
        for step in steps:
            trajectory.update(step)
        trajectory.finish()
        whole = trajectory.trajectory()
        assert whole is not None and len(whole.loops)
        results.append(whole.poses_xyyaw.tobytes())
    assert results[0] == results[1]
