"""A gymnasium environment over ViZDoom: first-person pictures of a textured block maze, exact poses, three actions."""

from __future__ import annotations

import math
import os
import tempfile
import threading
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import vizdoom
from numpy.typing import NDArray
from vizdoom import Button, GameVariable, ScreenResolution

from ngo_sim.doom_map import PLAYER_RADIUS_UNITS, UNITS_PER_M, random_style, textmap, wall_faces, write_pwad
from ngo_sim.drivers import Action
from ngo_sim.mazes import Maze, kruskal_maze

TICS_PER_S = 35
"""Doom's fixed rate of simulation."""

SUPERSAMPLING = 2
"""Side in rendered pixels of the square that is averaged into one pixel of an observation."""

# ViZDoom renders a fixed list of sizes. These are the ones of aspect 4:3, to which alone the camera model below applies.
_RESOLUTIONS = {
    (80, 60): ScreenResolution.RES_160X120,
    (160, 120): ScreenResolution.RES_320X240,
    (200, 150): ScreenResolution.RES_400X300,
    (256, 192): ScreenResolution.RES_512X384,
    (320, 240): ScreenResolution.RES_640X480,
}
# Doom's pixels are 1.2 times as high as wide: a 320x200 picture filled a 4:3 screen. The engine keeps that stretch at any size.
_PIXEL_STRETCH = 1.2
# The engine ignores input during the first 7 tics of a map and widens the field of view by 7 degrees a tic at most.
_SETTLING_TICS = 20
_ENGINE_SEED = 1
# The engine writes a folder into its working directory, which it can only inherit: see Maze3D._start_game.
_WORKING_DIRECTORY_LOCK = threading.Lock()


@dataclass(frozen=True)
class Maze3DConfig:
    """Everything that a 3D world depends on besides its seed.

    Attributes:
        rows: Cells of the maze along y.
        cols: Cells of the maze along x.
        extra_openings: Walls opened beyond the spanning tree, each making a cycle.
        block_m: Side of a block and width of a corridor, m.
        actuation_noise: Standard deviation of thrust and angular acceleration as a fraction of their size. Doom
            takes thrust in whole units, so the thrust is rounded to 1/25 of its size.
        width: Width of an observation in pixels.
        height: Height of an observation in pixels.
        field_of_view_deg: Horizontal field of view, whole degrees.
        frame_skip: Tics of 1/35 s in one step.
        thrust: Doom's forward command, 25 = walking, 50 = running.
        turn_acceleration_deg: Angular velocity gained by a step of turning, degrees a step.
        turn_retention: Share of the angular velocity that is left after a step.
        light_level: Brightness of the maze, 0 to 255.
    """

    rows: int = 5
    cols: int = 5
    extra_openings: int = 2
    block_m: float = 3.0
    actuation_noise: float = 0.1
    width: int = 80
    height: int = 60
    field_of_view_deg: int = 108
    frame_skip: int = 2
    thrust: int = 25
    turn_acceleration_deg: float = 2.2
    turn_retention: float = 0.75
    light_level: int = 208

    def __post_init__(self) -> None:
        _check_int("rows", self.rows, 2, 30)
        _check_int("cols", self.cols, 2, 30)
        _check_int("extra_openings", self.extra_openings, 0, (self.rows - 1) * (self.cols - 1))
        _check_float("block_m", self.block_m, 4 * PLAYER_RADIUS_UNITS / UNITS_PER_M, 10.0)
        _check_float("actuation_noise", self.actuation_noise, 0.0, 1.0)
        if (self.width, self.height) not in _RESOLUTIONS:
            allowed = ", ".join(f"{w}x{h}" for w, h in _RESOLUTIONS)
            raise ValueError(f"width, height are {self.width!r}, {self.height!r}; allowed: {allowed}")
        _check_int("field_of_view_deg", self.field_of_view_deg, 30, 150)
        _check_int("frame_skip", self.frame_skip, 1, 35)
        _check_int("thrust", self.thrust, 1, 50)
        _check_float("turn_acceleration_deg", self.turn_acceleration_deg, 0.1, 90.0)
        _check_float("turn_retention", self.turn_retention, 0.0, 0.99)
        _check_int("light_level", self.light_level, 0, 255)

    @property
    def period_s(self) -> float:
        """Simulated time of one step, s."""
        return self.frame_skip / TICS_PER_S

    @property
    def focal_lengths_px(self) -> tuple[float, float]:
        """Horizontal and vertical focal length in pixels of an observation; the optical axis is the picture's centre."""
        horizontal = self.width / 2 / math.tan(math.radians(self.field_of_view_deg) / 2)
        return horizontal, horizontal * _PIXEL_STRETCH


@dataclass(frozen=True)
class World:
    """One maze as the engine is to load it.

    Attributes:
        maze: The maze.
        text: Its UDMF text with textures and start.
    """

    maze: Maze
    text: str


class Maze3D(gymnasium.Env[NDArray[np.uint8], np.int64]):
    """Drive through a Kruskal maze in ViZDoom.

    Observations are (height, width, 3) uint8 RGB, the exact 2x2 mean of the rendered picture. Actions are
    :class:`ngo_sim.drivers.Action`. The reward is the distance travelled in the step, m; episodes never end by themselves.
    ``info`` has ``pose_xyyaw``, float64 (3,): x, y in m and yaw in (-pi, pi], in the maze's frame, at the very tic that the
    picture shows; and ``time_s``, simulated time since the reset. After ``reset(seed=s)`` everything is a function of ``s`` and
    the configuration, to the byte.

    The engine is a process of its own with files of its own: call :meth:`close`, or use the environment in a ``with`` block.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": TICS_PER_S}

    def __init__(self, config: Maze3DConfig | None = None, render_mode: str | None = None) -> None:
        """Prepare an environment; the engine starts at the first reset.

        Raises:
            ValueError: If ``render_mode`` is unknown.
        """
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; allowed: None, 'rgb_array'")
        self.config = config if config is not None else Maze3DConfig()
        self.render_mode = render_mode
        self.period_s = self.config.period_s
        self.observation_space = gymnasium.spaces.Box(0, 255, (self.config.height, self.config.width, 3), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(len(Action))
        self.maze: Maze
        self._preloaded: dict[int, World] = {}
        self._loaded: dict[int, World] = {}
        self._game: vizdoom.DoomGame | None = None
        self._picture: NDArray[np.uint8] | None = None

    def preload(self, seeds: Iterable[int]) -> None:
        """Write the maps of ``seeds`` into one WAD, in place of those preloaded before.

        A reset to one of them then costs milliseconds instead of a start of the engine. What it gives is the same.
        """
        self._preloaded = {int(seed): self._build_world(int(seed)) for seed in seeds}
        self._start_game(self._preloaded)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Load the maze of ``seed`` (without one: of a seed drawn from the environment's generator), standing still."""
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        if self._game is None or seed not in self._loaded:
            worlds = dict(self._preloaded)
            if seed not in worlds:
                worlds[seed] = self._build_world(seed)
            self._start_game(worlds)
        assert self._game is not None
        self.maze = self._loaded[seed].maze
        self._noise_rng = _generator(seed, stream=2)
        self._turn_rate_deg = 0.0
        self._steps = 0
        self._game.set_doom_map(_map_name(list(self._loaded).index(seed)))
        self._game.new_episode()
        # A new map brings the default field of view back; `+fov` as an argument of the engine holds for its first map only.
        self._game.send_game_command(f"fov {self.config.field_of_view_deg}")
        self._game.make_action([0, 0], _SETTLING_TICS)
        field_of_view = self._game.get_game_variable(GameVariable.CAMERA_FOV)
        if field_of_view != self.config.field_of_view_deg:
            raise RuntimeError(f"the engine's field of view is {field_of_view}, not {self.config.field_of_view_deg} degrees")
        observation, self._pose_xyyaw = self._observe()
        return observation, self._info()

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Apply one action for ``frame_skip`` tics.

        Raises:
            ValueError: If ``action`` is no :class:`Action`.
            RuntimeError: If the environment was not reset, or the engine ended.
        """
        if self._game is None:
            raise RuntimeError("step() before reset(), or after close()")
        if not self.action_space.contains(action):
            raise ValueError(f"action is {action!r}; allowed: 0 (forward), 1 (turn left), 2 (turn right)")
        config = self.config
        strength = 1.0 + config.actuation_noise * self._noise_rng.standard_normal()
        direction = (0.0, 1.0, -1.0)[int(action)]
        self._turn_rate_deg = (
            config.turn_retention * self._turn_rate_deg + direction * config.turn_acceleration_deg * strength
        )
        thrust = round(config.thrust * strength) if action == Action.FORWARD else 0
        # The engine turns clockwise for a positive number, and by that number in each tic.
        self._game.make_action([thrust, -self._turn_rate_deg / config.frame_skip], config.frame_skip)
        observation, pose_xyyaw = self._observe()
        distance_m = math.hypot(pose_xyyaw[0] - self._pose_xyyaw[0], pose_xyyaw[1] - self._pose_xyyaw[1])
        self._pose_xyyaw = pose_xyyaw
        self._steps += 1
        return observation, distance_m, False, False, self._info()

    def render(self) -> NDArray[np.uint8] | None:  # type: ignore[override]
        """Return the first-person picture before averaging, (2 height, 2 width, 3) RGB; None without a render mode."""
        return None if self.render_mode is None or self._picture is None else self._picture.copy()

    def close(self) -> None:
        """End the engine and delete its files; the environment can be reset again."""
        game, self._game = getattr(self, "_game", None), None
        if game is not None:
            game.close()
        self._loaded = {}
        directory = self.__dict__.pop("_directory", None)
        if directory is not None:
            directory.cleanup()

    def __del__(self) -> None:
        self.close()

    @cached_property
    def _directory(self) -> tempfile.TemporaryDirectory[str]:
        return tempfile.TemporaryDirectory(prefix="ngo_maze3d_")

    def _build_world(self, seed: int) -> World:
        config = self.config
        maze = kruskal_maze(config.rows, config.cols, _generator(seed, stream=0), config.extra_openings, config.block_m)
        rng = _generator(seed, stream=1)
        style = random_style(len(wall_faces(maze.walls)), rng, config.light_level)
        start_x, start_y = maze.block_center(rng.choice(maze.free_blocks()))
        return World(maze, textmap(maze, style, (float(start_x), float(start_y)), int(rng.integers(360))))

    def _start_game(self, worlds: dict[int, World]) -> None:
        if self._game is not None:
            self._game.close()
            self._game = None
        folder = Path(self._directory.name)
        write_pwad(folder / "maps.wad", ((_map_name(i), world.text) for i, world in enumerate(worlds.values())))
        game = vizdoom.DoomGame()
        game.set_doom_game_path(str(Path(vizdoom.__file__).parent / "freedoom2.wad"))
        game.set_doom_scenario_path(str(folder / "maps.wad"))
        game.set_doom_config_path(str(folder / "engine.ini"))
        game.set_doom_map(_map_name(0))
        game.set_screen_resolution(_RESOLUTIONS[self.config.width, self.config.height])
        game.set_screen_format(vizdoom.ScreenFormat.RGB24)
        for hide in (
            game.set_render_hud, game.set_render_minimal_hud, game.set_render_crosshair, game.set_render_weapon,
            game.set_render_decals, game.set_render_particles, game.set_render_effects_sprites,
            game.set_render_messages, game.set_render_corpses, game.set_render_screen_flashes,
            game.set_window_visible, game.set_sound_enabled, game.set_console_enabled,
        ):  # fmt: skip
            hide(False)
        game.set_mode(vizdoom.Mode.PLAYER)
        game.set_episode_timeout(0)
        game.set_seed(_ENGINE_SEED)
        game.set_available_buttons([Button.MOVE_FORWARD_BACKWARD_DELTA, Button.TURN_LEFT_RIGHT_DELTA])
        game.set_available_game_variables([GameVariable.POSITION_X, GameVariable.POSITION_Y, GameVariable.ANGLE])
        # The camera of a walking player goes up and down by default.
        game.set_game_args("+movebob 0 +stillbob 0")
        with _WORKING_DIRECTORY_LOCK:
            caller = os.open(".", os.O_RDONLY)
            try:
                os.chdir(folder)
                game.init()
            finally:
                os.fchdir(caller)
                os.close(caller)
        self._game, self._loaded = game, worlds

    def _observe(self) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
        assert self._game is not None
        state = self._game.get_state()
        if state is None:
            raise RuntimeError("the engine ended the episode")
        self._picture = state.screen_buffer
        x, y, angle_deg = state.game_variables
        yaw = math.radians(angle_deg)
        yaw = math.pi - (math.pi - yaw) % (2 * math.pi)
        return mean_2x2(self._picture), np.array([x / UNITS_PER_M, y / UNITS_PER_M, yaw])

    def _info(self) -> dict[str, Any]:
        return {"pose_xyyaw": self._pose_xyyaw.copy(), "time_s": self._steps * self.period_s}


def mean_2x2(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average squares of 2x2 pixels, (2 h, 2 w, channels) -> (h, w, channels), rounding halves up."""
    rows = picture[0::2].astype(np.uint16)
    rows += picture[1::2]
    total = rows[:, 0::2] + rows[:, 1::2]
    total += 2
    total >>= 2
    return total.astype(np.uint8)


def _generator(seed: int, stream: int) -> np.random.Generator:
    """Return one of the independent generators of a seed: 0 maze, 1 textures and start, 2 actuation noise."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


def _map_name(index: int) -> str:
    return f"M{index:07d}"


def _check_int(name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r}; allowed: a whole number from {low} to {high}")


def _check_float(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r}; allowed: a number from {low:g} to {high:g}")
