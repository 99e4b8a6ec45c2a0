"""Attention: entropy and mass on revisits of what is known, and what the optimizer really looks at."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs
from training.data.worlds import world_named
from training.report.attention import Attention, attention_of, revisits
from training.scoring.row_estimators import Arrays, local

WORLD = world_named("maze2d")


def attention(weights: np.ndarray, seen_again: np.ndarray) -> Attention:
    return Attention(weights, seen_again, None)  # type: ignore[arg-type]


def pairs(count: int, *which: tuple[int, int]) -> np.ndarray:
    result = np.zeros((count, count), dtype=bool)
    for a, b in which:
        result[a, b] = result[b, a] = True
    return result


def test_attention_on_one_pose_has_no_entropy() -> None:
    weights = np.zeros((1, 10, 10))
    weights[0, :, 7] = 1.0
    one = attention(weights, pairs(10, (0, 7), (1, 8)))
    np.testing.assert_allclose(one.relative_entropy, 0.0, atol=1e-12)
    np.testing.assert_allclose(one.revisit_mass, 1.0 / 4)  # of 0, 1, 7 and 8, the first looks at its revisit


def test_a_revisit_is_near_and_well_apart_in_time() -> None:
    x = np.array([0.0, 0.1, 1.0, 2.0, 3.0, 4.0, 5.0, 0.2, 1.1])
    poses = np.column_stack((x, np.zeros_like(x), np.zeros_like(x)))
    expected = pairs(9, (0, 7), (1, 7), (2, 8))
    np.testing.assert_array_equal(revisits(poses, WORLD), expected)


def test_a_world_in_which_heading_matters_has_fewer_revisits() -> None:
    poses = np.zeros((8, 3))
    poses[7, 2] = np.pi
    assert revisits(poses, WORLD)[0, 7] and revisits(poses, WORLD)[0, 6]
    narrow = dataclasses.replace(WORLD, heading_limit_rad=0.5)
    assert not revisits(poses, narrow)[0, 7] and revisits(poses, narrow)[0, 6]


def arrays() -> Arrays:
    names = ("relative", "log_std", "motion", "codes")
    found = {name: value.numpy() for name, value in zip(names, trajectory_inputs(2, 100), strict=True)}
    return {**found, "origin_code": np.zeros((2, 1, 12)), "truth": local(found)}


@pytest.mark.parametrize("form", ["loops", "paper"])
def test_it_is_the_attention_that_the_optimizer_computes(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    optimizer, pair_head = small_optimizer(form, trained=True), small_pair_head()
    computed: list[torch.Tensor] = []
    attend = type(optimizer).attend

    def keep(self: torch.nn.Module, *inputs: torch.Tensor) -> torch.Tensor:
        computed.append(attend(self, *inputs))  # type: ignore[arg-type]
        return computed[-1]

    monkeypatch.setattr(type(optimizer), "attend", keep)
    found = next(attention_of(optimizer, pair_head, arrays(), WORLD))
    iterations = optimizer.config.iterations
    assert found.weights.shape == (iterations, 12, 12)
    np.testing.assert_allclose(found.weights, torch.cat(computed[:iterations]).numpy(), atol=1e-6)
    np.testing.assert_allclose(found.weights.sum(axis=-1), 1.0, atol=1e-5)
    assert len(list(attention_of(optimizer, pair_head, arrays(), WORLD))) == 2
