"""Work is counted as by hand."""

import numpy as np
import pytest
import torch

from benchmarks.roofline import Peak, Work, counted, measured_peak
from ngo_estimator.graph.block_cholesky import BlockCholesky, BlockStructure


def test_products_and_elementwise_operations_are_counted() -> None:
    a, b = torch.rand(20, 30), torch.rand(30, 40)
    with counted() as work:
        torch.relu(a @ b)
    assert work.products == 2 * 20 * 30 * 40
    assert work.elementwise == 20 * 40
    assert work.bytes == 4 * (20 * 30 + 30 * 40 + 20 * 40) + 4 * 2 * 20 * 40


def test_views_move_nothing() -> None:
    a = torch.rand(20, 30)
    with counted() as work:
        a.T[3:5].unsqueeze(0)
    assert work.bytes == 0


def test_eliminating_a_full_matrix_takes_the_known_number_of_operations() -> None:
    count = 4
    structure = BlockStructure(np.stack(np.triu_indices(count, 1), axis=1), count)
    diagonal, lower = np.tile(9.0 * np.eye(3), (count, 1, 1)), np.full((structure.blocks, 3, 3), 0.1)
    with counted() as work:
        BlockCholesky(structure, diagonal, lower).solve(np.ones((count, 3, 1)))
    elimination = sum(below + below * (below + 1) for below in range(3 * count))
    assert work.sparse == elimination + 4 * 9 * (count + structure.blocks)


def test_the_least_time_is_the_longer_one_of_computing_and_moving() -> None:
    work = Work(products=3e6, elementwise=1e6, sparse=1e6, bytes=2e6)
    assert work.bound_ms(Peak(gflops=1.0, gbytes=1.0)) == pytest.approx(5.0)
    assert work.bound_ms(Peak(gflops=10.0, gbytes=1.0)) == pytest.approx(2.0)


def test_a_machine_computes_and_copies() -> None:
    peak = measured_peak()
    assert peak.gflops > 1.0
    assert peak.gbytes > 0.5
