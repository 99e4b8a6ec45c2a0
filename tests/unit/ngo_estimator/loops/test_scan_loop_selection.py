"""The graph uses the loops that it may believe and needs; a saved selection names loops that there are."""

import numpy as np
import pytest

from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig

COVARIANCE = np.diag((0.02**2, 0.02**2, 0.005**2))


def straight(keys: int) -> PoseGraph:
    """Key scans on a line, one each metre."""
    chain, step = PoseGraph(1e-8 * np.eye(3)), np.array((1.0, 0.0, 0.0))
    for _ in range(1, keys):
        chain.append(step, COVARIANCE, joins=False)
        chain.add_node(COVARIANCE)
    return chain


def loop(relative: tuple[float, float, float], agreeing: int) -> ScanLoops:
    """A loop from the first to the last of ten key scans."""
    evidence = np.zeros((1, len(EVIDENCE)))
    evidence[0, EVIDENCE.index("agreeing")] = agreeing
    return ScanLoops(np.array(((0, 9),)), np.array((relative,)), COVARIANCE[None], evidence, np.ones(1, bool))


@pytest.mark.parametrize(("off_m", "redundant", "used"), [(0.0, 1e6, 0), (0.0, 1.0, 1), (5.0, 1e6, 1)])
def test_a_loop_is_used_where_it_tells_something_new(off_m: float, redundant: float, used: int) -> None:
    finder = ScanLoopFinder(ScanGraphConfig(redundant=redundant))
    believed = finder.believed(finder.add(loop((9.0 + off_m, 0.0, 0.0), 1)), straight(10))
    assert len(believed) == 1
    assert finder.use(believed, straight(10)) == (off_m > 0.0)
    assert len(finder.used) == used


def test_a_doubted_loop_waits_until_enough_loops_agree() -> None:
    config = ScanGraphConfig(agreeing_beyond=5)
    finder, lost = ScanLoopFinder(config), straight(10)
    lost.step_covariance[:] = np.eye(3)
    fresh, nothing = finder.add(loop((9.0, 0.0, 0.0), 4)), np.zeros(0, np.int64)
    assert len(finder.believed(fresh, lost)) == 0
    assert len(finder.believed(nothing, lost)) == 0
    finder.loops = loop((9.0, 0.0, 0.0), 5)
    assert len(finder.believed(nothing, lost)) == 1
    assert len(finder.believed(nothing, lost)) == 0
