"""Maps drawn by hand, and a robot in them that sees all around without errors."""

import math
from collections.abc import Callable

import numpy as np

from ngo_explorer.exploration import Exploration
from ngo_explorer.path_follower import PathFollower
from ngo_explorer.pilot import DONE, Pilot
from ngo_explorer.settings import DriveConfig, ExplorerConfig

RESOLUTION_M = 0.1


def drawn(*rows: str, cells: int = 1) -> np.ndarray:
    """Values of a map: # occupied, . free, ? unknown; the first line is the highest in y, a sign is ``cells`` wide."""
    signs = {"#": 100, ".": 0, "?": -1}
    values = np.array([[signs[sign] for sign in row] for row in rows], np.int8)[::-1]
    return values.repeat(cells, axis=0).repeat(cells, axis=1)


def seen_from(truth: np.ndarray, known: np.ndarray, x: float, y: float) -> None:
    """Enter into ``known`` what rays from a point see of ``truth``."""
    angles, along = np.linspace(0.0, math.tau, 720, endpoint=False)[:, None], 0.05 * np.arange(2 * max(truth.shape))
    rows = ((y + along * np.sin(angles)) / RESOLUTION_M).astype(int).clip(0, truth.shape[0] - 1)
    columns = ((x + along * np.cos(angles)) / RESOLUTION_M).astype(int).clip(0, truth.shape[1] - 1)
    ends = np.argmax(truth[rows, columns] == 100, axis=1)[:, None]
    seen = np.arange(len(along)) <= ends
    known[rows[seen], columns[seen]] = truth[rows[seen], columns[seen]]


def explore(
    truth: np.ndarray,
    start_xy: tuple[float, float],
    config: ExplorerConfig | None = None,
    boundary: np.ndarray | None = None,
    glass: np.ndarray | None = None,
    change: Callable[[np.ndarray, float, np.ndarray], None] = lambda *_: None,
) -> tuple[Exploration, np.ndarray, list[np.ndarray]]:
    """Explore a map to the end; returns the exploration, what is known then, and where the robot was.

    glass: what its scans show nearby, beside what the map has. change: changes the truth ``(rows, columns)``, by the
    time and the robot's pose ``(3,)``.
    """
    config = config or ExplorerConfig(radius_m=0.2)
    exploration = Exploration(config, boundary)
    known = np.full_like(truth, -1)
    follower = PathFollower(DriveConfig(), config)
    pilot, robot, way = Pilot(exploration, follower, 0.5, None), np.array((*start_xy, 0.0)), []
    truth = truth.copy()
    for step in range(6000):
        change(truth, 0.1 * step, robot)
        if step % 5 == 0:
            seen_from(truth, known, robot[0], robot[1])
            exploration.known.update(known, RESOLUTION_M, np.zeros(2))
        pilot.step(robot, 0.1 * step)
        if pilot.state == DONE:
            return exploration, known, way
        if glass is not None:
            x, y = (np.argwhere(glass == 100)[:, ::-1] + 0.5).T * RESOLUTION_M - robot[:2, None]
            cos, sin = math.cos(robot[2]), math.sin(robot[2])
            follower.look(np.column_stack((cos * x + sin * y, cos * y - sin * x)), 0.1 * step)
        speed, turn_rate = follower.step(exploration.known, robot, 0.1 * step)
        heading = robot[2] + 0.05 * turn_rate
        robot = robot + 0.1 * np.array((speed * math.cos(heading), speed * math.sin(heading), turn_rate))
        way.append(robot)
    raise AssertionError("the exploration did not end")
