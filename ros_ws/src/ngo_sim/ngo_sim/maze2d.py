"""The 2D world: a disc in a maze of coloured blocks that sees one row of colour and depth around itself."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
import pymunk
from gymnasium.utils.seeding import np_random

from ngo_common.settings import Settings, setting
from ngo_sim.drivers import Action
from ngo_sim.mazes import Maze, check_aliased, check_maze_size, prim_maze, repeated_maze
from ngo_sim.raycast import cast_rays
from ngo_sim.velocity_command import VelocityLimits

_THRUST: dict[int, float] = {Action.FORWARD: 1.0, Action.TURN_LEFT: 0.0, Action.TURN_RIGHT: 0.0}
_TURN: dict[int, float] = {Action.FORWARD: 0.0, Action.TURN_LEFT: 1.0, Action.TURN_RIGHT: -1.0}
# The solver sees a collision once the body is inside the wall: a substep enters by this many radii at most.
_SUBSTEP_RADII = 0.25
_SETTLING_SUBSTEPS = 20  # at most, after a collision
_COLLISION_SLOP_M = 1e-6  # overlap that the solver leaves alone
_BLOCKED_SHARE = 0.02  # of the speed, taken by a wall that was met


@dataclass(frozen=True)
class Maze2DConfig(Settings):
    """The 2D world. Speeds and accelerations are given a step, as in v <- travel_decay (v + thrust_m)."""

    rows: int = setting(7, "Cells of the maze along y.", minimum=2, maximum=100)
    cols: int = setting(7, "Cells of the maze along x.", minimum=2, maximum=100)
    extra_openings: int = setting(
        0,
        "Walls opened on top of the spanning tree, each one a cycle.",
        allowed="an integer from 0 to (rows - 1) (cols - 1)",
    )
    aliased: bool = setting(
        False, "Whether one module of 2 x 2 cells repeats, with walls that look alike; without extra openings then."
    )
    block_m: float = setting(1.0, "Side of a block and width of a corridor, m.", minimum=0.01, maximum=100.0)
    actuation_noise: float = setting(
        0.1, "Standard deviation of an action's acceleration as a fraction of it.", minimum=0.0, maximum=1.0
    )
    period_s: float = setting(0.1, "Time between two frames, s.", minimum=0.001, maximum=10.0)
    thrust_m: float = setting(
        0.06, "Gain of forward speed by one forward action, m a step.", allowed="a number from 0 to block_m"
    )
    travel_decay: float = setting(0.8, "Share of the speed that a step leaves.", minimum=0.0, maximum=0.99)
    turn_deg: float = setting(6.0, "Gain of turn rate by one turn action, degrees a step.", minimum=0.0, maximum=90.0)
    turn_decay: float = setting(0.6, "Share of the turn rate that a step leaves.", minimum=0.0, maximum=0.99)
    radius_m: float = setting(
        0.2, "Radius of the robot's body, m.", allowed="a number from 0.001 block_m to 0.45 block_m"
    )
    rays: int = setting(241, "Rays of one observation, left to right.", minimum=2, maximum=10_000)
    field_of_view_deg: float = setting(
        300.0, "Angle from the first ray to the last, straight ahead in the middle.", minimum=1.0, maximum=360.0
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_maze_size(self.rows, self.cols, self.extra_openings)
        check_aliased(self.aliased, self.rows, self.cols, self.extra_openings)
        _check_number("thrust_m", self.thrust_m, 0.0, self.block_m)
        _check_number("radius_m", self.radius_m, 0.001 * self.block_m, 0.45 * self.block_m)


class Maze2D(gymnasium.Env[npt.NDArray[np.float32], np.int64]):
    """Drive through a Prim maze seen in one row.

    Observations are float32 (rays, 4): red, green and blue in [0, 1] and depth in m of the wall that a ray
    hits; ray 0 is the leftmost (+150 degrees), the last the rightmost. Actions are `ngo_sim.drivers.Action`.
    The reward is the distance travelled in the step in m; episodes never end by themselves. info has
    "pose_xyyaw", float64 (3,) in the maze's frame (m, m, rad in [-pi, pi], counter-clockwise), and "time_s"
    since the reset.

    reset(seed=s) makes maze, colours, start and noise functions of s and the config, to the byte; without a
    seed they follow from what was drawn before. Options of reset: "maze" (a Maze of the config's size) and
    "pose_xyyaw" (3,) replace what is drawn, "maze_seed" takes maze and colours of another seed; start and noise remain
    those of s.
    """

    observation_space: gymnasium.spaces.Box[np.float32]

    def __init__(self, config: Maze2DConfig | None = None) -> None:
        self.config = config if config is not None else Maze2DConfig()
        self.period_s = self.config.period_s
        self.maze: Maze
        self.colors: npt.NDArray[np.float32]
        self.action_space = gymnasium.spaces.Discrete(len(Action))
        far = math.hypot(2 * self.config.rows + 1, 2 * self.config.cols + 1) * self.config.block_m
        high = np.tile(np.array([1.0, 1.0, 1.0, far], dtype=np.float32), (self.config.rays, 1))
        self.observation_space = gymnasium.spaces.Box(np.zeros_like(high), high, dtype=np.float32)
        half = math.radians(self.config.field_of_view_deg) / 2
        self.ray_angles_rad = np.linspace(half, -half, self.config.rays)
        self._ray_cos, self._ray_sin = np.cos(self.ray_angles_rad), np.sin(self.ray_angles_rad)
        self._space: pymunk.Space | None = None
        self._body: pymunk.Body
        self._x, self._y, self._yaw = 0.0, 0.0, 0.0
        self._velocity_m = (0.0, 0.0)  # a step
        self._turn_rate_rad = 0.0  # a step
        self._frame = 0
        self.blocked = False
        """Whether a wall stopped the robot in the last `drive`."""

    @property
    def limits(self) -> VelocityLimits:
        """Speeds and accelerations that actions give without noise, which hold for `drive` as well."""
        config, period = self.config, self.config.period_s
        speed_m, turn_rad = config.travel_decay * config.thrust_m, config.turn_decay * math.radians(config.turn_deg)
        return VelocityLimits(
            speed_m / (1.0 - config.travel_decay) / period,
            turn_rad / (1.0 - config.turn_decay) / period,
            speed_m / period**2,
            turn_rad / period**2,
        )

    @property
    def default_driver(self) -> str:
        """Who drives where nobody is named."""
        return "corners"

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Draw a maze, colours and a start, standing still; see the class for the options."""
        super().reset(seed=seed)
        options = options or {}
        if unknown := sorted(set(options) - {"maze", "maze_seed", "pose_xyyaw"}):
            raise ValueError(f"options has {unknown}; it may have 'maze', 'maze_seed' and 'pose_xyyaw'")
        config, rng = self.config, self.np_random
        # Everything is drawn even where an option replaces it, so that an option changes nothing else.
        drawn, self.colors = self._drawn(rng)
        if "maze_seed" in options:
            drawn, self.colors = self._drawn(np_random(int(options["maze_seed"]))[0])
        self.maze = options.get("maze", drawn)
        if self.maze.walls.shape != drawn.walls.shape or self.maze.block_m != drawn.block_m:
            raise ValueError(
                f"options['maze'] has {self.maze.walls.shape} blocks of {self.maze.block_m} m; "
                f"the config asks for {drawn.walls.shape} blocks of {drawn.block_m} m"
            )
        start_cell = 2 * rng.integers((config.rows, config.cols)) + 1
        start = (*self.maze.block_center(start_cell), rng.uniform(-math.pi, math.pi))
        self._place_body(*self._checked_pose(options.get("pose_xyyaw", start)))
        self._velocity_m, self._turn_rate_rad, self._frame = (0.0, 0.0), 0.0, 0
        self.blocked = False
        return self._scan(), self._info()

    def step(self, action: np.int64 | int) -> tuple[npt.NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Take one of the three actions and let period_s pass.

        Raises ValueError for another action, RuntimeError before the first reset.
        """
        if self._space is None:
            raise RuntimeError("step() before reset()")
        if action not in _THRUST:
            raise ValueError(f"action is {action!r}; it must be 0 (forward), 1 (turn left) or 2 (turn right)")
        config = self.config
        strength = 1.0 + config.actuation_noise * self.np_random.standard_normal()
        thrust = strength * config.thrust_m * _THRUST[int(action)]
        velocity_x, velocity_y = self._velocity_m
        velocity_x = config.travel_decay * (velocity_x + thrust * math.cos(self._yaw))
        velocity_y = config.travel_decay * (velocity_y + thrust * math.sin(self._yaw))
        turn = strength * math.radians(config.turn_deg) * _TURN[int(action)]
        self._turn_rate_rad = config.turn_decay * (self._turn_rate_rad + turn)
        self._velocity_m = self._move_body(self._space, velocity_x, velocity_y)
        last_x, last_y = self._x, self._y
        observation, info = self._next_frame()
        return observation, math.hypot(self._x - last_x, self._y - last_y), False, False, info

    def drive(self, speed_mps: float, turn_rate_rps: float) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        """Let period_s pass at this speed along the heading and turn rate; a wall that is met stops the robot.

        Returns observation and info as `step` does. Raises RuntimeError before the first reset.
        """
        if self._space is None:
            raise RuntimeError("drive() before reset()")
        period = self.config.period_s
        self._turn_rate_rad = turn_rate_rps * period
        heading = self._yaw + self._turn_rate_rad / 2
        way = speed_mps * period
        left_x, left_y = self._move_body(self._space, way * math.cos(heading), way * math.sin(heading))
        self.blocked = math.hypot(left_x, left_y) < (1.0 - _BLOCKED_SHARE) * abs(way)
        self._velocity_m = (0.0, 0.0) if self.blocked else (left_x, left_y)
        return self._next_frame()

    def _next_frame(self) -> tuple[npt.NDArray[np.float32], dict[str, Any]]:
        self._x, self._y = self._body.position
        self._yaw = math.remainder(self._body.angle, math.tau)
        self._frame += 1
        return self._scan(), self._info()

    def _drawn(self, rng: np.random.Generator) -> tuple[Maze, npt.NDArray[np.float32]]:
        """A maze, and the colours (height, width, 3) of its blocks."""
        config = self.config
        if config.aliased:
            maze = repeated_maze(config.rows, config.cols, rng, config.block_m)
            return maze, np.tile(rng.random(3, dtype=np.float32), (*maze.walls.shape, 1))
        maze = prim_maze(config.rows, config.cols, rng, config.extra_openings, config.block_m)
        return maze, rng.random((*maze.walls.shape, 3), dtype=np.float32)

    def _move_body(self, space: pymunk.Space, velocity_x: float, velocity_y: float) -> tuple[float, float]:
        """Let period_s pass at this velocity (m a step); return the velocity that collisions leave of it."""
        config, body = self.config, self._body
        speed = math.hypot(velocity_x, velocity_y)
        substeps = max(1, math.ceil(speed / (_SUBSTEP_RADII * config.radius_m)))
        substep_s = config.period_s / substeps
        body.velocity = (velocity_x / config.period_s, velocity_y / config.period_s)
        body.angular_velocity = self._turn_rate_rad / config.period_s
        for _ in range(substeps):
            space.step(substep_s)
        left = body.velocity
        # A substep that finds the body inside a wall leaves it to the next one to take it out. So let it rest
        # until nothing moves it any more; between walls that face each other this takes several substeps.
        for _ in range(_SETTLING_SUBSTEPS):
            position = body.position
            body.velocity, body.angular_velocity = (0.0, 0.0), 0.0
            space.step(substep_s)
            if body.position == position:
                break
        return left.x * config.period_s, left.y * config.period_s

    def _scan(self) -> npt.NDArray[np.float32]:
        scan = np.empty((self.config.rays, 4), dtype=np.float32)
        cast_rays(
            self.maze.walls,
            self.config.block_m,
            self._x,
            self._y,
            self._yaw,
            self._ray_cos,
            self._ray_sin,
            self.colors,
            scan,
        )
        return scan

    def _info(self) -> dict[str, Any]:
        return {"pose_xyyaw": np.array((self._x, self._y, self._yaw)), "time_s": self._frame * self.period_s}

    def _checked_pose(self, pose_xyyaw: npt.ArrayLike) -> tuple[float, float, float]:
        """The pose as floats; ValueError where the body would touch a wall."""
        pose = np.asarray(pose_xyyaw, dtype=np.float64)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ValueError(f"pose_xyyaw is {pose_xyyaw!r}; it must be three finite numbers")
        x, y, yaw = pose.tolist()
        wall = np.argwhere(self.maze.walls)[:, ::-1] * self.config.block_m
        nearest = np.clip(pose[:2], wall, wall + self.config.block_m)
        gap = np.linalg.norm(pose[:2] - nearest, axis=1).min()
        if self.maze.walls[self.maze.block_at(x, y)] or gap < self.config.radius_m:
            raise ValueError(
                f"pose_xyyaw is {[x, y, yaw]}; it must be {self.config.radius_m} m or more from every wall"
            )
        return x, y, yaw

    def _place_body(self, x: float, y: float, yaw: float) -> None:
        # A new space each time: nothing that an earlier episode left in the solver can reach this one.
        space = pymunk.Space()
        space.collision_slop = _COLLISION_SLOP_M
        space.collision_bias = 0.0  # take all of an overlap back in the next substep
        walls = [
            pymunk.Segment(space.static_body, start, end, 0.0) for start, end in self.maze.wall_segments().tolist()
        ]
        self._body = pymunk.Body(mass=1.0, moment=math.inf)
        self._body.position = (x, y)
        self._body.angle = yaw
        disc = pymunk.Circle(self._body, self.config.radius_m)
        disc.friction = disc.elasticity = 0.0
        space.add(self._body, disc, *walls)
        self._space = space
        self._x, self._y, self._yaw = x, y, math.remainder(yaw, math.tau)


def _check_number(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise ValueError(f"{name} is {value!r}; it must be a number from {low:g} to {high:g}")
