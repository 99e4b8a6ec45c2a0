"""The polygon within which a place is explored."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ngo_explorer.known_map import UNKNOWN, Floats, KnownMap


class Boundary:
    """A polygon ``(n, 2)``, or everywhere: without corners. Raises ValueError for one or two corners."""

    def __init__(self, corners_xy: Floats | None = None) -> None:
        if corners_xy is not None and not (
            corners_xy.ndim == 2 and corners_xy.shape[1] == 2 and len(corners_xy) >= 3 and np.isfinite(corners_xy).all()
        ):
            raise ValueError(f"the boundary has corners {corners_xy.tolist()}; expected three or more finite points")
        self._corners = corners_xy
        self._mask: tuple[tuple[object, ...], NDArray[np.bool_]] | None = None

    def holds(self, point_xy: Floats) -> bool:
        """Whether a point is inside."""
        return self._corners is None or bool(_inside(self._corners, np.asarray(point_xy)[None, :2])[0])

    def known_m2(self, known: KnownMap) -> float:
        """Known area inside."""
        if self._corners is None or known.empty:
            return 0.0 if known.empty else known.known_m2
        extent = (known.state.shape, *known.corner_xy.tolist())
        if self._mask is None or self._mask[0] != extent:
            cells = np.indices(known.state.shape).reshape(2, -1).T
            self._mask = extent, _inside(self._corners, known.points(cells)).reshape(known.state.shape)
        return float(np.count_nonzero(self._mask[1] & (known.state != UNKNOWN))) * known.resolution_m**2


def _inside(corners: Floats, points: Floats) -> NDArray[np.bool_]:
    """Whether points ``(n, 2)`` are inside: a ray to the right crosses an odd number of sides."""
    inside = np.zeros(len(points), np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if y0 == y1:
            continue
        crosses = (y0 > points[:, 1]) != (y1 > points[:, 1])
        inside ^= crosses & (points[:, 0] < x0 + (points[:, 1] - y0) * (x1 - x0) / (y1 - y0))
    return inside
