"""The 3D world: a walker in a maze of textured walls, or in any Doom map, seen by ViZDoom in first-person pictures."""

from __future__ import annotations

import math
import weakref
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from ngo_common.settings import BadParameter, Settings, setting
from ngo_sim.doom_engine import RESOLUTIONS, DoomEngine
from ngo_sim.doom_level import DoomLevel, load_level, with_drawn_start
from ngo_sim.doom_map import (
    PLAYER_RADIUS_UNITS,
    TEXTURE_SETS,
    UNITS_PER_M,
    map_lumps,
    random_decorations,
    random_style,
    textmap,
    wall_faces,
)
from ngo_sim.doom_walls import wall_ranges
from ngo_sim.drivers import Action
from ngo_sim.mazes import Maze, check_aliased, check_maze_size, kruskal_maze, repeated_maze
from ngo_sim.rooms_level import rooms_textmap

TICS_PER_S = 35  # Doom's fixed rate of simulation.

# Doom's pixels are 1.2 times as high as wide (320 x 200 of them filled a screen of 4:3), at any size.
_PIXEL_STRETCH = 1.2
# Who walks against something tries to open it, and again after longer than a door takes to rise: a press while it
# rises would close it.
_STANDING_M, _STEPS_A_PRESS = 0.02, 24
_TURN: dict[int, float] = {Action.FORWARD: 0.0, Action.TURN_LEFT: 1.0, Action.TURN_RIGHT: -1.0}


# A Doom map brings its own walls, looks and things, and so does a level of rooms.
_OF_MAZES = ("rows", "cols", "extra_openings", "aliased", "block_m", "light_level", "textures", "decorations")


@dataclass(frozen=True)
class Maze3DConfig(Settings):
    """The 3D world. Turn rates are given a step, as in w <- turn_decay w + turn_deg."""

    rows: int = setting(5, "Cells of the maze along y.", minimum=2, maximum=100)
    cols: int = setting(5, "Cells of the maze along x.", minimum=2, maximum=100)
    extra_openings: int = setting(
        2,
        "Walls opened on top of the spanning tree, each one a cycle.",
        allowed="an integer from 0 to (rows - 1) (cols - 1)",
    )
    aliased: bool = setting(
        False, "Whether one module of 2 x 2 cells repeats, with walls that look alike; without extra openings then."
    )
    # Doom's coordinates end at 32767 units, its player is a square of 1 m.
    block_m: float = setting(
        3.0,
        "Side of a block and width of a corridor, m.",
        minimum=4 * PLAYER_RADIUS_UNITS / UNITS_PER_M,
        maximum=5.0,
    )
    actuation_noise: float = setting(
        0.1, "Standard deviation of an action's acceleration as a fraction of it.", minimum=0.0, maximum=1.0
    )
    width: int = setting(80, "Width of an observation, pixels.", allowed="80, 160, 200, 256 or 320")
    height: int = setting(60, "Height of an observation, pixels.", allowed="3/4 of width")
    field_of_view_deg: int = setting(
        108, "Angle from the left to the right border of the picture.", minimum=30, maximum=150
    )
    frame_skip: int = setting(2, "Tics of 1/35 s in a step.", minimum=1, maximum=TICS_PER_S)
    thrust: int = setting(
        25,
        "Doom's forward command in whole units, into which noise is rounded; 25 walks, 50 runs.",
        minimum=1,
        maximum=50,
    )
    turn_deg: float = setting(2.2, "Gain of turn rate by one turn action, degrees a step.", minimum=0.0, maximum=90.0)
    turn_decay: float = setting(0.75, "Share of the turn rate that a step leaves.", minimum=0.0, maximum=0.99)
    light_level: int = setting(208, "Light of the whole maze; 0 is black.", minimum=0, maximum=255)
    textures: str = setting("all", "Set of the textures of walls, floor and ceiling.", choices=tuple(TEXTURE_SETS))
    decorations: int = setting(0, "Number of things in the maze that block nobody.", minimum=0, maximum=1000)
    level: str = setting(
        "maze", "What is drawn from the seed: a maze, or rooms of all sizes and shapes.", choices=("maze", "rooms")
    )
    wad: str = setting(
        "",
        "File of a Doom map to drive in instead of a maze.",
        allowed="a WAD file, or the name of one that ViZDoom ships",
    )
    map: str = setting("", "Name of the map in wad, as MAP01.", allowed="a map of the wad; empty without one")

    def __post_init__(self) -> None:
        super().__post_init__()
        check_maze_size(self.rows, self.cols, self.extra_openings)
        check_aliased(self.aliased, self.rows, self.cols, self.extra_openings)
        if (self.width, self.height) not in RESOLUTIONS:
            allowed = ", ".join(f"{width} x {height}" for width, height in RESOLUTIONS)
            raise ValueError(f"width x height is {self.width} x {self.height}; it must be one of {allowed}")
        if bool(self.wad) != bool(self.map):
            raise ValueError(f"wad is {self.wad!r} and map is {self.map!r}; they must be given both, or neither")
        if self.wad and self.level != "maze":
            raise BadParameter(f"parameter 'level' is {self.level!r}; allowed: 'maze' together with wad")
        for item in fields(self) if self.wad or self.level != "maze" else ():
            value = getattr(self, item.name)
            if item.name in _OF_MAZES and value != item.default:
                raise BadParameter(
                    f"parameter '{item.name}' is {value!r}; allowed: {item.default!r} together with "
                    f"{'wad' if self.wad else 'level'}, for it shapes mazes alone"
                )

    @property
    def period_s(self) -> float:
        """Time between two frames, s."""
        return self.frame_skip / TICS_PER_S

    @property
    def focal_lengths_px(self) -> tuple[float, float]:
        """Horizontal and vertical focal length in pixels of an observation, whose middle is the axis."""
        horizontal = self.width / 2 / math.tan(math.radians(self.field_of_view_deg) / 2)
        return horizontal, horizontal * _PIXEL_STRETCH


_Seeds = tuple[int, int]  # of the episode and of its maze


@dataclass(frozen=True, eq=False)
class DoomWorld:
    """A maze, or None for a level of rooms, and the UDMF text, which has textures and the start."""

    maze: Maze | None
    text: str


class Maze3D(gymnasium.Env[NDArray[np.uint8], np.int64]):
    """Drive through a Kruskal maze or a level of rooms in ViZDoom, or through the Doom map of the config.

    Observations are uint8 (height, width, 3) RGB, the exact mean of 2 x 2 rendered pixels. Actions are
    `ngo_sim.drivers.Action`. The reward is the distance travelled in the step in m; episodes never end by
    themselves. info has "pose_xyyaw", float64 (3,) in the maze's frame (m, m, rad in [-pi, pi],
    counter-clockwise) at the very tic that the picture shows, and "time_s" since the reset.

    reset(seed=s) makes maze, textures, decorations, start and noise functions of s and the config, to the byte,
    preloaded or not. Maze, start and noise are the same with any textures, light and decorations. Option
    "maze_seed" of reset takes maze, textures and decorations of another seed; start and noise remain those of s.
    Option "drawn_start" of reset draws the start on a Doom map, among the places of things that lie there.
    A Doom map has its own looks and start, and poses are in the map's own axes. There and in a level of
    rooms `maze` is None, a door opens to who walks against it, and what flickers does so by the engine's clock.
    Raises ValueError for a map that is not there.

    The engine is a process, which ends with close(), with the environment or with the interpreter,
    whichever comes first.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": TICS_PER_S}

    def __init__(
        self, config: Maze3DConfig | None = None, render_mode: str | None = None, tells_walls: bool = False
    ) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f"render_mode is {render_mode!r}; it must be None or 'rgb_array'")
        self.config = config if config is not None else Maze3DConfig()
        self.render_mode = render_mode
        self.period_s = self.config.period_s
        self._level: DoomLevel | None = load_level(self.config.wad, self.config.map) if self.config.wad else None
        self.maze: Maze | None = None
        self.action_space = gymnasium.spaces.Discrete(len(Action))
        shape = (self.config.height, self.config.width, 3)
        self.observation_space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        size = self.config.width, self.config.height
        self._engine = DoomEngine(*size, self.config.field_of_view_deg, self.config.frame_skip, tells_walls)
        weakref.finalize(self, self._engine.close)
        self._preloaded: dict[_Seeds, DoomWorld] = {}
        self._loaded: dict[_Seeds, DoomWorld] = {}
        self._picture: NDArray[np.uint8] | None = None
        self._pose_xyyaw = np.zeros(3)
        self._turn_rate_deg = 0.0  # a step
        self._steps_walled_in = 0
        self._start_was_drawn = False
        self._frame = 0

    @property
    def default_driver(self) -> str:
        """Who drives where nobody is named."""
        return "explorer" if self._level is not None or self.config.level == "rooms" else "random_goals"

    def preload(self, seeds: Iterable[int], maze_seeds: Iterable[int] | None = None) -> None:
        """Write the maps of these seeds, instead of those preloaded before, into one WAD.

        A reset to one of them then costs milliseconds, to any other seed a restart of the engine (0.2 s).
        maze_seeds: the option "maze_seed" of each of these resets, where it is given. A Doom map is the same for
        every seed, so that nothing is to be done.
        """
        if self._level is not None:
            return
        seeds = [int(seed) for seed in seeds]
        mazes = seeds if maze_seeds is None else [int(seed) for seed in maze_seeds]
        if len(seeds) != len(mazes):
            raise ValueError(f"maze_seeds has {len(mazes)} seeds; it must have {len(seeds)}, as many as seeds")
        preloaded = {pair: self._build_world(*pair) for pair in zip(seeds, mazes, strict=True)}
        if not preloaded:
            raise ValueError("seeds is empty; it must have at least one seed")
        self._preloaded = preloaded
        self._load(preloaded)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        """Stand still at the start of the seed's maze; without a seed, of one drawn by the generator."""
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - {"maze_seed", "drawn_start"}):
            raise ValueError(f"options has {unknown}; it may have 'maze_seed' and 'drawn_start'")
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        if self._level is not None:
            if "maze_seed" in options:
                raise ValueError(f"maze_seed is {options['maze_seed']}; a Doom map has no maze of a seed")
            drawn = bool(options.get("drawn_start", False))
            if drawn or self._start_was_drawn or not self._engine.running:
                level = with_drawn_start(self._level, _generator(seed, stream=4)) if drawn else self._level
                self._start_was_drawn = drawn
                self._engine.start(level.lumps, level.name, level.game_wad, harmless=True, rehearse=not level.shipped)
            map_name = self._level.name
        elif "drawn_start" in options:
            raise ValueError("options has 'drawn_start'; a maze's start is always drawn")
        else:
            seeds = (seed, int(options.get("maze_seed", seed)))
            if not self._engine.running or seeds not in self._loaded:
                wanted = {} if seeds in self._preloaded else {seeds: self._build_world(*seeds)}
                self._load({**self._preloaded, **wanted})
            self.maze = self._loaded[seeds].maze
            map_name = _map_name(list(self._loaded).index(seeds))
        self._noise_rng = _generator(seed, stream=2)
        self._turn_rate_deg, self._steps_walled_in, self._frame = 0.0, 0, 0
        self._picture, self._pose_xyyaw = self._engine.enter(map_name)
        return mean_2x2(self._picture), self._info()

    def step(self, action: np.int64 | int) -> tuple[NDArray[np.uint8], float, bool, bool, dict[str, Any]]:
        """Take one of the three actions and let period_s pass.

        Raises ValueError for another action, RuntimeError before a reset or where the engine has ended.
        """
        if not self._engine.running:
            raise RuntimeError("step() before reset(), or after close()")
        if action not in _TURN:
            raise ValueError(f"action is {action!r}; it must be 0 (forward), 1 (turn left) or 2 (turn right)")
        config = self.config
        strength = 1.0 + config.actuation_noise * self._noise_rng.standard_normal()
        turn = _TURN[int(action)] * config.turn_deg * strength
        self._turn_rate_deg = config.turn_decay * self._turn_rate_deg + turn
        thrust = round(config.thrust * strength) if action == Action.FORWARD else 0
        use = self._steps_walled_in % _STEPS_A_PRESS == 2
        last_pose_xyyaw = self._pose_xyyaw
        self._picture, self._pose_xyyaw = self._engine.advance(thrust, self._turn_rate_deg, use)
        self._frame += 1
        moved = self._pose_xyyaw - last_pose_xyyaw
        travelled = math.hypot(moved[0], moved[1])
        walled_in = self.maze is None and action == Action.FORWARD and travelled < _STANDING_M
        self._steps_walled_in = self._steps_walled_in + 1 if walled_in else 0
        return mean_2x2(self._picture), travelled, False, False, self._info()

    def wall_ranges(self, angles_rad: NDArray[np.float64]) -> NDArray[np.float32]:
        """Distances (rays,) in m of the first walls at the height of the eye, along rays in the robot's frame.

        They are of the latest picture. For an environment with tells_walls, in any level.
        """
        return wall_ranges(self._engine.walls(), self._pose_xyyaw, angles_rad)

    def render(self) -> NDArray[np.uint8] | None:
        """The picture as rendered, uint8 (2 height, 2 width, 3); None without a mode or before a reset."""
        return None if self.render_mode is None or self._picture is None else self._picture.copy()

    def close(self) -> None:
        """End the engine; another reset starts it again."""
        self._engine.close()

    def _build_world(self, seed: int, maze_seed: int) -> DoomWorld:
        config = self.config
        if config.level == "rooms":
            return DoomWorld(None, rooms_textmap(_generator(maze_seed, stream=7), _generator(seed, stream=4)))
        maze_rng, rng = _generator(maze_seed, stream=0), _generator(maze_seed, stream=1)
        if config.aliased:
            maze = repeated_maze(config.rows, config.cols, maze_rng, config.block_m)
        else:
            maze = kruskal_maze(config.rows, config.cols, maze_rng, config.extra_openings, config.block_m)
        face_count = len(wall_faces(maze.walls))
        style = random_style(face_count, rng, config.light_level)
        if config.textures != "all":
            # Drawn beside the other, after which the start is the same.
            style = random_style(face_count, _generator(maze_seed, stream=5), config.light_level, config.textures)
        if config.aliased:
            style = replace(style, wall_textures=style.wall_textures[:1] * face_count)
        decorations = random_decorations(maze, config.decorations, _generator(maze_seed, stream=6))
        rng = rng if seed == maze_seed else _generator(seed, stream=4)
        start_x, start_y = maze.block_center(rng.choice(maze.free_blocks()))
        start_heading_deg = int(rng.integers(360))
        start_xy = float(start_x), float(start_y)
        return DoomWorld(maze, textmap(maze, style, start_xy, start_heading_deg, decorations))

    def _load(self, worlds: dict[_Seeds, DoomWorld]) -> None:
        texts = [world.text for world in worlds.values()]
        self._engine.start(map_lumps((_map_name(index), text) for index, text in enumerate(texts)), _map_name(0))
        self._loaded = worlds

    def _info(self) -> dict[str, Any]:
        return {"pose_xyyaw": self._pose_xyyaw.copy(), "time_s": self._frame * self.period_s}


def mean_2x2(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The mean of 2 x 2 pixels each, uint8 (2 h, 2 w, channels) to (h, w, channels), halves rounded up."""
    rows = picture[0::2].astype(np.uint16)
    rows += picture[1::2]
    total = rows[:, 0::2] + rows[:, 1::2]
    total += 2
    total >>= 2
    return total.astype(np.uint8)


def _generator(seed: int, stream: int) -> np.random.Generator:
    """Return one of the independent generators of a seed.

    0: maze, 1: textures and start, 2: actuation noise, 4: start in the maze of another seed, 5: textures of a part
    of them, 6: decorations, 7: levels of rooms (3 is the driver's).
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))


def _map_name(index: int) -> str:
    return f"M{index:07d}"
