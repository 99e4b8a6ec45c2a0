"""Drives of ``world:=doom``: which maps, which seeds, and in which parts."""

import hashlib

import numpy as np
import pytest

from ngo_sim.doom_engine import SHIPPED
from ngo_sim.doom_wad import find_wad, read_wad
from training.data import doom_drives
from training.data.doom_drives import TEST_MAPS, TRAIN_MAPS, VALIDATION_MAPS, doom_episodes
from training.data.worlds import TRAIN_SEEDS, VALIDATION_SEEDS


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
