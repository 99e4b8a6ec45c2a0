"""Simulated 2D lidars: mazes of random width and pace, seen by lidars of random geometry and quality.

Estimators are measured on these mazes, and nothing is trained on them.

Everything random follows from the maze's seed, so an episode is the same wherever it is simulated.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from ngo_estimator.data.images import ImageFormat, scan_image
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.mazes import Maze

_CAST_RAYS = 721  # of the simulated scanner before its own rays are chosen: half a degree from one to the next
_DRAWN, _NOISE = 7, 8  # numbers of the random generators of an episode, none of them the driver's

CONDITIONS: dict[str, dict[str, Any]] = {
    "as drawn in training": {},
    "noise 0 cm": {"noise_m": 0.0},
    "noise 1 cm": {"noise_m": 0.01},
    "noise 3 cm": {"noise_m": 0.03},
    "noise 5 cm": {"noise_m": 0.05},
    "dropouts 0 %": {"dropout": 0.0},
    "dropouts 5 %": {"dropout": 0.05},
    "dropouts 20 %": {"dropout": 0.2},
    "noise 5 cm, dropouts 20 %": {"noise_m": 0.05, "dropout": 0.2},
    "field of view 180 deg": {"field_of_view_deg": 180.0},
    "field of view 360 deg": {"field_of_view_deg": 360.0},
    "range 4 m": {"range_max_m": 4.0},
}
"""Conditions of the tables by name: what they change of the scanner that is drawn."""


@dataclass(frozen=True)
class Scanner:
    """A 2D lidar that looks straight ahead.

    ``every`` and ``first`` choose its rays among those cast, ``field_of_view_deg`` is centred straight ahead,
    ``noise_m`` the standard deviation of a range, ``dropout`` the share of rays without a return, ``range_max_m`` the
    distance from which on nothing returns.
    """

    every: int = 2
    first: int = 0
    field_of_view_deg: float = 360.0
    noise_m: float = 0.0
    dropout: float = 0.0
    range_max_m: float = 30.0

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Scanner:
        """A scanner of the tables: what it sees varies from maze to maze."""
        every = int(rng.integers(1, 5))
        return cls(
            every=every,
            first=int(rng.integers(every)),
            field_of_view_deg=360.0 if rng.random() < 0.3 else float(rng.uniform(180.0, 360.0)),
            noise_m=float(rng.uniform(0.0, 0.03)),
            dropout=float(rng.uniform(0.0, 0.05)),
            range_max_m=float(np.exp(rng.uniform(math.log(4.0), math.log(30.0)))),
        )


SCAN_IMAGE = ImageFormat(
    height=1, width=289, channels=1, dtype="float32", field_of_view_deg=360.0, depth_gain_m=1.5, depth_softening_m=0.75
)
"""A format of scans that covers all directions, as networks for scanners of any geometry take it."""

ROWS = (4, 7)
"""Range of the rows of a table's mazes, both ends included."""


def drawn_config(rng: np.random.Generator, size: Mapping[str, Any]) -> Maze2DConfig:
    """Corridors 0.8 to 2.5 m wide, and a robot in proportion that drives slowly or fast."""
    block_m = float(np.exp(rng.uniform(math.log(0.8), math.log(2.5))))
    usual = Maze2DConfig()
    return Maze2DConfig(
        **size,
        block_m=block_m,
        radius_m=usual.radius_m * block_m,
        thrust_m=usual.thrust_m * block_m * float(rng.uniform(0.4, 1.1)),
        turn_deg=usual.turn_deg * float(rng.uniform(0.6, 1.15)),
        rays=_CAST_RAYS,
        field_of_view_deg=360.0,
    )


class ScannedMaze(gymnasium.Env[Any, Any]):
    """A Maze2D of drawn width and pace, observed as ``(width,)`` depths of a scan's format.

    ``size`` are fields of ``Maze2DConfig``, ``changes`` replace fields of the scanner that is drawn. Every reset needs
    a seed, of which all that is drawn is a function.
    """

    def __init__(
        self, image: ImageFormat, size: Mapping[str, Any] | None = None, changes: Mapping[str, Any] | None = None
    ) -> None:
        self._image, self._size, self._changes = image, size or {}, changes or {}
        self.scanner: Scanner
        self._world: Maze2D
        self.period_s = Maze2DConfig().period_s
        self.observation_space = gymnasium.spaces.Box(0.0, np.inf, (image.width,), np.float32)
        self.action_space = Maze2D().action_space

    @property
    def maze(self) -> Maze:
        """The maze of the episode."""
        return self._world.maze

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin the episode of ``seed``; options are those of ``Maze2D``."""
        if seed is None:
            raise ValueError("reset() without a seed; expected one, from which width, pace and scanner are drawn")
        rng = np.random.default_rng((seed, _DRAWN))
        self._world = Maze2D(drawn_config(rng, self._size))
        self.scanner = dataclasses.replace(Scanner.drawn(rng), **self._changes)
        self._noise = np.random.default_rng((seed, _NOISE))
        observation, info = self._world.reset(seed=seed, options=options)
        return self._scan(observation), info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """As ``Maze2D.step``."""
        observation, *rest, info = self._world.step(action)
        return self._scan(observation), *rest, info  # type: ignore[return-value]

    def rays(self, observation: np.ndarray) -> tuple[np.ndarray, float, float]:
        """What the scanner measures: its ranges ``(rays,)``, the angle of the first and the step to the next."""
        scanner, angles = self.scanner, self._world.ray_angles_rad
        half = math.radians(scanner.field_of_view_deg) / 2.0 + 1e-9
        # A ray straight back is cast twice, as the first and the last.
        chosen = np.arange(scanner.first, len(angles) - 1, scanner.every)
        chosen = chosen[np.abs(angles[chosen]) <= half]
        depth = observation[chosen, 3]
        ranges = depth + scanner.noise_m * self._noise.standard_normal(len(depth))
        lost = (depth > scanner.range_max_m) | (self._noise.random(len(depth)) < scanner.dropout)
        step = float(angles[1] - angles[0]) * scanner.every
        return np.where(lost, np.inf, ranges), float(angles[chosen[0]]), step

    def _scan(self, observation: np.ndarray) -> np.ndarray:
        ranges, first, step = self.rays(observation)
        return scan_image(self._image, ranges, first, step, 0.0, math.inf).reshape(-1)
