"""Wrong loops: as many as asked for, beside all right ones; and our corrector withstands them."""

import numpy as np
import pytest

from ngo_estimator.graph.relative_poses import RelativePoses
from training.baselines.lidar_peers import GraphPeerConfig, solve_lm
from training.scoring.wrong_loops import solve_ours, with_wrong_loops

NODES = 60
COVARIANCE = np.diag((0.02**2, 0.02**2, 0.01**2))


def straight(pairs: np.ndarray) -> RelativePoses:
    """What is measured between nodes one metre apart on a line."""
    relative = np.zeros((len(pairs), 3))
    relative[:, 0] = pairs[:, 1] - pairs[:, 0]
    return RelativePoses.of_covariances(pairs, relative, np.tile(COVARIANCE, (len(pairs), 1, 1)))


CHAIN = np.arange(NODES - 1)
STEPS = straight(np.stack((CHAIN, CHAIN + 1), axis=1))
LOOPS = straight(np.stack((np.arange(0, 40), np.arange(20, 60)), axis=1))
TRUTH = np.stack((np.arange(NODES), np.zeros(NODES), np.zeros(NODES)), axis=-1).astype(float)


@pytest.mark.parametrize(("percent", "wrong"), [(10, 4), (50, 40), (60, 60)])
def test_right_loops_stay_and_wrong_ones_are_a_share_of_all(percent: float, wrong: int) -> None:
    fed = with_wrong_loops(LOOPS, NODES, percent, np.random.default_rng(1))
    np.testing.assert_array_equal(fed.nodes[:40], LOOPS.nodes)
    assert wrong - 6 <= len(fed.nodes) - 40 <= wrong  # a few would join neighbours
    off = np.abs(fed.residuals(TRUTH)).max(axis=1)
    assert off[:40].max() < 1e-9
    assert (off[40:] > 3.0).all()
    assert fed.relative.shape == (len(fed.nodes), 3)
    assert fed.root.shape == (len(fed.nodes), 3, 3)


@pytest.mark.parametrize("percent", [20, 60])
def test_our_corrector_withstands_wrong_loops_and_least_squares_do_not(percent: float) -> None:
    fed = with_wrong_loops(LOOPS, NODES, percent, np.random.default_rng(2))
    start = TRUTH + np.linspace(0.0, 0.1, NODES)[:, None] * (1.0, 1.0, 0.1)
    config = GraphPeerConfig(cauchy=1e6)
    assert np.abs(solve_ours(STEPS, fed, start, config) - TRUTH).max() < 0.05
    assert np.abs(solve_lm(STEPS, fed, start, config) - TRUTH).max() > 1.0
