"""What an optimizer is made of in each world, unless it is said otherwise."""

from dataclasses import replace

import pytest

from ngo_estimator.checkpoint import load_optimizer
from training.runs import WEIGHTS
from training.train_optimizer import Arguments, Choices, choices, config_of
from training.worlds import WORLDS, world_named


def test_a_world_says_what_suits_it() -> None:
    assert choices(Arguments(world="maze3d"), world_named("maze3d")) == Choices(False, 2, 96, 40)
    assert choices(Arguments(world="maze2d"), world_named("maze2d")) == Choices(True, 4, 512, 6)


def test_what_is_given_counts() -> None:
    given = Arguments(world="maze3d", robust=True, loops_per_pose=3, max_loops=7, epochs=1)
    assert choices(given, world_named("maze3d")) == Choices(True, 3, 7, 1)


@pytest.mark.parametrize("world", WORLDS)
def test_the_shipped_optimizers_are_made_as_their_world_says(world: str) -> None:
    shipped = load_optimizer(WEIGHTS / world, world)[0].config
    made = config_of(Arguments(world=world), world_named(world), shipped.correction_std)  # type: ignore[arg-type]
    assert replace(made, covariance_scale=shipped.covariance_scale) == shipped
