"""One run of a world under a driver or under actions from outside: what a simulator node publishes, without ROS."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ngo_sim.driver_choice import driver_generator, make_driver
from ngo_sim.drivers import Action, Driver
from ngo_sim.external_actions import ExternalActions
from ngo_sim.maze2d import Maze2D
from ngo_sim.mazes import Maze
from ngo_sim.velocity_command import VelocityCommand


class World(Protocol):
    """What Maze2D and Maze3D have in common."""

    period_s: float

    @property
    def maze(self) -> Maze | None:
        """The plan, None where there is none."""
        ...

    @property
    def default_driver(self) -> str:
        """Who drives where nobody is named."""
        ...

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin anew."""
        ...

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one action."""
        ...

    def close(self) -> None:
        """Free what the world holds."""
        ...


@dataclass(frozen=True)
class Frame:
    """What the robot sees at one moment and where it then is.

    index: number of the frame, from 0. observation: of the world's shape and type. pose_xyyaw: float64 (3,) in the
    maze's frame. twist_xyyaw: float64 (3,), the constant velocity in the robot's own frame (m/s, m/s, rad/s) that
    leads from the previous frame to this one; zero in frame 0, where the robot rests.
    """

    index: int
    observation: npt.NDArray[Any]
    pose_xyyaw: npt.NDArray[np.float64]
    twist_xyyaw: npt.NDArray[np.float64]


class Simulation:
    """Frame after frame of one seed.

    driver: a name for make_driver, "auto": the world's own choice, "none": only actions from outside move it, or
    "cmd_vel": only velocities from outside do, each for velocity_timeout_s.
    maze_seed: seed of the maze and its textures, where it is another one. Raises ValueError where there is no maze, and
    for "cmd_vel" in a world that takes actions alone.
    """

    def __init__(
        self, world: World, seed: int, driver: str, maze_seed: int | None = None, velocity_timeout_s: float = 0.5
    ) -> None:
        self.world = world
        self.external = ExternalActions()
        observation, info = world.reset(seed=seed, options=None if maze_seed is None else {"maze_seed": maze_seed})
        name = world.default_driver if driver == "auto" else driver
        outside = name in ("none", "cmd_vel")
        self._driver: Driver | None = None if outside else make_driver(name, world.maze, driver_generator(seed))
        self.velocity: VelocityCommand | None = None
        """The newest velocity from outside, where such ones drive."""
        if name == "cmd_vel":
            if not isinstance(world, Maze2D):
                raise ValueError("driver is 'cmd_vel', which maze2d alone takes")
            self.velocity = VelocityCommand(world.limits, velocity_timeout_s)
        self._commanded = np.zeros(2)
        self.frame = Frame(0, observation, info["pose_xyyaw"], np.zeros(3))

    def choose_action(self, now_s: float, timeout_s: float, hold: bool) -> Action | None:
        """The action at this frame, to be asked for once a frame; None where it has to come from outside and has not.

        See ExternalActions for now_s (any steady clock), timeout_s and hold.
        """
        # The driver sees every frame, also those it does not decide: it keeps track of where it is on its path.
        frame, driver = self.frame, self._driver
        own = None if driver is None else driver.action(frame.pose_xyyaw, frame.observation)
        return self.external.next_action(hold) if self.external.in_charge(now_s, timeout_s, hold) else own

    def ready(self, now_s: float, timeout_s: float, hold: bool) -> bool:
        """Whether choose_action would give an action, or the robot drives by velocities."""
        if self.velocity is not None:
            return True
        if self.external.in_charge(now_s, timeout_s, hold):
            return self.external.pending()
        return self._driver is not None

    def advance(self, action: Action) -> Frame:
        """Take the action; return the next frame, which also becomes `frame`."""
        observation, _, _, _, info = self.world.step(int(action))
        return self._taken(observation, info)

    def drive(self) -> tuple[Frame, bool]:
        """Drive on by the newest velocity; return the next frame, and whether a wall stopped the robot."""
        world = self.world
        assert self.velocity is not None and isinstance(world, Maze2D)
        self._commanded = self.velocity.next_twist(self._commanded, world.period_s)
        observation, info = world.drive(*self._commanded.tolist())
        if world.blocked:
            self._commanded[0] = 0.0
        return self._taken(observation, info), world.blocked

    def _taken(self, observation: npt.NDArray[Any], info: dict[str, Any]) -> Frame:
        pose = info["pose_xyyaw"]
        twist = body_twist(self.frame.pose_xyyaw, pose, self.world.period_s)
        self.frame = Frame(self.frame.index + 1, observation, pose, twist)
        return self.frame


def body_twist(
    from_xyyaw: npt.NDArray[np.float64], to_xyyaw: npt.NDArray[np.float64], period_s: float
) -> npt.NDArray[np.float64]:
    """float64 (3,): the constant velocity in the moving frame (m/s, m/s, rad/s) that leads from one pose to the other.

    The logarithm of the relative pose over the time; the turn must be below half a revolution.
    """
    turn = math.remainder(to_xyyaw[2] - from_xyyaw[2], math.tau)
    cos, sin = math.cos(from_xyyaw[2]), math.sin(from_xyyaw[2])
    dx, dy = to_xyyaw[0] - from_xyyaw[0], to_xyyaw[1] - from_xyyaw[1]
    forward, left = cos * dx + sin * dy, cos * dy - sin * dx
    # half / tan(half) tends to 1 - half^2 / 3 where the quotient itself is 0 / 0.
    half = turn / 2
    stretch = half / math.tan(half) if abs(half) > 1e-6 else 1.0 - half * half / 3
    return np.array([stretch * forward + half * left, stretch * left - half * forward, turn]) / period_s


def yaw_quaternion_zw(yaw: float) -> tuple[float, float]:
    """The z and w of the quaternion of a turn about +z; its x and y are 0."""
    return math.sin(yaw / 2), math.cos(yaw / 2)


def inverse_pose(pose_xyyaw: npt.NDArray[np.float64]) -> tuple[float, float, float]:
    """The pose (x, y, yaw) of a frame's parent, seen from the frame that has pose (3,) in it."""
    x, y, yaw = pose_xyyaw.tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    return -cos * x - sin * y, sin * x - cos * y, -yaw
