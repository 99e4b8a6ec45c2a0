"""Registered scans lie on each other: known poses come out, and what cannot be registered stays as it was."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig, register
from tests.unit.ngo_estimator.rooms import CONFIG, RAYS, ranges_at

PRIOR = torch.tensor([0.05, math.radians(2.0)]).log()


def pose(x: float, y: float, yaw: float) -> Tensor:
    return torch.tensor([[x, y, yaw]], dtype=torch.float64)


def error_of(a: Tensor, b: Tensor, start: Tensor, steps: int = 5, config: RegistrationConfig = CONFIG) -> Tensor:
    found, _ = register(config, ranges_at(a), ranges_at(b), start, PRIOR, steps)
    difference = found - se2.between(a, b)
    return torch.cat((difference[:, :2].norm(dim=-1), se2.wrap(difference[:, 2]).abs()))


@settings(max_examples=60, deadline=None)
@given(
    st.floats(0.5, 2.5), st.floats(0.5, 2.0), st.floats(-3.1, 3.1),
    st.floats(-0.4, 0.4), st.floats(-0.4, 0.4), st.floats(-3.1, 3.1), st.integers(0, 2**31),
)  # fmt: skip
def test_any_two_places_near_each_other_are_found_in_any_heading(
    x: float, y: float, yaw: float, dx: float, dy: float, turn: float, seed: int
) -> None:
    a, b = pose(x, y, yaw), pose(max(0.4, x + dx), max(0.4, y + dy), yaw + turn)
    wrong = torch.randn(1, 3, generator=torch.Generator().manual_seed(seed)) * PRIOR.exp()[[0, 0, 1]]
    position, heading = error_of(a, b, se2.between(a, b) + wrong.clamp(-0.1, 0.1))
    assert position < 2e-3 and heading < 1e-3


@pytest.mark.parametrize("share", [0.0, 0.002])
def test_deviations_are_those_of_the_errors_that_noise_makes(share: float) -> None:
    generator = torch.Generator().manual_seed(0)
    count, noise = 200, 0.002
    a, b = pose(1.5, 1.2, 0.3).expand(count, 3), pose(1.7, 1.0, 0.7).expand(count, 3)
    config = RegistrationConfig(RAYS, 300.0, noise, noise_share=share)
    exact = [ranges_at(x[:1]) for x in (a, b)]
    scans = [
        ranges + (noise + share * ranges) * torch.randn(count, RAYS, generator=generator) / (2.0 if share else 1.0)
        for ranges in exact
    ]
    found, log_std = register(config, *scans, se2.between(a, b), PRIOR, 5)
    errors = found - se2.between(a, b)
    squares = torch.stack((errors[:, :2].square().sum(-1) / 2.0, errors[:, 2].square()), dim=-1).mean(0)
    assert (PRIOR - log_std > 3.0).all()
    ratio = squares.sqrt() / log_std.exp().mean(0)
    assert (ratio > 0.5).all() and (ratio < 3.0).all(), ratio


def test_a_batch_is_its_single_pairs() -> None:
    poses = torch.tensor([[1.0, 1.0, 0.0], [1.3, 1.1, 0.4], [2.0, 0.8, -1.0], [0.8, 2.8, 2.0]], dtype=torch.float64)
    a, b = ranges_at(poses[:-1]), ranges_at(poses[1:])
    start = se2.between(poses[:-1], poses[1:]) + 0.02
    together = register(CONFIG, a, b, start, PRIOR.expand(3, 2), 4)
    for k in range(3):
        single = register(CONFIG, a[k], b[k], start[k], PRIOR, 4)
        for one, many in zip(single, together, strict=True):
            torch.testing.assert_close(one, many[k], atol=1e-5, rtol=1e-5)


def test_rays_without_a_return_say_nothing() -> None:
    a, b = pose(1.5, 1.2, 0.3), pose(1.7, 1.0, 1.1)
    lost = torch.rand(2, 1, RAYS, generator=torch.Generator().manual_seed(0)) < 0.2
    scans = [torch.where(gone, 0.0, ranges_at(x)) for gone, x in zip(lost, (a, b), strict=True)]
    found, _ = register(CONFIG, *scans, se2.between(a, b) + 0.03, PRIOR, 5)
    assert (found - se2.between(a, b)).abs().max() < 2e-3


@pytest.mark.parametrize("wrong", [(1.5, 0.0, 0.0), (0.0, 0.0, 1.5)])
def test_where_scans_and_start_contradict_each_other_the_start_stands(wrong: tuple[float, float, float]) -> None:
    a, b = pose(1.5, 1.2, 0.3), pose(1.7, 1.0, 1.1)
    start = se2.between(a, b) + torch.tensor([wrong])
    found, log_std = register(CONFIG, ranges_at(a), ranges_at(b), start, PRIOR, 5)
    moved = (found - start)[:, [0, 2]].abs() / PRIOR.exp()
    assert (
        torch.equal(found, start) and torch.equal(log_std[0], PRIOR.double()) if moved.max() == 0 else moved.max() < 5
    )


def test_pairs_about_which_nothing_is_known_stay_and_harm_no_other() -> None:
    """Without points and without a prior no direction is fixed: the equations of that pair are singular."""
    a, b = pose(1.5, 1.2, 0.3), pose(1.7, 1.0, 0.7)
    seen = torch.cat((ranges_at(a), torch.zeros(1, RAYS))), torch.cat((ranges_at(b), torch.zeros(1, RAYS)))
    start = se2.between(a, b).repeat(2, 1) + 0.02
    log_std = torch.stack((PRIOR, torch.full((2,), 100.0)))
    found, after = register(CONFIG, *seen, start, log_std, 5)
    alone, _ = register(CONFIG, ranges_at(a), ranges_at(b), start[:1], PRIOR, 5)
    assert torch.equal(found[0], alone[0]) and torch.equal(found[1], start[1].float().double())
    assert torch.equal(after[1], log_std[1])
