"""Motions of arrays are those of ``se2``."""

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import planar_arrays, se2

SHAPES = [((3,), (3,)), ((20, 3), (20, 3)), ((3,), (20, 3)), ((5, 1, 3), (4, 3))]


@pytest.mark.parametrize("name", ["compose", "between"])
@pytest.mark.parametrize(("of_a", "of_b"), SHAPES)
def test_two_poses_are_joined_as_by_se2(name: str, of_a: tuple[int, ...], of_b: tuple[int, ...]) -> None:
    rng = np.random.default_rng(20000)
    a, b = rng.normal(0.0, 3.0, of_a), rng.normal(0.0, 3.0, of_b)
    expected = getattr(se2, name)(torch.from_numpy(a), torch.from_numpy(b)).numpy()
    np.testing.assert_allclose(getattr(planar_arrays, name)(a, b), expected, atol=1e-14)


def test_an_inverse_undoes_its_pose() -> None:
    poses = np.random.default_rng(20001).normal(0.0, 3.0, (20, 3))
    np.testing.assert_allclose(planar_arrays.compose(planar_arrays.inverse(poses), poses), 0.0, atol=1e-14)


def test_half_a_turn_is_positive() -> None:
    angles = np.array([-np.pi, np.pi, 0.0, 3.0 * np.pi])
    np.testing.assert_allclose(planar_arrays.wrap(angles), [np.pi, np.pi, 0.0, np.pi], atol=1e-15)
