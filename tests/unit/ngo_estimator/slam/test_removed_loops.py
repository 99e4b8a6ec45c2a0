"""Loops that a person takes out: the poses are those without them, and they do not come back."""

import numpy as np
import pytest

from ngo_estimator.geometry import se2
from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.robust import Robust
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.loop_report import LoopReport, loop_report
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.trajectory.g2o import PlanarGraph
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs
from training.scoring.online_estimate import steps_of

from .test_scan_trajectory import loop_drive


def graph_of(core: CorrectedTrajectory) -> PlanarGraph:
    graph = core.planar_graph()
    assert graph is not None
    return graph


def loops_of(core: CorrectedTrajectory) -> list[tuple[int, int]]:
    """Frames that the loops join."""
    graph, trajectory = graph_of(core), core.trajectory()
    assert trajectory is not None
    frames = np.searchsorted(trajectory.stamps_ns, graph.stamps_ns)
    return [tuple(pair) for pair in frames[graph.edges[graph.is_loop]].tolist()]


@pytest.fixture(scope="module")
def lidar() -> ScanTrajectory:
    core = ScanTrajectory()
    for step in loop_drive()[2]:
        core.update(step)
    core.finish()
    return core


@pytest.fixture
def pictures() -> OnlineTrajectory:
    core = OnlineTrajectory(small_optimizer(trained=True), small_pair_head(), 64)
    names = ("relative", "log_std", "motion", "codes")
    for step in steps_of({name: of[0].numpy() for name, of in zip(names, trajectory_inputs(1, 80), strict=True)}):
        core.update(step)
    return core


def test_the_graph_of_a_lidar_is_what_was_solved(lidar: ScanTrajectory) -> None:
    graph, (steps, loops) = graph_of(lidar), lidar.back_end.measurements()
    assert len(graph.ids) == len(lidar.back_end.graph) and graph.is_loop.sum() == len(loops) > 10
    np.testing.assert_array_equal(graph.information[graph.is_loop], loops.information)
    assert set(graph.belief[graph.is_loop]) <= {0.0, 1.0} and np.nanmean(graph.belief) > 0.9
    assert len(steps) == (~graph.is_loop).sum()


def test_without_a_loop_a_lidar_has_the_poses_that_the_others_give(lidar: ScanTrajectory) -> None:
    core = lidar.restored(lidar.state())
    chosen, *others = loops_of(core)
    assert core.loop_report().scales is None  # a state has none
    assert core.remove_loops(*chosen) == 1 and core.fault == ""
    assert core.loop_report().scales is not None
    assert loops_of(core) == others and core.remove_loops(*chosen) == 0
    steps, loops = core.back_end.measurements()
    alone = Robust().correct(GraphProblem(graph_of(lidar).poses, steps, loops, np.ones(len(loops))))
    np.testing.assert_allclose(se2.between(graph_of(core).poses, alone.poses), 0.0, atol=1e-9)
    again = core.restored(core.state())
    again.finish()
    assert loops_of(again) == others


def test_without_any_loop_a_lidar_follows_its_odometry(lidar: ScanTrajectory) -> None:
    core = lidar.restored(lidar.state())
    there = len(loops_of(core))
    last = len(loop_drive()[1]) - 1
    assert core.remove_loops(0, last, stretch=True) == there and loops_of(core) == []
    trajectory = core.trajectory()
    assert trajectory is not None
    np.testing.assert_allclose(se2.between(trajectory.poses_xyyaw, trajectory.odometry_xyyaw), 0.0, atol=1e-6)
    assert core.newest().optimized


def test_what_is_thought_of_loops_is_counted_and_the_newest_refused_one_explained(lidar: ScanTrajectory) -> None:
    report, belief = lidar.loop_report(), graph_of(lidar).belief
    assert (report.believed, report.refused) == ((belief == 1.0).sum(), (belief == 0.0).sum())
    pairs, poses = np.array(((0, 1), (1, 2), (0, 2), (0, 3))), np.arange(4.0)[:, None] * (1.0, 0.0, 0.0)
    relative = np.array(((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (2.0, 3.0, 0.0), (3.0, 0.0, 0.5)))
    counted = loop_report(
        pairs, relative, np.array((1.0, 0.3, 0.0, 0.05)), 2, 10**9 * np.arange(1, 5), poses, (1.0, 4.0)
    )
    assert (counted.believed, counted.doubted, counted.refused, counted.scales) == (1, 3, 2, (1.0, 4.0))
    assert counted.newest_refused == "from 1.000 s to 4.000 s: 0 m and 28.6 deg off what all others say"
    nothing = loop_report(pairs[:0], relative[:0], np.zeros(0), 0, np.arange(4), poses, (1.0, 1.0))
    assert nothing == LoopReport(0, 0, 0, "", (1.0, 1.0))


def test_pictures_lose_a_loop_and_a_stretch(pictures: OnlineTrajectory) -> None:
    core, before = pictures, loops_of(pictures)
    chosen = before[len(before) // 2]
    removed = core.remove_loops(*chosen)
    assert removed >= 1 and chosen not in loops_of(core) and core.fault == ""
    assert np.isfinite(graph_of(core).poses).all()
    low, high = chosen[0], chosen[0] + 8
    core.remove_loops(low, high, stretch=True)
    left = np.array(loops_of(core))
    assert len(left) and not ((left >= low) & (left <= high)).any()
