"""Floor plans from files: the maps that a map server reads, as buildings without furniture, doors and glass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, label

from ngo_common.map_files import read_map_file
from ngo_sim.convex_shapes import Floats
from ngo_sim.floor_plans import Doors, FloorPlan
from ngo_sim.mazes import wall_segments

_BORDER_M = 0.5  # around the image, so that no scanner stands on the edge of the world
_GOAL_CLEARANCE_M = 0.45
_AREA_A_GOAL_M2 = 15.0
_MOST_GOALS = 300


def read_floor_plan(description: Path, seed: int) -> FloorPlan:
    """The building of a map server's map: walls around all cells that are not free. The seed draws the goals.

    Its frame_xyyaw leads to the frame of the map, by the origin in the file. Raises ValueError for files that are no
    map, and for maps without a place for a robot; OSError where one cannot be read.
    """
    values, resolution, origin = read_map_file(description)
    border = int(np.ceil(_BORDER_M / resolution))
    walls = np.pad(values != 0, border, constant_values=True)
    segments = wall_segments(walls).reshape(-1, 4) * resolution
    if not len(segments):
        raise ValueError(f"{description}: no cell of the map is free")
    corner = border * resolution
    cos, sin = np.cos(origin[2]), np.sin(origin[2])
    frame = (origin[0] - corner * (cos - sin), origin[1] - corner * (sin + cos), origin[2])
    return FloorPlan(
        segments,
        np.zeros(len(segments), np.bool_),
        np.zeros((0, 3)),
        _no_doors(),
        _goals(walls, resolution, description, np.random.default_rng((seed, 0))),
        "file",
        frame,
    )


def _goals(walls: np.ndarray, resolution: float, description: Path, rng: np.random.Generator) -> Floats:
    """(g, 2) random points of the largest area that a robot can drive in."""
    areas, count = label(distance_transform_edt(~walls) * resolution >= _GOAL_CLEARANCE_M, np.ones((3, 3)))
    if count == 0:
        raise ValueError(f"{description}: no place of the map is {2 * _GOAL_CLEARANCE_M} m wide")
    cells = np.argwhere(areas == np.bincount(areas[areas > 0]).argmax())
    wanted = int(np.clip(len(cells) * resolution**2 / _AREA_A_GOAL_M2, 4, _MOST_GOALS))
    chosen = cells[rng.choice(len(cells), min(wanted, len(cells)), replace=False)]
    return np.asarray((chosen[:, ::-1] + 0.5) * resolution, np.float64)


def _no_doors() -> Doors:
    none = np.zeros(0)
    return Doors(np.zeros((0, 2)), none, none, none, np.zeros((0, 1)), none, none, none.astype(np.bool_))
