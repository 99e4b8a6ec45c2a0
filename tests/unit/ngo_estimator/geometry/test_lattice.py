"""The algebra of compass readings: what agrees with a reading, and where the lattice lies."""

import math

import pytest
import torch
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.lattice import initial_lattice, quarter_turned, reading_of, snapped

BLOCK_M = 1.5


def random_poses(*shape: int, seed: int = 0) -> Tensor:
    """Poses in the lattice, with yaws of several turns."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.tensor([8.0, 8.0, 9.0], dtype=torch.float64)
    return spread * (2.0 * torch.rand(*shape, 3, generator=generator, dtype=torch.float64) - 1.0)


def symmetric(readings: Tensor, seed: int = 0) -> Tensor:
    """Other readings of the same poses: moved by whole blocks and then turned by quarters about the origin."""
    generator = torch.Generator().manual_seed(seed)
    cells, quarters = torch.randint(-5, 6, (*readings.shape[:-1], 3), generator=generator).double().split((2, 1), -1)
    xy = quarter_turned(quarters[..., 0], readings[..., :2] + BLOCK_M * cells)
    return torch.cat((xy, readings[..., 2:] + quarters * math.pi / 2), dim=-1)


def test_readings_lie_in_one_cell_and_an_eighth_of_a_turn() -> None:
    readings = reading_of(random_poses(500), BLOCK_M)
    limit = torch.tensor([BLOCK_M / 2, BLOCK_M / 2, math.pi / 4], dtype=torch.float64)
    largest = readings.abs().amax(0)
    assert (largest <= limit + 1e-12).all() and (largest > 0.9 * limit).all()


def test_equivalent_poses_have_one_reading() -> None:
    poses = random_poses(500)
    assert torch.allclose(reading_of(symmetric(poses), BLOCK_M), reading_of(poses, BLOCK_M), atol=1e-9)


def test_a_reading_finds_the_pose_from_anywhere_near_it() -> None:
    poses = random_poses(500)
    readings = symmetric(reading_of(poses, BLOCK_M))
    reach = torch.tensor([BLOCK_M / 2, BLOCK_M / 2, math.pi / 4], dtype=torch.float64)
    moved = poses + 0.999 * reach * (2.0 * torch.rand(500, 3, dtype=torch.float64) - 1.0)
    assert torch.allclose(snapped(readings, moved, BLOCK_M), poses, atol=1e-9)
    beyond = poses + torch.tensor([1.01, 0.0, 0.0], dtype=torch.float64) * reach
    expected = poses + torch.tensor([BLOCK_M, 0.0, 0.0], dtype=torch.float64)
    assert torch.allclose(snapped(readings, beyond, BLOCK_M), expected, atol=1e-9)


def test_there_is_no_seam_at_an_eighth_of_a_turn() -> None:
    below, above = (torch.tensor([2.3, -0.4, math.pi / 4 + d], dtype=torch.float64) for d in (-1e-6, 1e-6))
    readings = [reading_of(pose, BLOCK_M) for pose in (below, above)]
    assert (readings[0] - readings[1]).abs().max() > 0.5
    for reading in readings:
        assert torch.allclose(snapped(reading, below, BLOCK_M), below, atol=1e-5)


def test_the_gradient_is_that_of_the_turned_reading_and_never_of_the_guess() -> None:
    poses = random_poses(4).requires_grad_()
    readings = reading_of(poses.detach(), BLOCK_M).requires_grad_()
    snapped(readings, poses, BLOCK_M).sum().backward()
    assert poses.grad is None or not poses.grad.any()
    assert readings.grad is not None
    assert torch.equal(readings.grad.abs(), torch.ones_like(readings))


def drive(frames: int, trajectories: int) -> tuple[Tensor, Tensor]:
    """Poses of the lattice in the maps, and true poses of frames in the maps that start from the identity."""
    generator = torch.Generator().manual_seed(3)
    steps = torch.tensor([0.12, 0.0, 0.0]) + torch.tensor([0.02, 0.01, 0.15]) * torch.randn(
        trajectories, frames, 3, generator=generator
    )
    steps[:, 0] = 0.0
    return random_poses(trajectories, seed=4), se2.r2g(steps.double())


def same_lattice(a: Tensor, b: Tensor) -> Tensor:
    """Errors ``(trajectories, 3)`` of lattices up to their symmetries."""
    origin = torch.zeros_like(a)
    return snapped(reading_of(se2.between(a, origin), BLOCK_M), se2.between(b, origin), BLOCK_M) - se2.between(
        b, origin
    )


def test_the_lattice_is_found_from_the_first_frames() -> None:
    lattice, poses = drive(40, 6)
    readings = symmetric(reading_of(se2.between(lattice.unsqueeze(1), poses), BLOCK_M))
    found = initial_lattice(readings, torch.full((6, 40, 2), -3.0), poses, BLOCK_M)
    assert found.shape == (6, 3) and found[:, 2].abs().max() <= math.pi / 4
    assert same_lattice(found, lattice).abs().max() < 1e-9
    # What it is for: every frame's pose in the lattice agrees with its reading.
    inside = se2.between(found.unsqueeze(1), poses)
    assert torch.allclose(snapped(readings, inside, BLOCK_M), inside, atol=1e-9)
    single = initial_lattice(readings[2], torch.full((40, 2), -3.0), poses[2], BLOCK_M)
    assert torch.allclose(single, found[2])


def test_wrong_readings_hardly_move_the_lattice() -> None:
    lattice, poses = drive(40, 50)
    readings = reading_of(se2.between(lattice.unsqueeze(1), poses), BLOCK_M)
    generator = torch.Generator().manual_seed(5)
    readings += 0.02 * torch.randn(readings.shape, generator=generator)
    poses = poses + torch.tensor([1e-3, 1e-3, 1e-3]) * torch.randn(poses.shape, generator=generator).cumsum(1)
    wrong = torch.rand(50, 40, generator=generator) < 0.2
    readings[wrong] = reading_of(random_poses(50, 40, seed=6)[wrong], BLOCK_M)
    found = initial_lattice(readings, torch.full((50, 40, 2), math.log(0.015)), poses, BLOCK_M)
    errors = same_lattice(found, lattice)
    assert errors[:, 2].abs().max() < 0.02 and errors[:, :2].norm(dim=1).max() < 0.04


def test_frames_count_by_their_scales_and_their_age() -> None:
    lattice, poses = drive(40, 6)
    readings = reading_of(se2.between(lattice.unsqueeze(1), poses), BLOCK_M)
    readings[:, 20:, 2] += 0.3
    log_scale = torch.full((6, 40, 2), -4.0)
    late = same_lattice(initial_lattice(readings, log_scale, poses, BLOCK_M, drift=(0.005, 0.005)), lattice)
    assert late[:, 2].abs().max() < 0.01
    log_scale[:, :20] = 0.0
    doubted = same_lattice(initial_lattice(readings, log_scale, poses, BLOCK_M, drift=(0.0, 0.0)), lattice)
    assert torch.allclose(doubted[:, 2].abs(), torch.full((6,), 0.3, dtype=torch.float64), atol=0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_types_are_those_of_the_poses(dtype: torch.dtype) -> None:
    lattice, poses = drive(10, 2)
    readings = reading_of(se2.between(lattice.unsqueeze(1), poses), BLOCK_M).float()
    found = initial_lattice(readings, torch.zeros(2, 10, 2), poses.to(dtype), BLOCK_M)
    assert found.dtype == dtype
    assert same_lattice(found.double(), lattice).abs().max() < 1e-4
