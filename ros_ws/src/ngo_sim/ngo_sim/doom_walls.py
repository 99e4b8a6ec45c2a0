"""How far the walls of a Doom level are at the height of the eye: what a horizontal scanner there would measure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

from ngo_sim.doom_map import UNITS_PER_M

Floats = npt.NDArray[np.float64]


def walls_at(sectors: Iterable[Any], eye_z: float) -> Floats:
    """Segments ``(n, 4)`` (x, y, x, y, m) of the walls at a height, in map units, among ViZDoom's sectors as they are.

    A line of one sector is a wall. One between two is a wall where the floor or the ceiling of either is in the way.
    """
    opening: dict[tuple[float, float, float, float], tuple[float, float, int]] = {}
    for sector in sectors:
        for line in sector.lines:
            ends, back = (line.x1, line.y1, line.x2, line.y2), (line.x2, line.y2, line.x1, line.y1)
            ends = back if back in opening else ends
            floor, ceiling, sides = opening.get(ends, (-np.inf, np.inf, 0))
            opening[ends] = max(floor, sector.floor_height), min(ceiling, sector.ceiling_height), sides + 1
    blocked = [
        ends for ends, (floor, ceiling, sides) in opening.items() if sides < 2 or not floor < eye_z < ceiling
    ]  # fmt: skip
    return np.array(blocked, dtype=np.float64).reshape(-1, 4) / UNITS_PER_M


def wall_ranges(walls: Floats, pose_xyyaw: Floats, angles_rad: Floats) -> npt.NDArray[np.float32]:
    """Distances ``(rays,)`` (m) of the first of ``walls`` along rays from a pose ``(3,)``; infinite where none is."""
    heading = pose_xyyaw[2] + angles_rad[:, None]
    along_x, along_y = np.cos(heading), np.sin(heading)
    from_x, from_y = walls[:, 0] - pose_xyyaw[0], walls[:, 1] - pose_xyyaw[1]
    wall_x, wall_y = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        across = along_x * wall_y - along_y * wall_x
        far = (from_x * wall_y - from_y * wall_x) / across
        share = (from_x * along_y - from_y * along_x) / across
        hit = (far > 0.0) & (share >= -1e-9) & (share <= 1.0 + 1e-9)
    found: npt.NDArray[np.float32] = np.where(hit, far, np.inf).min(axis=1, initial=np.inf).astype(np.float32)
    return found
