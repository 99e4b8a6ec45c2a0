"""Levels of rooms: closed sectors, the same for the same seed, and drivable."""

import re
from collections import Counter

import numpy as np
import pytest

from ngo_sim.episodes import record_episode
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.rooms_level import rooms_textmap


def level(seed: int, start: int = 0) -> str:
    return rooms_textmap(np.random.default_rng(seed), np.random.default_rng(start))


def blocks(text: str, name: str) -> list[dict[str, str]]:
    found = re.findall(rf"^{name}\{{(.*)\}}$", text, re.MULTILINE)
    return [dict(part.split("=", 1) for part in block.rstrip(";").split(";")) for block in found]


def test_a_level_follows_from_its_seed_and_the_start_from_another() -> None:
    assert level(20_000) == level(20_000) != level(20_001)
    one, other = level(20_000, start=1), level(20_000, start=2)
    assert [blocks(one, name) for name in ("sector", "linedef")] == [
        blocks(other, name) for name in ("sector", "linedef")
    ]
    assert blocks(one, "thing")[-1] != blocks(other, "thing")[-1]


@pytest.mark.parametrize("seed", range(20_000, 20_020))
def test_the_lines_around_each_sector_are_closed(seed: int) -> None:
    text = level(seed)
    sides, sectors = blocks(text, "sidedef"), blocks(text, "sector")
    ends: dict[str, Counter[str]] = {}
    for line in blocks(text, "linedef"):
        assert ("sideback" in line) == ("twosided" in line)
        for side, first, last in (("sidefront", "v1", "v2"), ("sideback", "v2", "v1")):
            if side in line:
                balance = ends.setdefault(sides[int(line[side])]["sector"], Counter())
                balance[line[first]] += 1
                balance[line[last]] -= 1
    assert set(ends) == {str(number) for number in range(len(sectors))}
    assert not [sector for sector, balance in ends.items() if any(balance.values())]
    assert all(int(sector["heightceiling"]) >= int(sector["heightfloor"]) for sector in sectors)
    assert sum(thing["type"] == "1" for thing in blocks(text, "thing")) == 1


def test_levels_have_all_kinds_of_things() -> None:
    texts = [level(seed) for seed in range(20_000, 20_010)]
    everything = "".join(texts)
    assert "special=12;" in everything and 'textureceiling="F_SKY1"' in everything and "rotationfloor" in everything
    assert re.search(r"sector\{[^}]*special=(65|66|67|72|81);", everything)
    assert re.search(r'texturefloor="(FWATER1|NUKAGE1|BLOOD1|SLIME01|LAVA1)"', everything)
    assert len({sector["heightfloor"] for text in texts for sector in blocks(text, "sector")}) > 20


def test_an_explorer_gets_somewhere_and_the_frames_follow_from_the_seed() -> None:
    drives = []
    for _ in range(2):  # lights flicker by the clock of the engine
        env = Maze3D(Maze3DConfig(level="rooms"))
        assert env.default_driver == "explorer"
        drives.append(record_episode(env, "explorer", 300, 20_003))
        env.close()
    assert drives[0].maze is None and np.ptp(drives[0].poses_xyyaw[:, :2], axis=0).max() > 4.0
    np.testing.assert_array_equal(drives[0].poses_xyyaw, drives[1].poses_xyyaw)
    np.testing.assert_array_equal(drives[0].observations, drives[1].observations)
