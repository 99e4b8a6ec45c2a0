import hashlib
import itertools
import math
import os
import re
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ngo_sim.doom_map import (
    TEXTURE_SETS,
    UNITS_PER_M,
    WALL_HEIGHT_UNITS,
    MapStyle,
    textmap,
    wall_faces,
)
from ngo_sim.drivers import Action, PathDriver
from ngo_sim.maze3d import DoomWorld, Maze3D, Maze3DConfig, mean_2x2
from ngo_sim.mazes import Maze

FORWARD, LEFT, RIGHT = Action.FORWARD, Action.TURN_LEFT, Action.TURN_RIGHT
EXACT = Maze3DConfig(actuation_noise=0.0)
# A room of 7 x 7 blocks without anything in it, free for x and y in [3, 24].
ROOM = Maze(np.pad(np.zeros((7, 7), dtype=bool), 1, constant_values=True), block_m=3.0)
FACES = wall_faces(ROOM.walls)
NORTH = [index for index, (_, y0, _, y1) in enumerate(FACES) if y0 == y1 == 8]
EYE_HEIGHT_M = 41 / UNITS_PER_M
PLAYER_RADIUS_M = 0.5


class Room(Maze3D):
    """The empty room, looking as `styles` says for a seed, by default with one wall texture but for face `seed`."""

    start: tuple[float, float, int] = (12.0, 13.5, 90)
    styles: tuple[MapStyle, ...] = ()

    def _build_world(self, seed: int, maze_seed: int) -> DoomWorld:
        textures = ["MARBGRAY"] * len(FACES)
        if seed < len(FACES):
            textures[seed] = "PANBLUE"
        style = self.styles[seed] if self.styles else MapStyle(tuple(textures), "FLAT8", "FLAT5")
        x, y, heading_deg = self.start
        return DoomWorld(ROOM, textmap(ROOM, style, (x, y), heading_deg))


NOTHING_MARKED = 10_000


def drive(env: Maze3D, seed: int, actions: list[Action]) -> tuple[np.ndarray, np.ndarray]:
    """Rendered pictures (frames, height, width, 3) and poses (frames, 3) of an episode."""
    _, info = env.reset(seed=seed)
    pictures, poses = [env.render()], [info["pose_xyyaw"]]
    for action in actions:
        *_, info = env.step(action)
        pictures.append(env.render())
        poses.append(info["pose_xyyaw"])
    return np.array(pictures), np.array(poses)


def digest(env: Maze3D, seed: int, frames: int = 60) -> str:
    """Of all bytes that an episode with a fixed sequence of actions gives."""
    observation, info = env.reset(seed=seed)
    total = hashlib.sha256(observation.tobytes() + info["pose_xyyaw"].tobytes())
    for action in itertools.islice(itertools.cycle((FORWARD, FORWARD, LEFT, FORWARD, RIGHT, LEFT)), frames):
        observation, reward, _, _, info = env.step(action)
        total.update(observation.tobytes() + info["pose_xyyaw"].tobytes() + repr(reward).encode())
    return total.hexdigest()


def engines(folder: Path) -> list[int]:
    """The engine processes whose files are below a folder."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            arguments = (process / "cmdline").read_bytes()
            alive = "\nState:\tZ" not in (process / "status").read_text()
        except OSError:
            continue
        if alive and b"vizdoom" in arguments and str(folder).encode() in arguments:
            found.append(int(process.name))
    return found


def wait_until_gone(folder: Path) -> None:
    """Until no engine and no file is left below a folder."""
    deadline = time.monotonic() + 60
    while left := [*map(str, engines(folder)), *map(str, folder.iterdir())]:
        assert time.monotonic() < deadline, f"left: {left}"
        time.sleep(0.02)


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An own folder for temporary files, also of child processes."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", None)
    return folder


@pytest.fixture(scope="module")
def shared() -> Iterator[Maze3D]:
    """One world for the tests to which only its episodes matter."""
    env = Maze3D(render_mode="rgb_array")
    env.preload(range(10))
    yield env
    env.close()


class Sight:
    """Where the marked face is seen, column and row edges of the rendered picture against their ray's slope."""

    def __init__(self, config: Maze3DConfig, actions: list[Action], start: tuple[float, float, int]) -> None:
        env = Room(config, render_mode="rgb_array")
        env.start = start
        env.preload([NOTHING_MARKED, *NORTH])
        plain, self.poses = drive(env, NOTHING_MARKED, actions)
        self.columns: list[tuple[int, float, int, int]] = []  # frame, slope to the right, column edge, rounding
        self.rows: list[tuple[float, int]] = []  # slope down, row edge
        height, width = plain.shape[1:3]
        for face in NORTH:
            marked, poses = drive(env, face, actions)
            np.testing.assert_array_equal(poses, self.poses)
            for frame, different in enumerate((marked != plain).any(axis=-1)):
                columns = np.flatnonzero(different.any(axis=0))
                ends = self.ends(face, frame)
                if not len(columns) or ends[:, 0].min() < 0.5:
                    continue
                for column, edge, (depth, right) in ((columns[0], 0, ends[0]), (columns[-1], 1, ends[1])):
                    if 0 < column < width - 1:
                        # The engine rounds the projected corner away from the picture's middle.
                        rounding = 1 if column + edge > width / 2 else -1
                        self.columns.append((frame, right / depth, column + edge, rounding))
                        rows = np.flatnonzero(different[:, column])
                        if rows[0] > 0 and rows[-1] < height - 1:
                            top = EYE_HEIGHT_M - WALL_HEIGHT_UNITS / UNITS_PER_M
                            self.rows += [(top / depth, rows[0]), (EYE_HEIGHT_M / depth, rows[-1] + 1)]
        env.close()
        self.width = width

    def ends(self, face: int, frame: int, poses: np.ndarray | None = None) -> np.ndarray:
        """(2, 2) forward and rightward distance of the face's left and right end from the camera, m."""
        x, y, yaw = (self.poses if poses is None else poses)[frame]
        offset = FACES[face].reshape(2, 2) * ROOM.block_m - (x, y)
        forward = offset @ (math.cos(yaw), math.sin(yaw))
        right = offset @ (math.sin(yaw), -math.cos(yaw))
        ends = np.stack((forward, right), axis=1)
        return ends[np.argsort(ends[:, 1] / ends[:, 0])]


@pytest.mark.parametrize("field_of_view_deg", [90, 108])
def test_the_field_of_view_is_that_of_the_picture_of_a_known_wall(field_of_view_deg: int) -> None:
    """Corners of wall faces at known places appear where a pinhole of this field of view shows them."""
    config = Maze3DConfig(actuation_noise=0.0, field_of_view_deg=field_of_view_deg)
    sight = Sight(config, [LEFT, LEFT, FORWARD, RIGHT, RIGHT, RIGHT, RIGHT, FORWARD] * 3, (12.0, 13.5, 90))
    _, slope, column, rounding = np.array(sight.columns).T
    focal, center = np.polyfit(slope, column - rounding / 2, 1)
    measured_deg = 2 * math.degrees(math.atan(sight.width / 2 / focal))
    assert len(slope) > 200 and slope.max() - slope.min() > 1.5
    assert measured_deg == pytest.approx(field_of_view_deg, abs=0.3)
    assert center == pytest.approx(sight.width / 2, abs=0.2)
    focal_x, focal_y = config.focal_lengths_px
    assert focal == pytest.approx(2 * focal_x, rel=0.005)
    assert np.abs(column - rounding / 2 - sight.width / 2 - 2 * focal_x * slope).max() < 0.75
    down, row = np.array(sight.rows).T
    assert np.polyfit(down, row, 1)[0] == pytest.approx(2 * focal_y, rel=0.01)


def test_the_pose_is_that_of_the_very_picture() -> None:
    """While driving and turning at full speed each picture fits its own pose, and none its neighbour's."""
    actions = [LEFT] * 6 + [RIGHT] * 12 + [FORWARD] * 3 + [LEFT] * 9
    sight = Sight(EXACT, actions, (10.0, 9.0, 80))
    focal = 2 * EXACT.focal_lengths_px[0]
    turning = np.abs(np.diff(sight.poses[:, 2])) > math.radians(4)
    assert turning.sum() > 15
    own, before = [], []
    for frame, slope, column, rounding in sight.columns:
        if frame > 0 and turning[frame - 1]:
            seen = math.atan((column - rounding / 2 - sight.width / 2) / focal)
            own.append(seen - math.atan(slope))
            before.append(own[-1] - (sight.poses[frame, 2] - sight.poses[frame - 1, 2]))
    assert np.abs(own).max() < 0.75 / focal
    assert np.abs(before).min() > math.radians(3)


def test_observations_are_the_exact_mean_of_the_rendered_picture(shared: Maze3D) -> None:
    observation, _ = shared.reset(seed=3)
    picture = shared.render()
    assert picture is not None and picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    assert observation.shape == (60, 80, 3) and observation.dtype == np.uint8
    mean = picture.astype(float).reshape(60, 2, 80, 2, 3).mean(axis=(1, 3))
    np.testing.assert_array_equal(observation, np.floor(mean + 0.5))
    np.testing.assert_array_equal(mean_2x2(np.full((2, 2, 3), 255, dtype=np.uint8)), [[[255] * 3]])


def test_the_start_is_where_the_map_says_in_metres_and_radians() -> None:
    for heading_deg, yaw in ((0, 0.0), (90, math.pi / 2), (225, -math.pi * 3 / 4)):
        env = Room(EXACT)
        env.start = (7.5, 16.5, heading_deg)
        _, info = env.reset(seed=0)
        env.close()
        np.testing.assert_allclose(info["pose_xyyaw"], (7.5, 16.5, yaw), atol=1e-6)
        assert info["pose_xyyaw"].dtype == np.float64 and info["time_s"] == 0.0


def test_walls_stop_the_body_where_the_maze_has_them(shared: Maze3D) -> None:
    _, info = shared.reset(seed=4)
    maze = shared.maze
    driver = PathDriver(maze, np.random.default_rng(4), goals="random", random_action_probability=0.3)
    lows = np.argwhere(maze.walls)[:, ::-1] * maze.block_m
    nearest = math.inf
    for _ in range(600):
        *_, info = shared.step(driver.action(info["pose_xyyaw"]))
        x, y, _ = info["pose_xyyaw"]
        assert not maze.walls[maze.block_at(x, y)]
        # Doom's body is a square along the axes.
        gaps = np.maximum(lows - (x, y), (x, y) - lows - maze.block_m).max(axis=1)
        nearest = min(nearest, float(gaps.min()))
    assert PLAYER_RADIUS_M - 1e-3 <= nearest < PLAYER_RADIUS_M + 0.2


def test_turning_accelerates_and_coasts_as_configured() -> None:
    env = Room(EXACT)
    _, info = env.reset(seed=0)
    rate, yaw = 0.0, info["pose_xyyaw"][2]
    for action, push in [(LEFT, 2.2)] * 8 + [(FORWARD, 0.0)] * 4 + [(RIGHT, -2.2)] * 8:
        *_, info = env.step(action)
        rate = 0.75 * rate + push
        turned = math.degrees(math.remainder(info["pose_xyyaw"][2] - yaw, math.tau))
        # The engine turns in units of 1/65536 of a circle a tic.
        assert turned == pytest.approx(rate, abs=2 * 360 / 65536)
        yaw = info["pose_xyyaw"][2]
    env.close()


def test_driving_follows_dooms_inertia() -> None:
    env = Room(EXACT)
    env.start = (4.5, 4.5, 0)
    _, info = env.reset(seed=0)
    speed, x = 0.0, 4.5
    for step in range(25):
        _, reward, terminated, truncated, info = env.step(FORWARD)
        for _ in range(2):
            speed += 25 * 2048 / 65536  # units a tic
            x += speed / UNITS_PER_M
            speed *= 0xE800 / 65536
        assert info["pose_xyyaw"][0] == pytest.approx(x, abs=2e-3)
        assert info["pose_xyyaw"][1] == 4.5
        assert info["time_s"] == pytest.approx((step + 1) * 2 / 35)
        assert not terminated and not truncated and reward >= 0
    assert reward == pytest.approx(2 * speed / (0xE800 / 65536) / UNITS_PER_M, rel=0.05)
    env.close()


def test_the_picture_holds_nothing_but_the_maze() -> None:
    """No weapon, bar, number or cross: where all textures differ, no pixel is alike, driving and turning."""
    env = Room(EXACT, render_mode="rgb_array")
    red = MapStyle(("REDWALL",) * len(FACES), "GRASS1", "GRASS1")
    gray = MapStyle(("AQCONC06",) * len(FACES), "AQF025", "AQF025")
    env.styles = (red, gray)
    env.preload([0, 1])
    actions = [FORWARD] * 20 + [LEFT] * 10
    alike = (drive(env, 0, actions)[0] == drive(env, 1, actions)[0]).all(axis=-1)
    env.close()
    assert alike.mean(axis=(1, 2)).max() < 1e-3


def test_worlds_without_choices_are_what_they_have_always_been() -> None:
    """Networks were trained in them, and seeds of results name them: not a byte may change."""
    env = Maze3D(Maze3DConfig(textures="all", decorations=0))
    texts = [env._build_world(*seeds).text for seeds in ((0, 0), (7, 7), (5, 9))]
    assert [hashlib.sha256(text.encode()).hexdigest()[:16] for text in texts] == [
        "3fbfe24e0b811895", "14763fad43d50ea4", "4506b3e688bddc5e"]  # fmt: skip
    env.close()


@pytest.mark.parametrize("maze_seed", [3, 4])
def test_textures_light_and_decorations_change_nothing_else(maze_seed: int) -> None:
    def things(text: str) -> list[str]:
        return [line for line in text.splitlines() if not line.startswith(("sidedef", "sector"))]

    plain = Maze3D()._build_world(3, maze_seed)
    for name in TEXTURE_SETS:
        world = Maze3D(Maze3DConfig(textures=name, light_level=150, decorations=12))._build_world(3, maze_seed)
        np.testing.assert_array_equal(world.maze.walls, plain.maze.walls)
        assert things(world.text)[:-12] == things(plain.text)
        assert set(re.findall(r'texturemiddle="([^"]+)"', world.text)) <= set(TEXTURE_SETS[name].walls)
        assert set(re.findall(r'texture(?:floor|ceiling)="([^"]+)"', world.text)) <= set(TEXTURE_SETS[name].flats)
    # Those of a maze do not depend on where one starts in it.
    assert things(world.text)[-12:] == things(Maze3D(world_config(12))._build_world(9, maze_seed).text)[-12:]


def world_config(decorations: int) -> Maze3DConfig:
    return Maze3DConfig(actuation_noise=0.0, decorations=decorations)


def test_same_seed_same_bytes(shared: Maze3D) -> None:
    """Preloaded or not, first or after other episodes, alone or beside another environment."""
    expected = digest(shared, 6)
    digest(shared, 7)
    assert digest(shared, 6) == expected
    with_other_maps, alone = Maze3D(), Maze3D()
    with_other_maps.preload([123, 6])
    assert digest(with_other_maps, 6) == expected
    assert digest(alone, 6) == expected
    assert digest(alone, 8) != expected
    with_other_maps.close()
    assert digest(with_other_maps, 6) == expected
    with_other_maps.close()
    alone.close()


def test_noise_is_of_the_seed_and_of_its_size(shared: Maze3D) -> None:
    quiet = Maze3D(EXACT)
    _, info = quiet.reset(seed=6)
    _, noisy_info = shared.reset(seed=6)
    np.testing.assert_array_equal(info["pose_xyyaw"], noisy_info["pose_xyyaw"])
    turned, noisy_turned = [], []
    for _ in range(200):
        turned.append(quiet.step(LEFT)[4]["pose_xyyaw"][2])
        noisy_turned.append(shared.step(LEFT)[4]["pose_xyyaw"][2])
    quiet.close()
    rates = np.degrees(np.remainder(np.diff(noisy_turned), math.tau))
    pushes = rates[1:] - 0.75 * rates[:-1]
    assert pushes.mean() == pytest.approx(2.2, abs=0.06)
    assert pushes.std() == pytest.approx(0.22, rel=0.3)
    assert np.degrees(np.remainder(np.diff(turned), math.tau))[-50:].std() < 0.01


@pytest.mark.parametrize("preloaded", [False, True])
def test_a_maze_of_another_seed_has_its_walls_and_look_and_a_start_of_its_own(preloaded: bool) -> None:
    env = Maze3D()
    if preloaded:
        env.preload([5, 6], [9, 9])
    starts = []
    _, info = env.reset(seed=9)
    walls, text = env.maze.walls, env._loaded[9, 9].text
    starts.append(info["pose_xyyaw"])
    game = env._engine._game
    for seed in (5, 6):
        _, info = env.reset(seed=seed, options={"maze_seed": 9})
        np.testing.assert_array_equal(env.maze.walls, walls)
        # The player, who comes before the sector, stands elsewhere; all else is the same.
        found = env._loaded[seed, 9].text
        assert found != text and found[found.index("sector") :] == text[text.index("sector") :]
        starts.append(info["pose_xyyaw"])
        assert (env._engine._game is game) == preloaded
    assert len({tuple(start) for start in starts}) == 3
    _, again = env.reset(seed=5, options={"maze_seed": 9})
    np.testing.assert_array_equal(again["pose_xyyaw"], starts[1])
    env.close()


def test_close_ends_the_process_and_leaves_no_file(
    temporary: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    working = tmp_path / "working"
    working.mkdir()
    monkeypatch.chdir(working)
    env = Maze3D()
    env.reset(seed=0)
    env.reset(seed=1)
    assert Path.cwd() == working and not list(working.iterdir())
    assert len(engines(temporary)) == 1
    assert not list(temporary.iterdir()), "a killed process leaves nothing, for there is nothing while it runs"
    env.close()
    env.close()
    wait_until_gone(temporary)
    with pytest.raises(RuntimeError, match=r"step\(\) before reset"):
        env.step(FORWARD)
    env.reset(seed=2)
    assert len(engines(temporary)) == 1
    del env
    wait_until_gone(temporary)
    assert not list(working.iterdir())


@pytest.mark.parametrize(
    ("end", "code"),
    [
        ("sys.exit(3)", 3),
        ("os.kill(os.getpid(), signal.SIGINT)", -signal.SIGINT),
        ("keep = [env]; keep.append(keep)", 0),
    ],
)
def test_an_interpreter_that_ends_without_close_takes_the_engine_along(temporary: Path, end: str, code: int) -> None:
    program = (
        "import os, signal, sys\nfrom ngo_sim.maze3d import Maze3D\n"
        f"env = Maze3D()\nenv.reset(seed=0)\nenv.step(0)\n{end}\n"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False, cwd=temporary.parent
    )
    assert result.returncode == code
    assert "could not be saved" not in result.stdout + result.stderr
    wait_until_gone(temporary)
    assert [path.name for path in temporary.parent.iterdir()] == ["temporary"]


def test_an_engine_that_dies_is_told_and_started_again(temporary: Path) -> None:
    env = Maze3D()
    expected, _ = env.reset(seed=0)
    (engine,) = engines(temporary)
    os.kill(engine, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="the engine has ended"):
        env.step(FORWARD)
    observation, _ = env.reset(seed=0)
    np.testing.assert_array_equal(observation, expected)
    env.close()
    wait_until_gone(temporary)


def test_gymnasium_finds_nothing_to_complain_about() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = Maze3D(render_mode="rgb_array")
        check_env(env, skip_render_check=True)
        env.close()


def test_an_aliased_maze_has_one_texture() -> None:
    text = Maze3D(Maze3DConfig(rows=4, cols=4, extra_openings=0, aliased=True))._build_world(3, 3).text
    assert len(set(re.findall(r'texturemiddle="(\w+)"', text))) == 1
