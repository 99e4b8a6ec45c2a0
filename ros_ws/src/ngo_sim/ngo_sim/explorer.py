"""A driver that covers ground without a plan: it remembers where it has been and what it bumped into."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from ngo_sim.drivers import Action

Cell = tuple[int, int]

_CELL_M = 1.5
_DIRECTIONS = 16
_SIGHT_CELLS = 5
_LEG_M = 12.0  # after which it looks for something newer than straight on
_DEADBAND_RAD = math.radians(4.5)
_TURN_COAST_STEPS = 1.2  # as that of the drivers with a plan
# For so long a door opens to who stands before it; at a wall it is time lost.
_PATIENCE_STEPS = 18
_STUCK_M = 1.0
_RANDOM_LEG_PROBABILITY = 0.05
_AROUND = [(row, col) for row in (-1, 0, 1) for col in (-1, 0, 1) if (row, col) != (0, 0)]


class ExploringDriver:
    """Drives straight legs into cells of 1.5 m that it does not know, until it bumps; goes back where nothing is new.

    Of 16 directions it takes one that leads to unknown cells soon and needs little turning; chance breaks ties and now
    and then takes any. Where all around is known it follows its own steps, by the fewest cells, to one that has
    unknown ones beside it. It bumps where it wants to go forward and gets nowhere for 18 steps, a second of the 3D
    world; what lies ahead then counts as blocked, until nothing else is left and all blocks are forgotten.

    visited: where it first was in each cell, m. blocked: cells that it bumped into.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.visited: dict[Cell, tuple[float, float]] = {}
        self.blocked: set[Cell] = set()
        self._steps_between: dict[Cell, set[Cell]] = {}
        self._path: deque[Cell] = deque()
        self._heading: float | None = None
        self._leg_begin = (0.0, 0.0)
        self._last_cell: Cell | None = None
        self._last_yaw: float | None = None
        self._trail: deque[tuple[float, float]] = deque(maxlen=_PATIENCE_STEPS)

    def action(self, pose_xyyaw: npt.NDArray[np.float64], observation: npt.NDArray[Any] | None = None) -> Action:
        """The action to take at pose_xyyaw (3,) in a fixed frame; observation is not looked at."""
        x, y, yaw = pose_xyyaw.tolist()
        turned = 0.0 if self._last_yaw is None else _wrap(yaw - self._last_yaw)
        self._last_yaw = yaw
        cell = _cell_at(x, y)
        self._remember(cell, x, y)
        if self._stuck(x, y):
            self._bump(cell, x, y)
        heading = self._wanted_heading(cell, x, y, yaw)
        error = _wrap(heading - yaw - _TURN_COAST_STEPS * turned)
        if abs(error) > _DEADBAND_RAD:
            self._trail.clear()
            return Action.TURN_LEFT if error > 0 else Action.TURN_RIGHT
        self._trail.append((x, y))
        return Action.FORWARD

    def _remember(self, cell: Cell, x: float, y: float) -> None:
        self.visited.setdefault(cell, (x, y))
        self.blocked.discard(cell)
        if self._last_cell is not None and self._last_cell != cell:
            self._steps_between.setdefault(self._last_cell, set()).add(cell)
            self._steps_between.setdefault(cell, set()).add(self._last_cell)
        self._last_cell = cell

    def _stuck(self, x: float, y: float) -> bool:
        if len(self._trail) < _PATIENCE_STEPS:
            return False
        return math.hypot(x - self._trail[0][0], y - self._trail[0][1]) < _STUCK_M

    def _bump(self, cell: Cell, x: float, y: float) -> None:
        """What was aimed at is blocked: a step back along its own path, or the next cell ahead that it never was in."""
        self._trail.clear()
        if self._path:
            self._steps_between.get(cell, set()).discard(self._path[0])
            self._path.clear()
        elif self._heading is not None:
            self.blocked.update(set(self._ahead(cell, x, y, self._heading)[:1]) - self.visited.keys())
        self._heading = None

    def _wanted_heading(self, cell: Cell, x: float, y: float, yaw: float) -> float:
        while self._path and (cell == self._path[0] or _near(self.visited[self._path[0]], x, y)):
            self._path.popleft()
            self._heading = None
        if self._path:
            to_x, to_y = self.visited[self._path[0]]
            return math.atan2(to_y - y, to_x - x)
        over = math.hypot(x - self._leg_begin[0], y - self._leg_begin[1]) > _LEG_M
        if self._heading is None or over:
            self._choose(cell, x, y, yaw)
            return self._wanted_heading(cell, x, y, yaw) if self._path else _given(self._heading)
        return self._heading

    def _choose(self, cell: Cell, x: float, y: float, yaw: float) -> None:
        """A new leg, or a path to where one can begin."""
        self._leg_begin = (x, y)
        headings = yaw + np.arange(_DIRECTIONS) * math.tau / _DIRECTIONS
        if self._rng.random() < _RANDOM_LEG_PROBABILITY:
            self._heading = float(self._rng.choice(headings))
            return
        scores = [self._worth(cell, x, y, heading) for heading in headings.tolist()]
        if max(scores) > 0.0:
            turns = np.abs(np.remainder(headings - yaw + math.pi, math.tau) - math.pi)
            chances = 0.3 * self._rng.random(_DIRECTIONS)
            self._heading = float(headings[np.argmax(np.array(scores) - 0.4 * turns / math.pi + chances)])
            return
        self._path = self._way_to_unknown(cell)
        if not self._path:
            self.blocked.clear()
            self._heading = float(self._rng.choice(headings))

    def _worth(self, cell: Cell, x: float, y: float, heading: float) -> float:
        """The unknown cells on a straight leg, the near ones more; none where the first of them is blocked."""
        worth = 0.0
        for distance, ahead in enumerate(self._ahead(cell, x, y, heading), start=1):
            if ahead in self.blocked:
                break
            worth += (ahead not in self.visited) / distance
        return worth

    def _ahead(self, cell: Cell, x: float, y: float, heading: float) -> list[Cell]:
        """The cells that a straight leg of _SIGHT_CELLS comes through, near ones first."""
        cells: list[Cell] = []
        dx, dy = math.cos(heading), math.sin(heading)
        for step in range(1, 2 * _SIGHT_CELLS + 1):
            ahead = _cell_at(x + 0.5 * step * _CELL_M * dx, y + 0.5 * step * _CELL_M * dy)
            if ahead != cell and ahead not in cells:
                cells.append(ahead)
        return cells

    def _way_to_unknown(self, cell: Cell) -> deque[Cell]:
        """The fewest cells to one beside which there is an unknown one; empty where there is none."""
        came_from: dict[Cell, Cell] = {cell: cell}
        todo = deque([cell])
        while todo:
            here = todo.popleft()
            if here != cell and self._open_beside(here):
                path: deque[Cell] = deque()
                while here != cell:
                    path.appendleft(here)
                    here = came_from[here]
                return path
            for there in sorted(self._steps_between.get(here, ())):
                if there not in came_from:
                    came_from[there] = here
                    todo.append(there)
        return deque()

    def _open_beside(self, cell: Cell) -> bool:
        beside = [(cell[0] + row, cell[1] + col) for row, col in _AROUND if row == 0 or col == 0]
        return any(one not in self.visited and one not in self.blocked for one in beside)


def _cell_at(x: float, y: float) -> Cell:
    return math.floor(y / _CELL_M), math.floor(x / _CELL_M)


def _near(point: tuple[float, float], x: float, y: float) -> bool:
    return math.hypot(point[0] - x, point[1] - y) < 0.3 * _CELL_M


def _given(heading: float | None) -> float:
    assert heading is not None
    return heading


def _wrap(angle: float) -> float:
    return math.remainder(angle, math.tau)
