"""SE(2) as tensors: group laws, 3x3 matrices as an independent reference, wrap at pi, and gradients."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ngo_estimator.geometry import se2

TOLERANCE = {torch.float64: 1e-12, torch.float32: 1e-5}
angles = st.floats(-100.0, 100.0)
poses = st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), angles).map(
    lambda p: torch.tensor(p, dtype=torch.float64)
)


def random_poses(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    values = 2.0 * torch.rand(*shape, 3, generator=generator, dtype=torch.float64) - 1.0
    return (values * torch.tensor([2.0, 2.0, 3.0])).to(dtype)


def matrices(pose: Tensor) -> np.ndarray:
    """Homogeneous matrices (..., 3, 3), by numpy alone."""
    x, y, yaw = np.moveaxis(pose.numpy(), -1, 0)
    result = np.zeros((*x.shape, 3, 3))
    result[..., 0, 0] = result[..., 1, 1] = np.cos(yaw)
    result[..., 1, 0] = np.sin(yaw)
    result[..., 0, 1] = -np.sin(yaw)
    result[..., 0, 2], result[..., 1, 2], result[..., 2, 2] = x, y, 1.0
    return result


def assert_same(a: Tensor, b: Tensor, tolerance: float = 1e-9) -> None:
    assert a.shape == b.shape and a.dtype == b.dtype
    assert torch.allclose(a[..., :2], b[..., :2], atol=tolerance, rtol=tolerance)
    assert torch.allclose(se2.wrap(a[..., 2] - b[..., 2]), torch.zeros_like(a[..., 2]), atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_wrap_keeps_pi_and_turns_minus_pi_into_it(dtype: torch.dtype) -> None:
    pi = torch.tensor(math.pi, dtype=dtype)
    assert se2.wrap(pi) == pi
    assert se2.wrap(-pi) == pi
    above = torch.nextafter(pi, torch.tensor(4.0, dtype=dtype))
    assert -pi <= se2.wrap(above) < -3.14159
    assert se2.wrap(torch.zeros((), dtype=dtype)) == 0.0
    assert se2.wrap(pi).dtype == dtype


def test_wrap_has_gradient_one_at_the_seam_too() -> None:
    angle = torch.tensor([-math.pi, 0.0, math.pi, 9.0], dtype=torch.float64, requires_grad=True)
    se2.wrap(angle).sum().backward()
    assert angle.grad is not None and torch.equal(angle.grad, torch.ones(4, dtype=torch.float64))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_compose_inverse_and_between_are_those_of_matrices(dtype: torch.dtype) -> None:
    a, b = random_poses(50, dtype=dtype, seed=1), random_poses(50, dtype=dtype, seed=2)
    tolerance = TOLERANCE[dtype]
    expected_compose = matrices(a) @ matrices(b)
    np.testing.assert_allclose(matrices(se2.compose(a, b)), expected_compose, atol=tolerance)
    np.testing.assert_allclose(matrices(se2.inverse(a)), np.linalg.inv(matrices(a)), atol=tolerance)
    np.testing.assert_allclose(matrices(se2.between(a, b)), np.linalg.inv(matrices(a)) @ matrices(b), atol=tolerance)
    for result in (se2.compose(a, b), se2.inverse(a), se2.between(a, b)):
        assert result.dtype == dtype
        assert result[..., 2].abs().max() <= math.pi + 1e-6


@settings(deadline=None)
@given(poses, poses, poses)
def test_group_laws(a: Tensor, b: Tensor, c: Tensor) -> None:
    identity = torch.zeros(3, dtype=torch.float64)
    assert_same(se2.compose(se2.compose(a, b), c), se2.compose(a, se2.compose(b, c)))
    assert_same(se2.compose(a, se2.inverse(a)), identity)
    assert_same(se2.compose(se2.inverse(a), a), identity)
    assert_same(se2.compose(a, identity), a)
    assert_same(se2.compose(a, se2.between(a, b)), b)
    assert_same(se2.between(a, b), se2.compose(se2.inverse(a), b))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_r2g_is_repeated_composition(dtype: torch.dtype) -> None:
    steps = random_poses(2, 30, dtype=dtype)
    result = se2.r2g(steps)
    pose = torch.zeros(2, 3, dtype=dtype)
    for k in range(30):
        pose = se2.compose(pose, steps[:, k])
        assert_same(result[:, k], pose, 10 * TOLERANCE[dtype])


@pytest.mark.parametrize(
    "function",
    [
        se2.compose,
        se2.between,
        lambda a, b: se2.inverse(a),
        lambda a, b: se2.rotate(a[..., 2], b[..., :2]),
        lambda a, b: se2.r2g(torch.stack((a, b), dim=-2)),
        lambda a, b: se2.g2r(torch.stack((a, b), dim=-2)),
    ],
    ids=["compose", "between", "inverse", "rotate", "r2g", "g2r"],
)
def test_gradients_are_those_of_finite_differences(function) -> None:  # noqa: ANN001
    a, b = (0.4 * random_poses(4, seed=seed) for seed in (3, 4))  # away from the seam, where differences jump
    assert torch.autograd.gradcheck(function, (a.requires_grad_(), b.requires_grad_()))


@pytest.mark.parametrize("name", ["compose", "between"])
@pytest.mark.parametrize(("of_a", "of_b"), [((3,), (3,)), ((20, 3), (20, 3)), ((3,), (20, 3)), ((5, 1, 3), (4, 3))])
def test_arrays_give_what_tensors_give(name: str, of_a: tuple[int, ...], of_b: tuple[int, ...]) -> None:
    a, b = (3.0 * torch.randn(*shape, dtype=torch.float64) for shape in (of_a, of_b))
    function = getattr(se2, name)
    result = function(a.numpy(), b.numpy())
    assert isinstance(result, np.ndarray)
    np.testing.assert_allclose(result, function(a, b).numpy(), atol=1e-13)


@pytest.mark.parametrize("name", ["wrapped", "inverse", "r2g", "g2r"])
def test_arrays_are_accumulated_and_undone_as_tensors(name: str) -> None:
    poses = random_poses(4, 20)
    function = getattr(se2, name)
    np.testing.assert_allclose(function(poses.numpy()), function(poses).numpy(), atol=1e-12)
