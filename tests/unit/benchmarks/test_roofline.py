"""Work is counted as by hand."""

import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix

from benchmarks.roofline import Peak, Work, counted, measured_peak
from ngo_estimator.optimizer import normal_equations


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
    size = 12
    matrix = csc_matrix(np.eye(size) * size + 1.0)
    with counted() as work:
        factor = normal_equations.splu(matrix)
        assert factor.solve(matrix @ np.arange(size)) == pytest.approx(np.arange(size))
    elimination = sum(below + 2 * below**2 for below in range(size))
    assert work.sparse == elimination + 2 * (size * size + size)


def test_the_least_time_is_the_longer_one_of_computing_and_moving() -> None:
    work = Work(products=3e6, elementwise=1e6, sparse=1e6, bytes=2e6)
    assert work.bound_ms(Peak(gflops=1.0, gbytes=1.0)) == pytest.approx(5.0)
    assert work.bound_ms(Peak(gflops=10.0, gbytes=1.0)) == pytest.approx(2.0)


def test_a_machine_computes_and_copies() -> None:
    peak = measured_peak()
    assert peak.gflops > 1.0
    assert peak.gbytes > 0.5
