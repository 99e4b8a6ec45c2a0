"""Levels of Doom as worlds: maps of games, and rooms that are drawn."""

import math
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from vizdoom import GameVariable

from ngo_sim.doom_level import load_level
from ngo_sim.doom_map import map_lumps
from ngo_sim.doom_wad import write_lumps
from ngo_sim.drivers import Action
from ngo_sim.episodes import Episode, record_episode
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.rooms_level import rooms_textmap
from tests.unit.ngo_sim.test_doom_map import blocks_of
from tests.unit.ngo_sim.test_doom_wad import ROOM_TEXT

HOME = Maze3DConfig(wad="my_way_home.wad", map="map01")


@pytest.fixture(scope="module")
def home() -> Iterator[Maze3D]:
    env = Maze3D(HOME)
    yield env
    env.close()


def distance_m(episode: Episode) -> float:
    return float(np.linalg.norm(np.diff(episode.poses_xyyaw[:, :2], axis=0), axis=1).sum())


def squares(episode: Episode) -> int:
    """Squares of 2 m that it was in."""
    return len({(x // 2, y // 2) for x, y, _ in episode.poses_xyyaw})


def test_it_is_seen_and_driven_through_as_a_maze_is(home: Maze3D) -> None:
    observation, info = home.reset(seed=0)
    assert (observation.shape, observation.dtype) == ((60, 80, 3), np.uint8)
    assert home.maze is None and home.default_driver == "explorer" and home.period_s == 2 / 35
    speeds = []
    for step in range(12):
        last = info["pose_xyyaw"]
        observation, reward, terminated, truncated, info = home.step(Action.FORWARD)
        moved = info["pose_xyyaw"] - last
        assert reward == pytest.approx(math.hypot(moved[0], moved[1])) and not terminated and not truncated
        assert info["time_s"] == pytest.approx((step + 1) * 2 / 35)
        speeds.append(reward / home.period_s)
    # As in a maze: 25 of Doom's units of thrust lead to 9.1 m/s at last, of which 12 steps reach most.
    assert 6.0 < max(speeds) < 9.5


def test_an_episode_is_a_function_of_its_seed(home: Maze3D) -> None:
    first, other, again = (record_episode(home, "explorer", 150, seed) for seed in (1, 2, 1))
    anew = Maze3D(HOME)
    anew.preload([1, 2])
    alone = record_episode(anew, "explorer", 150, 1)
    anew.close()
    for name in ("observations", "actions", "poses_xyyaw"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes() == getattr(alone, name).tobytes()
        assert getattr(first, name).tobytes() != getattr(other, name).tobytes()
    assert first.maze is None


@pytest.mark.parametrize(
    ("wad", "name", "least_m", "least_squares"),
    [
        ("my_way_home.wad", "map01", 60, 20),
        ("health_gathering.wad", "MAP01", 80, 30),
        ("freedoom2.wad", "MAP02", 90, 30),
        ("freedoom1.wad", "e1m1", 90, 25),
    ],
)
def test_the_explorer_covers_ground_and_never_jumps(wad: str, name: str, least_m: float, least_squares: int) -> None:
    env = Maze3D(Maze3DConfig(wad=wad, map=name))
    episodes = [record_episode(env, "explorer", 1000, seed) for seed in (3, 4)]
    health = env._engine._game.get_game_variable(GameVariable.HEALTH)
    env.close()
    steps = [np.linalg.norm(np.diff(episode.poses_xyyaw[:, :2], axis=0), axis=1).max() for episode in episodes]
    assert max(steps) < 1.2, "a jump: a teleporter or a new start"
    assert health >= 90
    assert np.mean([distance_m(episode) for episode in episodes]) > least_m
    assert np.mean([squares(episode) for episode in episodes]) > least_squares


def test_no_script_acts_on_the_player() -> None:
    """In this scenario the floor takes health away, and the end of it ends the episode."""
    env = Maze3D(Maze3DConfig(wad="health_gathering.wad", map="map01"))
    health = []
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(600):
            env.step(Action.TURN_LEFT)
        health.append(env._engine._game.get_game_variable(GameVariable.HEALTH))
    env.close()
    assert min(health) >= 90, "the floor may hurt once, in the very tic in which an episode begins"


def door_map() -> str:
    """UDMF text of two rooms of 4 m, with a door of 2 m between them that is closed and opens by use."""
    points = [(0, 0), (0, 128), (128, 128), (128, 96), (128, 32), (128, 0), (144, 0), (144, 32), (144, 96), (144, 128),
              (272, 128), (272, 0)]  # fmt: skip
    sectors = [(128, 0), (0, 1), (128, 2)]
    # Ends of lines, sector on the right, sector on the left or None.
    lines = [(0, 1, 0, None), (1, 2, 0, None), (2, 3, 0, None), (3, 4, 0, 1), (4, 5, 0, None), (5, 0, 0, None),
             (3, 8, 1, None), (7, 4, 1, None), (7, 8, 2, 1), (6, 7, 2, None), (8, 9, 2, None), (9, 10, 2, None),
             (10, 11, 2, None), (11, 6, 2, None)]  # fmt: skip
    text = 'namespace="zdoom";thing{type=1;x=48;y=64;angle=0;skill3=true;single=true;}'
    text += "".join(f"vertex{{x={x};y={y};}}" for x, y in points)
    text += "".join(f'sector{{heightfloor=0;heightceiling={height};texturefloor="FLAT5";texturceiling="FLAT5";'
                    f"lightlevel=200;id={number};}}" for height, number in sectors)  # fmt: skip
    sides = []
    for first, second, right, left in lines:
        front, back = len(sides), len(sides) + 1
        sides.append(right)
        door = "twosided=true;special=12;arg0=0;arg1=16;arg2=150;playeruse=true;repeatspecial=true;"
        if left is None:
            text += f"linedef{{v1={first};v2={second};sidefront={front};blocking=true;}}"
        else:
            sides.append(left)
            text += f"linedef{{v1={first};v2={second};sidefront={front};sideback={back};{door}}}"
    return text + "".join(f'sidedef{{sector={one};texturemiddle="BROWN1";texturetop="BROWN1";}}' for one in sides)


def test_a_door_opens_to_who_walks_against_it(tmp_path: Path) -> None:
    write_lumps(tmp_path / "door.wad", [("MAP01", b""), ("TEXTMAP", door_map().encode()), ("ENDMAP", b"")])
    env = Maze3D(Maze3DConfig(wad=str(tmp_path / "door.wad"), map="MAP01", actuation_noise=0.0))
    _, info = env.reset(seed=0)
    assert info["pose_xyyaw"][:2].tolist() == [1.5, 2.0]
    reached = [env.step(Action.FORWARD)[4]["pose_xyyaw"][0] for _ in range(80)]
    env.close()
    assert reached[10] == pytest.approx(3.5, abs=0.01), "the closed door, from which the body's middle is half a metre"
    assert reached[-1] == pytest.approx(8.0, abs=0.01), "the far wall behind it"


def test_wrong_maps_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="wad is '' and map is 'MAP01'; they must be given both, or neither"):
        Maze3DConfig(map="MAP01")
    with pytest.raises(ValueError, match=r"wad is 'my_way_home\.wad' and map is ''; they must be given both"):
        Maze3DConfig(wad="my_way_home.wad")
    with pytest.raises(ValueError, match=r"^map is 'map07'; my_way_home\.wad has MAP01$"):
        Maze3D(Maze3DConfig(wad="my_way_home.wad", map="map07"))
    with pytest.raises(ValueError, match=r"^wad is 'my_way\.wad'; it must be a WAD file, or the name of one of basic"):
        Maze3D(Maze3DConfig(wad="my_way.wad", map="map01"))


def test_a_file_takes_what_it_lacks_from_the_part_of_freedoom_that_its_map_is_of(tmp_path: Path) -> None:
    write_lumps(tmp_path / "both.wad", map_lumps([("E1M1", ROOM_TEXT), ("MAP01", ROOM_TEXT)]))
    assert load_level(str(tmp_path / "both.wad"), "e1m1").game_wad.name == "freedoom1.wad"
    level = load_level(str(tmp_path / "both.wad"), "map01")
    assert (level.game_wad.name, level.name) == ("freedoom2.wad", "MAP01")
    assert load_level("freedoom1.wad", "E1M1").game_wad.name == "freedoom1.wad"


def level(seed: int, start: int = 0) -> str:
    return rooms_textmap(np.random.default_rng(seed), np.random.default_rng(start))


def test_a_level_follows_from_its_seed_and_the_start_from_another() -> None:
    assert level(20_000) == level(20_000) != level(20_001)
    one, other = level(20_000, start=1), level(20_000, start=2)
    assert [blocks_of(one, name) for name in ("sector", "linedef")] == [
        blocks_of(other, name) for name in ("sector", "linedef")
    ]
    assert blocks_of(one, "thing")[-1] != blocks_of(other, "thing")[-1]


@pytest.mark.parametrize("seed", range(20_000, 20_020))
def test_the_lines_around_each_sector_are_closed(seed: int) -> None:
    text = level(seed)
    sides, sectors = blocks_of(text, "sidedef"), blocks_of(text, "sector")
    ends: dict[str, Counter[str]] = {}
    for line in blocks_of(text, "linedef"):
        assert ("sideback" in line) == ("twosided" in line)
        for side, first, last in (("sidefront", "v1", "v2"), ("sideback", "v2", "v1")):
            if side in line:
                balance = ends.setdefault(sides[int(line[side])]["sector"], Counter())
                balance[line[first]] += 1
                balance[line[last]] -= 1
    assert set(ends) == {str(number) for number in range(len(sectors))}
    assert not [sector for sector, balance in ends.items() if any(balance.values())]
    assert all(int(sector["heightceiling"]) >= int(sector["heightfloor"]) for sector in sectors)
    assert sum(thing["type"] == "1" for thing in blocks_of(text, "thing")) == 1


def test_levels_have_all_kinds_of_things() -> None:
    texts = [level(seed) for seed in range(20_000, 20_010)]
    everything = "".join(texts)
    assert "special=12;" in everything and 'textureceiling="F_SKY1"' in everything and "rotationfloor" in everything
    assert re.search(r"sector\{[^}]*special=(65|66|67|72|81);", everything)
    assert re.search(r'texturefloor="(FWATER1|NUKAGE1|BLOOD1|SLIME01|LAVA1)"', everything)
    assert len({sector["heightfloor"] for text in texts for sector in blocks_of(text, "sector")}) > 20


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
