"""The 2D world: a disc in a maze of coloured blocks that sees one row of colour and depth around itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pymunk

from ngo_sim.drivers import Action
from ngo_sim.mazes import Maze, check_maze_size, prim_maze
from ngo_sim.raycast import cast_rays

_THRUST = {Action.FORWARD: 1.0, Action.TURN_LEFT: 0.0, Action.TURN_RIGHT: 0.0}
_TURN = {Action.FORWARD: 0.0, Action.TURN_LEFT: 1.0, Action.TURN_RIGHT: -1.0}
_SUBSTEP_RADII = 0.25  # travel of a substep at top speed, at most, in radii
_COLLISION_SLOP_M = 1e-6  # overlap that is left alone
_PIXELS_A_BLOCK = 24


@dataclass(frozen=True)
class Maze2DConfig:
    """The 2D world. Speeds and accelerations are given a step, as in v <- travel_decay (v + thrust_m)."""

    rows: int = 7  # cells of the maze along y
    cols: int = 7  # cells of the maze along x
    extra_openings: int = 0  # walls opened on top of the spanning tree, each one a cycle
    block_m: float = 1.0  # side of a block and width of a corridor
    actuation_noise: float = 0.1  # standard deviation of the factor 1 + noise on every action's acceleration
    period_s: float = 0.1  # time between two frames
    thrust_m: float = 0.06  # gain of forward speed by one forward action, m a step
    travel_decay: float = 0.8  # share of the speed that a step leaves
    turn_deg: float = 6.0  # gain of turn rate by one turn action, degrees a step
    turn_decay: float = 0.6  # share of the turn rate that a step leaves
    radius_m: float = 0.2  # of the robot's body
    rays: int = 241  # in one observation, left to right
    field_of_view_deg: float = 300.0  # from the first ray to the last, straight ahead in the middle

    def __post_init__(self) -> None:
        check_maze_size(self.rows, self.cols, self.extra_openings)
        if isinstance(self.rays, bool) or not isinstance(self.rays, int) or self.rays < 2:
            raise ValueError(f"rays is {self.rays!r}; it must be an integer of at least 2")
        for name, low, high in (("block_m", 0.01, 100.0), ("actuation_noise", 0.0, 1.0), ("period_s", 0.001, 10.0),
                                ("thrust_m", 0.0, math.inf), ("travel_decay", 0.0, 0.99), ("turn_deg", 0.0, 90.0),
                                ("turn_decay", 0.0, 0.99), ("radius_m", 0.001, 0.45 * self.block_m),
                                ("field_of_view_deg", 1.0, 360.0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise ValueError(f"{name} is {value!r}; it must be a number from {low:g} to {high:g}")
        if self.top_speed_m > 0.5 * self.block_m:
            raise ValueError(f"thrust_m is {self.thrust_m!r} and travel_decay is {self.travel_decay!r}, which lead to "
                             f"{self.top_speed_m:g} m a step; at most half a block of {self.block_m:g} m is allowed")

    @property
    def top_speed_m(self) -> float:
        """Forward speed in m a step that endless forward actions lead to, without noise."""
        return self.thrust_m * self.travel_decay / (1.0 - self.travel_decay)


class Maze2D(gymnasium.Env[npt.NDArray[np.float32], int]):
    """Observation float32 (rays, 4): red, green, blue in [0, 1] and depth in m; ray 0 is the leftmost, at +150 degrees.

    Actions: see `Action`. reset and step return info with "pose_xyyaw", float64 (3,), in the maze's frame (m, m, rad,
    counter-clockwise, yaw in [-pi, pi]) and "time_s". The reward is the distance travelled in this step in m. An episode never
    ends by itself. reset(seed=s) makes the maze, the colours, the start pose and the noise functions of s and the config;
    without a seed they follow from what was drawn before. Options of reset: "maze" (a Maze) and "pose_xyyaw" (3,) replace
    what is drawn.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, config: Maze2DConfig = Maze2DConfig(), render_mode: str | None = None) -> None:
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode is {render_mode!r}; it must be None or 'rgb_array'")
        self.config = config
        self.render_mode = render_mode
        self.period_s = config.period_s
        self.maze: Maze
        self.action_space = gymnasium.spaces.Discrete(len(Action))
        far = math.hypot(2 * config.rows + 1, 2 * config.cols + 1) * config.block_m
        high = np.tile(np.array([1.0, 1.0, 1.0, far], dtype=np.float32), (config.rays, 1))
        self.observation_space = gymnasium.spaces.Box(np.zeros_like(high), high, dtype=np.float32)
        half = math.radians(config.field_of_view_deg) / 2
        self.ray_angles_rad = np.linspace(half, -half, config.rays)
        self._ray_cos, self._ray_sin = np.cos(self.ray_angles_rad), np.sin(self.ray_angles_rad)
        # A collision is seen after the body has entered the wall: a tenth of the radius a step keeps that shallow, and
        # far from where the body would leave on the other side.
        self._substeps = max(1, math.ceil(1.5 * config.top_speed_m / (_SUBSTEP_RADII * config.radius_m)))
        self._substep_s = config.period_s / self._substeps

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Draw a maze, colours and a start pose; see the class for the options."""
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - {"maze", "pose_xyyaw"}):
            raise ValueError(f"options has {unknown}; it may have 'maze' and 'pose_xyyaw'")
        config, rng = self.config, self.np_random
        maze = prim_maze(config.rows, config.cols, rng, config.extra_openings, config.block_m)
        self.maze = options.get("maze", maze)
        if self.maze.walls.shape != maze.walls.shape or self.maze.block_m != config.block_m:
            raise ValueError(f"options['maze'] has {self.maze.walls.shape} blocks of {self.maze.block_m} m; the config "
                             f"asks for {maze.walls.shape} blocks of {config.block_m} m")
        self.colors = rng.random((*self.maze.walls.shape, 3), dtype=np.float32)
        start_cell = 2 * rng.integers((config.rows, config.cols)) + 1
        start_yaw = rng.uniform(-math.pi, math.pi)
        start = options.get("pose_xyyaw", (*self.maze.block_center(start_cell), start_yaw))
        self._place_body(*self._checked_pose(start))
        self._velocity_m = (0.0, 0.0)  # a step
        self._turn_rate_rad = 0.0  # a step
        self._frame = 0
        return self._scan(), self._info()

    def step(self, action: int) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one of the three actions and let period_s pass."""
        if action not in _THRUST:
            raise ValueError(f"action is {action!r}; it must be 0, 1 or 2")
        config, body = self.config, self._body
        gain = 1.0 + config.actuation_noise * self.np_random.standard_normal()
        thrust = gain * config.thrust_m * _THRUST[action]
        per_second = 1.0 / config.period_s
        velocity_x, velocity_y = self._velocity_m
        velocity_x = config.travel_decay * (velocity_x + thrust * math.cos(self._yaw))
        velocity_y = config.travel_decay * (velocity_y + thrust * math.sin(self._yaw))
        turn = gain * math.radians(config.turn_deg) * _TURN[action]
        self._turn_rate_rad = config.turn_decay * (self._turn_rate_rad + turn)
        set_velocity = (velocity_x * per_second, velocity_y * per_second)
        body.velocity = set_velocity
        body.angular_velocity = self._turn_rate_rad * per_second
        for _ in range(self._substeps):
            self._space.step(self._substep_s)
        left_velocity = body.velocity
        if left_velocity != set_velocity:
            # The last substep found how far the body is inside a wall; the next one takes it out.
            body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
            self._space.step(self._substep_s)
            velocity_x, velocity_y = left_velocity.x * config.period_s, left_velocity.y * config.period_s
        self._velocity_m = (velocity_x, velocity_y)
        last_x, last_y = self._x, self._y
        self._x, self._y = body.position
        self._yaw = math.remainder(body.angle, math.tau)
        self._frame += 1
        return self._scan(), math.hypot(self._x - last_x, self._y - last_y), False, False, self._info()

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The maze from above, uint8 (height, width, 3), y up, the robot as a disc with its heading; None without a mode."""
        if self.render_mode is None:
            return None
        side = _PIXELS_A_BLOCK
        picture = np.where(self.maze.walls[..., None], 255 * self.colors, 255).astype(np.uint8)
        picture = picture.repeat(side, axis=0).repeat(side, axis=1)
        scale = side / self.config.block_m
        rows, cols = np.ogrid[: picture.shape[0], : picture.shape[1]]
        off_x, off_y = (cols + 0.5) / scale - self._x, (rows + 0.5) / scale - self._y
        along = off_x * math.cos(self._yaw) + off_y * math.sin(self._yaw)
        across = -off_x * math.sin(self._yaw) + off_y * math.cos(self._yaw)
        radius = self.config.radius_m
        picture[off_x**2 + off_y**2 <= radius**2] = (30, 30, 30)
        picture[(along >= 0) & (along <= radius) & (abs(across) <= 0.2 * radius)] = (255, 220, 0)
        return picture[::-1].copy()

    def _scan(self) -> npt.NDArray[np.float32]:
        scan = np.empty((self.config.rays, 4), dtype=np.float32)
        cast_rays(self.maze.walls, self.config.block_m, self._x, self._y, self._yaw, self._ray_cos, self._ray_sin,
                  self.colors, scan)
        return scan

    def _info(self) -> dict[str, Any]:
        return {"pose_xyyaw": np.array((self._x, self._y, self._yaw)), "time_s": self._frame * self.period_s}

    def _checked_pose(self, pose_xyyaw: npt.ArrayLike) -> tuple[float, float, float]:
        """The pose as floats; ValueError where the body would touch a wall."""
        pose = np.asarray(pose_xyyaw, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ValueError(f"pose_xyyaw is {pose_xyyaw!r}; it must be three finite numbers")
        x, y, yaw = pose.tolist()
        block_m = self.config.block_m
        wall = np.argwhere(self.maze.walls)[:, ::-1] * block_m
        gap = np.linalg.norm(pose[:2] - np.clip(pose[:2], wall, wall + block_m), axis=1).min()
        if self.maze.walls[self.maze.block_at(x, y)] or gap < self.config.radius_m:
            raise ValueError(f"pose_xyyaw is {(x, y, yaw)}; it must be at least {self.config.radius_m} m from every wall")
        return x, y, yaw

    def _place_body(self, x: float, y: float, yaw: float) -> None:
        """A new space each time, so that nothing an earlier episode left in the solver can reach this one."""
        self._space = pymunk.Space()
        self._space.collision_slop = _COLLISION_SLOP_M
        self._space.collision_bias = 0.0  # resolve all of an overlap in the next substep
        faces = [pymunk.Segment(self._space.static_body, start, end, 0.0) for start, end in self.maze.wall_faces().tolist()]
        self._body = pymunk.Body(mass=1.0, moment=math.inf)
        self._body.position = (x, y)
        self._body.angle = yaw
        disc = pymunk.Circle(self._body, self.config.radius_m)
        disc.friction = disc.elasticity = 0.0
        self._space.add(self._body, disc, *faces)
        self._x, self._y, self._yaw = x, y, math.remainder(yaw, math.tau)
