"""Worlds of the training, and drives of the one of Doom: which mazes and maps, which seeds, and in which parts."""

import dataclasses
import hashlib
import itertools

import numpy as np
import pytest

from ngo_sim.doom_engine import SHIPPED
from ngo_sim.doom_wad import find_wad, read_wad
from training.data import doom_drives
from training.data.doom_drives import TEST_MAPS, TRAIN_MAPS, VALIDATION_MAPS, doom_episodes
from training.data.drive_plan import drives_of_table
from training.data.episodes import GROUP, simulate
from training.data.streams import PairStream, PlaceStream
from training.data.worlds import (
    DEMO_SEEDS,
    OPTIMIZER_TRAIN_SEEDS,
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    WORLDS,
    Table,
    World,
)
from training.train_local import Arguments


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


SPLITS = {"validation": VALIDATION_SEEDS, "test": TEST_SEEDS}


@pytest.mark.parametrize("world", WORLDS.values(), ids=WORLDS)
def test_each_table_has_episodes_and_mazes_of_its_own_in_its_split(world: World) -> None:
    own = [table for table in world.tables if world.tables[table].driver is None]
    for of in (world.table_seeds, world.table_mazes):
        stretches = [of(table, split) for split in SPLITS for table in own]
        assert all(len(seeds) >= 100 for seeds in stretches)
        for a, b in itertools.combinations(stretches, 2):
            assert not set(a) & set(b)
    for (split, seeds), table in itertools.product(SPLITS.items(), world.tables):
        assert set(world.table_seeds(table, split)) <= set(seeds)
        # The first mazes of a split are those that the networks are measured on while they train.
        assert min(world.table_seeds(table, split)) >= seeds[0] + 100
    with pytest.raises(ValueError, match=r"'nowhere'.*expected one of"):
        world.table_seeds("nowhere", "test")


@pytest.mark.parametrize("split", SPLITS)
def test_seen_mazes_are_those_of_the_local_network_and_unseen_ones_of_no_training(split: str) -> None:
    world, local = WORLDS["maze3d"], Arguments(world="maze3d")
    trained = PairStream(world, TRAIN_SEEDS, 0, local.datapoints, local.batch_size)
    in_training = {seed for group in trained.groups for seed in group}
    seen, unseen = world.table_mazes("seen", split), world.table_mazes("unseen", split)
    assert set(seen) <= in_training
    # Groups of mazes are of one size, which the first of them decides: here as there.
    assert list(seen[:GROUP]) in trained.groups
    assert not set(unseen) & {*TRAIN_SEEDS[:100_000]} and max(unseen) < TRAIN_SEEDS[0]
    assert not set(world.table_seeds("seen", split)) & set(world.table_seeds("unseen", split))


def test_an_episode_in_a_seen_maze_has_the_walls_of_training_and_another_start_and_drive() -> None:
    world = WORLDS["maze3d"]
    driven = drives_of_table(world, "seen", "validation", 2)
    seen = list(driven.episodes(dataclasses.replace(world, episode_frames=30), slice(0, 2)))
    trained = list(simulate(world, driven.mazes, 31))
    for now, then in zip(seen, trained, strict=True):
        np.testing.assert_array_equal(now.maze.walls, then.maze.walls)
        assert not np.array_equal(now.poses_xyyaw[0], then.poses_xyyaw[0])
        assert not np.array_equal(now.actions, then.actions)


def test_a_table_of_another_driver_has_the_same_mazes_and_starts() -> None:
    tables = {"unseen": Table(), "unseen_by_chance": Table(driver="random")}
    world = dataclasses.replace(WORLDS["maze2d"], tables=tables, episode_frames=30)
    assert world.unseen_tables == ("unseen",) and world.validation_stores == ("validation_unseen",)
    ours, by_chance = (
        next(drives_of_table(world, table, "validation", 1).episodes(world, slice(0, 1))) for table in tables
    )
    np.testing.assert_array_equal(ours.maze.walls, by_chance.maze.walls)
    np.testing.assert_array_equal(ours.poses_xyyaw[0], by_chance.poses_xyyaw[0])
    assert not np.array_equal(ours.actions, by_chance.actions)


def test_no_map_for_a_test_is_one_to_learn_or_to_choose_from() -> None:
    wads = {wad: read_wad(find_wad(wad, SHIPPED)) for wad, _ in {*TRAIN_MAPS, *VALIDATION_MAPS, *TEST_MAPS}}

    def shapes(maps: tuple[tuple[str, str], ...]) -> set[str]:
        lumps = [dict(wads[wad].map_lumps(name)) for wad, name in maps]
        return {hashlib.sha256(one.get("VERTEXES", one.get("TEXTMAP", b""))).hexdigest() for one in lumps}

    train, validation, test = map(shapes, (TRAIN_MAPS, VALIDATION_MAPS, TEST_MAPS))
    assert not train & test and not validation & test and not train & validation
    assert len(TRAIN_MAPS) == 52 and len(VALIDATION_MAPS) == 4 and len(TEST_MAPS) == 26


def test_training_seeds_share_a_drive_on_a_map_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doom_drives, "_PLACE_SHARES", (1.0, 0.0, 0.0))
    first, second = doom_episodes(TRAIN_SEEDS[:2], 20)
    assert first.observations.shape == (20, 60, 80, 3) and len(first.actions) == 19
    np.testing.assert_array_equal(first.observations[-1], second.observations[0])
    np.testing.assert_array_equal(first.poses_xyyaw[-1], second.poses_xyyaw[0])


def test_other_seeds_have_a_drive_each_on_maps_in_rooms_and_in_mazes() -> None:
    drives = list(doom_episodes(VALIDATION_SEEDS[3:8], 3))
    assert [drive.maze is not None for drive in drives] == [False] * 3 + [True] * 2
    (again,) = doom_episodes(VALIDATION_SEEDS[5:6], 3)
    np.testing.assert_array_equal(again.poses_xyyaw, drives[2].poses_xyyaw)
