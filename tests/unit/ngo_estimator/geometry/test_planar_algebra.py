"""Planar motions, covariances and paths in compiled code and in arrays, against other ways to compute them."""

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_covariance import bounded, propagate, to_spatial
from ngo_estimator.geometry.planar_motion import frames_between_nodes, inverted, propagated, squared_deviations
from ngo_estimator.graph.shortest_paths import shortest_paths
from ngo_estimator.ngo.pose_aggregation import in_block_poses

RANDOM = np.random.default_rng(0)


def covariance() -> np.ndarray:
    root = RANDOM.normal(size=(3, 3)) * RANDOM.uniform(1e-3, 1.0)
    return root @ root.T + 1e-6 * np.eye(3)


def test_matrices_are_inverted_as_numpy_does() -> None:
    for _ in range(200):
        a = covariance()
        np.testing.assert_allclose(inverted(a), np.linalg.inv(a), rtol=1e-12)


def test_a_single_covariance_is_propagated_as_many_are() -> None:
    for _ in range(200):
        before, step, pose, relative = covariance(), covariance(), RANDOM.normal(size=3), RANDOM.normal(size=3)
        expected = propagate(before, pose, relative, step)
        np.testing.assert_allclose(propagated(before, pose, relative, step), expected, rtol=1e-12, atol=1e-15)


def test_a_turn_counts_the_shorter_way_round() -> None:
    away = squared_deviations(np.array((1.0, 2.0, 3.1)), np.array((1.0, 1.0, -3.1)), np.diag((1.0, 4.0, 100.0)))
    assert away == pytest.approx(4.0 + 100.0 * (2.0 * np.pi - 6.2) ** 2)


@pytest.mark.parametrize("loops", [0, 1, 30, 300])
def test_shortest_paths_are_those_of_dijkstra(loops: int) -> None:
    count = 400
    chain = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    across = np.sort(RANDOM.integers(0, count, (loops, 2)), axis=1)
    edges = np.concatenate((chain, across[across[:, 1] > across[:, 0]]))
    lengths = RANDOM.uniform(0.01, 1.0, len(edges))
    shortest = np.full((count, count), np.inf)
    np.minimum.at(shortest, tuple(edges.T), lengths)  # of two edges between the same keys the shorter one
    rows, columns = np.nonzero(np.isfinite(shortest))
    graph = coo_array((shortest[rows, columns], (rows, columns)), shape=(count, count)).tocsr()
    for key in (0, 137, count - 1):
        expected = dijkstra(graph, directed=False, indices=key)
        np.testing.assert_allclose(shortest_paths(edges, lengths, count, key), expected, rtol=1e-12)


def test_propagation_agrees_with_sampled_steps() -> None:
    rng = np.random.default_rng(0)
    step = np.array([0.5, 0.1, 0.3])
    step_covariance = np.diag([0.01, 0.005, 0.008]) ** 2
    noise = rng.multivariate_normal(np.zeros(3), step_covariance, (20_000, 12))
    samples, exact = torch.zeros(20_000, 3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    covariance = np.zeros((3, 3))
    for index in range(12):
        samples = se2.compose(samples, torch.from_numpy(step + noise[:, index]))
        exact = se2.compose(exact, torch.from_numpy(step))
        covariance = propagate(covariance, exact.numpy(), step, step_covariance)
    sampled = np.cov((samples - exact).numpy().T)
    np.testing.assert_allclose(covariance, sampled, atol=0.04 * np.abs(sampled).max())


def test_heading_error_moves_the_end_of_a_straight_step_sideways() -> None:
    before = np.diag([0.0, 0.0, 0.01**2])
    after = propagate(before, np.array([2.0, 0.0, 0.0]), np.array([2.0, 0.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(after, [[0.0, 0.0, 0.0], [0.0, 4e-4, 2e-4], [0.0, 2e-4, 1e-4]], atol=1e-18)


def test_spatial_form_has_x_y_and_yaw_in_their_places() -> None:
    spatial = to_spatial(np.arange(1.0, 10.0).reshape(3, 3)).reshape(6, 6)
    assert spatial[0].tolist() == [1.0, 2.0, 0.0, 0.0, 0.0, 3.0]
    assert spatial[1].tolist() == [4.0, 5.0, 0.0, 0.0, 0.0, 6.0]
    assert spatial[5].tolist() == [7.0, 8.0, 0.0, 0.0, 0.0, 9.0]
    assert not spatial[2:5].any()


@pytest.mark.parametrize("exponents", [(-4, -4, -6), (-12, 0, 0), (-10, -10, -10), (0, 0, 5), (-9, 3, -9)])
def test_a_bounded_covariance_keeps_its_axes(exponents: tuple[int, int, int]) -> None:
    """Variances from 1e-10 to 1e4 stay, others become the nearer of these."""
    generator = np.random.default_rng(5)
    for _ in range(20):
        axes = np.linalg.qr(generator.standard_normal((3, 3)))[0]
        variances = 10.0 ** np.array(exponents) * generator.uniform(1.0, 3.0, 3)
        expected = (axes * np.clip(variances, 1e-10, 1e4)) @ axes.T
        assert bounded((axes * variances) @ axes.T) == pytest.approx(
            expected, rel=1e-6, abs=1e-3 * 1e-10 + 1e-14 * variances.max()
        )


BLOCK = 8


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(("blocks", "behind"), [(0, 5), (1, 0), (1, 7), (40, 3)])
def test_frames_follow_corrected_nodes_as_in_the_optimizer(blocks: int, behind: int, joined: bool) -> None:
    rng = np.random.default_rng(20000)
    odometry = rng.normal(0.0, 3.0, (blocks * BLOCK + 1 + behind, 3))
    nodes = rng.normal(0.0, 3.0, (blocks + 1, 3))
    shares, joins = np.tile(np.arange(1, BLOCK + 1) / BLOCK, (blocks, 1)), np.zeros(0, np.int64)
    if joined and blocks:  # the third frame of the last block: the motion that nobody saw is the one that is corrected
        shares[-1], joins = np.arange(1, BLOCK + 1) >= 3, np.array([(blocks - 1) * BLOCK + 3])

    steps, corrected = torch.from_numpy(odometry), torch.from_numpy(nodes)
    starts, whole = steps[: blocks * BLOCK + 1 : BLOCK].unsqueeze(1), blocks * BLOCK
    in_blocks = se2.between(starts[:-1], steps[1 : whole + 1].reshape(blocks, BLOCK, 3)).unsqueeze(0)
    relative = se2.between(corrected[:-1], corrected[1:]).unsqueeze(0)
    if joins.size:
        bent = in_blocks + torch.from_numpy(shares)[..., None] * se2.wrapped(relative - in_blocks[:, :, -1])[:, :, None]
    else:
        bent = in_block_poses(in_blocks, relative)
    expected = torch.cat(
        (
            corrected[:1],
            se2.compose(corrected[:-1].unsqueeze(1), bent[0]).reshape(-1, 3),
            se2.compose(corrected[-1:], se2.between(starts[-1], steps[whole + 1 :])),
        )
    )
    np.testing.assert_allclose(
        frames_between_nodes(nodes, odometry, BLOCK * np.arange(blocks + 1), joins), expected, atol=1e-13
    )
