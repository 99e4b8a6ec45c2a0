"""Compass readings in a trajectory: which are used, what they say of the poses, and when a cell is believed."""

import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.lattice import reading_of
from ngo_estimator.optimizer.compass_closure import (
    CompassFixes,
    CompassGate,
    compass_factors,
    compass_fixes,
    frames_to_read,
)
from ngo_estimator.optimizer.gauss_newton import chain_factors, gauss_newton_step
from tests.unit.ngo_estimator.samples import with_origin

STEPS, BLOCK = 160, 8
DOUBLE = torch.float64
LATTICE = torch.tensor([0.2, -0.3, 0.5], dtype=DOUBLE)  # in the map


def drive(seed: int = 0) -> torch.Tensor:
    """Relative steps ``(1, STEPS, 3)`` of a robot that wanders."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(1, STEPS, 3, generator=generator, dtype=DOUBLE)
    return noise * torch.tensor([0.02, 0.0, 0.08]) + torch.tensor([0.1, 0.0, 0.02])


def fixes_for(relative: torch.Tensor, odometry: torch.Tensor) -> CompassFixes:
    """Exact readings along ``relative``, used with ``odometry``."""
    poses = with_origin(se2.r2g(relative))[:, frames_to_read(STEPS, BLOCK)]
    readings = reading_of(se2.between(LATTICE.expand_as(poses), poses), 1.0)
    log_scale = torch.full((*readings.shape[:2], 2), -6.0, dtype=DOUBLE)
    return compass_fixes(readings, log_scale, odometry, torch.full_like(odometry, -6.0), BLOCK, 1.0)


@pytest.mark.parametrize(("steps", "expected"), [(8, list(range(9))), (48, [*range(33), 40, 48])])
def test_the_first_frames_and_the_ends_of_meta_poses_are_read(steps: int, expected: list[int]) -> None:
    assert frames_to_read(steps, 8).tolist() == expected


def test_fixes_are_of_the_origin_and_of_every_meta_pose_and_find_the_lattice() -> None:
    relative = drive()
    fixes = fixes_for(relative, relative)
    assert fixes.node[0].tolist() == [0] * BLOCK + list(range(1, STEPS // BLOCK + 1))
    # Taken back to the origin, all of the first readings say the same, the later ones with less certainty.
    at_origin = fixes.readings[0, :BLOCK]
    assert (at_origin - at_origin[0]).abs().max() < 1e-6
    assert (fixes.log_scale[0, :BLOCK].diff(dim=0) > 0.0).all()
    quarter = torch.remainder(fixes.lattice[0, 2] - LATTICE[2] + torch.pi / 4, torch.pi / 2) - torch.pi / 4
    assert quarter.abs() < 1e-4


def test_exact_readings_bring_a_drifted_trajectory_back() -> None:
    relative = drive()
    odometry = relative + torch.tensor([0.001, 0.0, 0.002], dtype=DOUBLE)
    truth = with_origin(se2.r2g(relative))[:, ::BLOCK]
    start = with_origin(se2.r2g(odometry))[:, ::BLOCK]
    fixes, gate = fixes_for(relative, odometry), CompassGate().double()
    measured = se2.g2r(start[:, 1:])
    poses, lattice = start, fixes.lattice.clone()
    step_std = torch.full_like(measured, 0.02)
    for drift in (4.0, 0.01, 0.001, 0.0, 0.0):
        allowed = torch.full((*fixes.node.shape, 3), drift, dtype=DOUBLE)
        change = se2.g2r(poses[:, 1:]) - measured
        deviation = torch.cat((change[..., :2], se2.wrap(change[..., 2:])), dim=-1)
        factors = [
            chain_factors(poses, deviation, step_std),
            compass_factors(fixes, gate, lattice, poses, allowed),
        ]
        step = gauss_newton_step(factors, poses.shape[1] + 1)
        poses, lattice = poses + step[:, :-1], lattice + step[:, -1]
    before, after = ((p - truth)[..., :2].norm(dim=-1).max() for p in (start, poses))
    assert before > 0.5
    assert after < 0.05 * before


def test_a_position_is_not_believed_while_the_drift_could_hide_the_cell() -> None:
    relative = drive()
    fixes, gate = fixes_for(relative, relative), CompassGate().double()
    residual = torch.zeros(1, fixes.node.shape[1], 3, dtype=DOUBLE)
    sure, unsure = (gate(fixes, residual, torch.full_like(residual, std**2)) for std in (0.1, 0.2))
    assert (sure > 0.0).all()
    assert not unsure[..., :2].any() and (unsure[..., 2] > 0.0).all()


def test_a_reading_that_misses_by_far_loses_its_information() -> None:
    relative = drive()
    fixes, gate = fixes_for(relative, relative), CompassGate().double()
    residual = torch.zeros(1, fixes.node.shape[1], 3, dtype=DOUBLE)
    none = torch.zeros_like(residual)
    believed = gate(fixes, residual, none)
    residual[:, 10, 0] = 0.4
    assert (gate(fixes, residual, none)[:, 10] < 1e-3 * believed[:, 10]).all()
    assert torch.equal(gate(fixes, residual, none)[:, 11], believed[:, 11])
