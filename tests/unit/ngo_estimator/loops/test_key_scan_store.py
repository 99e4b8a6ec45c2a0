"""Key scans in little memory: nothing is lost by being compact, and a graph is bounded by the place."""

import numpy as np
import pytest

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.loops.key_scan_store import KeyScanStore
from ngo_estimator.loops.scan_settings import ScanGraphConfig, ScanLoopConfig
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.lidar_steps import HOUSE, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import ROOM, fan, scan_at

ANGLES = fan(181, 270.0)


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


def test_a_graph_that_lets_old_key_scans_go_stays_as_good() -> None:
    """Three times round with room for less than one round and a half: drift is still taken out, of all frames."""
    true = loop_way(3.0)
    odometry, generator = drifted(true, (0.01, 0.005, 0.004)), np.random.default_rng(0)

    def scan(k: int, stamp_ns: int) -> KeyScan:
        return scan_at(HOUSE, true[k], stamp_ns, ANGLES, noise=(0.01, generator))

    trajectory = ScanTrajectory(ScanGraphConfig(most_scans=150, loops=ScanLoopConfig(every=4)))
    most = 0
    for step in lidar_steps(odometry, scan):
        assert trajectory.update(step).fault == ""
        most = max(most, len(trajectory.back_end.graph))
    trajectory.finish()
    whole = trajectory.trajectory()
    assert whole is not None and len(whole.poses_xyyaw) == len(true) and 150 < most <= 180
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
