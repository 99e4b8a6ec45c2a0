"""The worlds as data: seed ranges that never meet, and environments that look like what the networks take."""

import itertools

import numpy as np
import pytest

from training.streams import PairStream, PlaceStream, simulate
from training.worlds import (
    DEMO_SEEDS,
    OPTIMIZER_TRAIN_SEEDS,
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    WORLDS,
    World,
    world_named,
)


def test_seed_ranges_do_not_overlap() -> None:
    ranges = [TEST_SEEDS, VALIDATION_SEEDS, DEMO_SEEDS, TRAIN_SEEDS, OPTIMIZER_TRAIN_SEEDS]
    assert all(len(seeds) > 0 and seeds.step == 1 and seeds[0] >= 0 for seeds in ranges)
    for a, b in itertools.combinations(ranges, 2):
        assert a[-1] < b[0] or b[-1] < a[0]
    assert range(1000) == TEST_SEEDS and range(1000, 2000) == VALIDATION_SEEDS and range(2000, 3000) == DEMO_SEEDS
    assert TRAIN_SEEDS[0] >= 10_000


def test_the_two_trainings_on_pairs_share_no_maze() -> None:
    world = WORLDS["maze2d"]
    local = PairStream(world, TRAIN_SEEDS, 99, 200_000, 256)
    place = PlaceStream(world, TRAIN_SEEDS[len(TRAIN_SEEDS) // 2 :], 0, 256, 24)
    assert max(map(max, local.groups)) < min(map(min, place.groups))


def test_world_named_knows_both_and_names_them() -> None:
    assert world_named("maze2d").name == "maze2d" and world_named("maze3d").name == "maze3d"
    with pytest.raises(ValueError, match=r"maze4d.*maze2d, maze3d"):
        world_named("maze4d")


def test_2d_environments_are_those_that_the_networks_take() -> None:
    world = WORLDS["maze2d"]
    (episode,) = simulate(world, [5], 3)
    assert episode.observations.reshape(3, *world.image.shape).dtype == np.dtype(world.image.dtype)
    assert episode.period_s == world.period_s
    assert episode.maze.block_m == world.block_m
    world.image.check(episode.observations[0].reshape(world.image.shape))


def test_training_mazes_vary_within_their_ranges() -> None:
    world = WORLDS["maze2d"]
    sizes = set()
    for seed in range(30):
        env = world.make_random(np.random.default_rng(seed))
        config = env.unwrapped.config  # type: ignore[attr-defined]
        assert world.rows[0] <= config.rows == config.cols <= world.rows[1]
        assert world.extra_openings[0] <= config.extra_openings <= world.extra_openings[1]
        sizes.add((config.rows, config.extra_openings))
        env.close()
    assert {rows for rows, _ in sizes} == set(range(world.rows[0], world.rows[1] + 1))


def test_make_without_a_size_is_the_simulators_own() -> None:
    from ngo_sim.maze2d import Maze2DConfig

    assert WORLDS["maze2d"].make().unwrapped.config == Maze2DConfig()  # type: ignore[attr-defined]
    assert WORLDS["maze2d"].make(4, 1).unwrapped.config == Maze2DConfig(rows=4, cols=4, extra_openings=1)  # type: ignore[attr-defined]


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
def test_each_table_has_mazes_of_its_own_in_its_split(world: World) -> None:
    stretches = [world.table_seeds(table, split) for split in ("validation", "test") for table in world.tables]
    assert all(len(seeds) >= 100 for seeds in stretches)
    for a, b in itertools.combinations(stretches, 2):
        assert not set(a) & set(b)
    for table in world.tables:
        assert set(world.table_seeds(table, "test")) <= set(TEST_SEEDS)
        assert set(world.table_seeds(table, "validation")) <= set(VALIDATION_SEEDS)
    # The first mazes of the validation split are those that the networks are measured on while they train.
    assert min(min(seeds) for seeds in stretches[: len(world.tables)]) >= VALIDATION_SEEDS[0] + 100
    with pytest.raises(ValueError, match=r"'nowhere'.*expected one of"):
        world.table_seeds("nowhere", "test")


def test_tables_say_what_their_mazes_are() -> None:
    world = WORLDS["maze2d"]
    for table, openings in (("perfect", 0), ("cycles", 8)):
        env = world.make_random(np.random.default_rng(0), world.tables[table])
        config = env.unwrapped.config  # type: ignore[attr-defined]
        assert (config.rows, config.cols, config.extra_openings) == (7, 7, openings)
        env.close()
