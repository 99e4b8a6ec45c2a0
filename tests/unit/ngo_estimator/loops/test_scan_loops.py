"""Loops of scans: which keys are looked at, what a loop needs to be used, and what is kept of key scans."""

import math
import re

import numpy as np
import pytest

from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.key_scan_store import KeyScanStore
from ngo_estimator.loops.key_scan_views import KeyScanViews
from ngo_estimator.loops.scan_loop_agreement import with_agreement
from ngo_estimator.loops.scan_loop_candidates import covariance_windows
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig, ScanLoopConfig, WindowConfig
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.lidar_steps import HOUSE, drifted, lidar_steps, loop_way
from tests.unit.ngo_estimator.ray_casting import ROOM, fan, scan_at

# Along a straight line and back over the same places.
POSES = np.array([(float(min(k, 19 - k)), 0.0, 0.0 if k < 10 else np.pi) for k in range(20)])


def loop(earlier: int, later: int, off_m: float = 0.0) -> ScanLoops:
    """A loop of two keys in one place, which look in opposite directions; half a deviation from the graph's pose."""
    evidence = np.where(np.array(EVIDENCE) == "disagreement", 0.5, 0.0)[None]
    return ScanLoops(
        np.array(((earlier, later),)), np.array(((off_m, 0.0, np.pi),)), np.eye(3)[None], evidence, np.zeros(1, bool)
    )


def test_neighbours_that_agree_count_for_each_other() -> None:
    loops = loop(3, 16).extended(loop(2, 17, off_m=1.0)).extended(loop(1, 18))
    counted = with_agreement(ScanLoopConfig(), loops, 2, POSES)
    np.testing.assert_array_equal(counted.agreeing, (1, 0, 1))
    np.testing.assert_array_equal(counted.accepted, (True, False, True))
    assert not loops.agreeing.any()


def test_loops_of_one_key_are_no_neighbours() -> None:
    counted = with_agreement(ScanLoopConfig(), loop(3, 16).extended(loop(3, 16)), 1, POSES)
    assert not counted.agreeing.any() and not counted.accepted.any()


def test_windows_grow_with_the_covariance_up_to_their_limit() -> None:
    config = WindowConfig(least_m=0.3, most_m=8.0, least_deg=8.0, most_deg=45.0, deviations=3.0)
    turned, cos, sin = np.diag((1e-4, 1.0, math.radians(5.0) ** 2)), math.cos(0.7), math.sin(0.7)
    axes = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    windows = covariance_windows(
        config, np.stack((np.zeros((3, 3)), axes @ turned @ axes.T, np.diag((9.0, 0.0, 1.0)), np.full((3, 3), np.inf)))
    )
    np.testing.assert_allclose(windows[:, 0], (0.3, 3.3, 8.0, np.inf))
    np.testing.assert_allclose(np.degrees(windows[:, 2]), (8.0, 23.0, 45.0, np.inf))


COVARIANCE = np.diag((0.02**2, 0.02**2, 0.005**2))


def straight(keys: int) -> PoseGraph:
    """Key scans on a line, one each metre."""
    chain, step = PoseGraph(1e-8 * np.eye(3)), np.array((1.0, 0.0, 0.0))
    for _ in range(1, keys):
        chain.append(step, COVARIANCE, joins=False)
        chain.add_node(COVARIANCE)
    return chain


def measured_loop(relative: tuple[float, float, float], agreeing: int) -> ScanLoops:
    """A measured_loop from the first to the last of ten key scans."""
    evidence = np.zeros((1, len(EVIDENCE)))
    evidence[0, EVIDENCE.index("agreeing")] = agreeing
    return ScanLoops(np.array(((0, 9),)), np.array((relative,)), COVARIANCE[None], evidence, np.ones(1, bool))


@pytest.mark.parametrize(("off_m", "redundant", "used"), [(0.0, 1e6, 0), (0.0, 1.0, 1), (5.0, 1e6, 1)])
def test_a_loop_is_used_where_it_tells_something_new(off_m: float, redundant: float, used: int) -> None:
    finder = ScanLoopFinder(ScanGraphConfig(redundant=redundant))
    believed = finder.believed(finder.add(measured_loop((9.0 + off_m, 0.0, 0.0), 1)), straight(10))
    assert len(believed) == 1
    assert finder.use(believed, straight(10)) == (off_m > 0.0)
    assert len(finder.used) == used


def test_a_doubted_loop_waits_until_enough_loops_agree() -> None:
    config = ScanGraphConfig(agreeing_beyond=5)
    finder, lost = ScanLoopFinder(config), straight(10)
    lost.step_covariance[:] = np.eye(3)
    fresh, nothing = finder.add(measured_loop((9.0, 0.0, 0.0), 4)), np.zeros(0, np.int64)
    assert len(finder.believed(fresh, lost)) == 0
    assert len(finder.believed(nothing, lost)) == 0
    finder.loops = measured_loop((9.0, 0.0, 0.0), 5)
    assert len(finder.believed(nothing, lost)) == 1
    assert len(finder.believed(nothing, lost)) == 0


def some_loops(*pairs: tuple[int, int]) -> ScanLoops:
    count = len(pairs)
    return ScanLoops(
        np.array(pairs), np.ones((count, 3)), np.ones((count, 3, 3)), np.ones((count, len(EVIDENCE))),
        np.ones(count, bool),
    )  # fmt: skip


def test_loops_come_back_from_their_state() -> None:
    loops = ScanLoops.none().extended(some_loops((0, 4), (1, 5)))
    for name, rows in vars(restore(ScanLoops.none(), state_of(loops))).items():
        np.testing.assert_array_equal(rows, getattr(loops, name))


def test_a_state_with_loops_of_other_keys_is_refused() -> None:
    finder = ScanLoopFinder(ScanGraphConfig())
    finder.loops = some_loops((0, 5))
    with pytest.raises(StateError, match="not among the 0"):
        restore(ScanLoopFinder(ScanGraphConfig()), state_of(finder))


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="shape"):
        ScanLoops(np.zeros((2, 2)), np.zeros((1, 3)), np.zeros((2, 3, 3)), np.zeros((2, 6)), np.zeros(2, bool))


@pytest.mark.parametrize(
    ("settings", "name", "value"),
    [
        (ScanLoopConfig, "every", 0),
        (ScanLoopConfig, "most_per_key", -1),
        (ScanLoopConfig, "least_response", 1.5),
        (ScanLoopConfig, "range_m", math.inf),
        (ScanLoopConfig, "search_factor", 0.5),
        (ScanLoopConfig, "most_disagreement", math.nan),
        (ScanLoopConfig, "source_keys", 16),
        (WindowConfig, "least_m", 9.0),
        (WindowConfig, "least_deg", 0.0),
        (WindowConfig, "most_m", math.inf),
        (WindowConfig, "most_deg", 200.0),
        (WindowConfig, "deviations", 0.0),
        (ScanGraphConfig, "keys_between", 0),
        (ScanGraphConfig, "most_scans", 99),
        (ScanGraphConfig, "agreeing_beyond", -1),
        (ScanGraphConfig, "kernel", math.nan),
    ],
)
def test_a_value_out_of_range_is_refused_by_name(settings: type, name: str, value: float) -> None:
    with pytest.raises(ValueError, match=rf"^{name} is {re.escape(str(value))}; expected "):
        settings(**{name: value})


def test_no_limit_of_disagreement_and_windows_of_one_width_are_allowed() -> None:
    assert ScanLoopConfig(most_disagreement=math.inf).most_disagreement == math.inf
    assert WindowConfig(least_m=2.0, most_m=2.0).least_m == 2.0


VIEWED_FROM = np.array(((0.0, 0.0, 0.0), (0.0, 0.0, np.pi), (0.1, 0.0, 0.0)))
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
    np.testing.assert_allclose(views.at(VIEWED_FROM), ((4.0, 0.0), (-4.0, 0.0), (4.1, 0.0)), atol=1e-12)
    assert views.most_alike(VIEWED_FROM, AHEAD, VIEWED_FROM[1])[0] == 1
    assert views.most_alike(VIEWED_FROM, AHEAD, VIEWED_FROM[0])[0] == 0
    views.thin(np.array((False, True, True)))
    assert views.most_alike(VIEWED_FROM[1:], AHEAD, VIEWED_FROM[0])[0] == 1


def test_views_of_a_map_leave_those_of_its_first_scans_as_they_are() -> None:
    views, scans = seen(2), [scan(k) for k in range(3)]
    whole = views.of_map(scans)
    whole.thin(np.array((True, False, True)))
    assert len(whole) == len(views) == 2 and whole.profiles[1].any()


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
