"""Convex polygons in the plane: whether they overlap, and the walls around a union of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numba import njit

Floats = npt.NDArray[np.float64]

# An edge within this distance of another polygon's boundary does not lie inside that polygon, m.
_ON_BOUNDARY_M = 1e-6
_SHORTEST_WALL_M = 1e-4


def rectangle(center: npt.ArrayLike, yaw_rad: float, length_m: float, width_m: float) -> Floats:
    """(4, 2) corners, counter-clockwise, of a rectangle with its length along yaw_rad."""
    along = np.array((np.cos(yaw_rad), np.sin(yaw_rad))) * length_m / 2
    across = np.array((-np.sin(yaw_rad), np.cos(yaw_rad))) * width_m / 2
    middle = np.asarray(center, dtype=np.float64)
    return np.array(
        (middle - along - across, middle + along - across, middle + along + across, middle - along + across)
    )


def lane(start: npt.ArrayLike, end: npt.ArrayLike, width_m: float) -> Floats:
    """(4, 2) corners of a rectangle around a straight line, longer than the line by half the width at both ends."""
    first, last = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    delta = last - first
    yaw = float(np.arctan2(delta[1], delta[0]))
    return rectangle((first + last) / 2, yaw, float(np.hypot(*delta)) + width_m, width_m)


def counter_clockwise(polygon: Floats) -> Floats:
    """The polygon (n, 2) with its corners in counter-clockwise order."""
    x, y = polygon.T
    area = np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))
    return polygon if area > 0 else polygon[::-1].copy()


def overlap(first: Floats, second: Floats, margin_m: float = 0.0) -> bool:
    """Whether two convex polygons (n, 2) and (m, 2) are nearer to each other than the margin.

    The test uses the edges' normals only (separating axes), so with a margin it errs towards True at corners.
    """
    for polygon in (first, second):
        edges = np.roll(polygon, -1, axis=0) - polygon
        normals = np.stack((edges[:, 1], -edges[:, 0]), axis=1)
        normals /= np.maximum(np.hypot(edges[:, 0], edges[:, 1]), 1e-12)[:, None]
        one, other = first @ normals.T, second @ normals.T
        gap = np.maximum(other.min(axis=0) - one.max(axis=0), one.min(axis=0) - other.max(axis=0))
        if gap.max() >= margin_m:
            return False
    return True


def contains(polygon: Floats, points: Floats, inset_m: float = 0.0) -> npt.NDArray[np.bool_]:
    """(n,) whether points (n, 2) lie inside a counter-clockwise convex polygon, at least inset_m from its edges."""
    edges = np.roll(polygon, -1, axis=0) - polygon
    inward = np.stack((-edges[:, 1], edges[:, 0]), axis=1) / np.hypot(edges[:, 0], edges[:, 1])[:, None]
    depth = points @ inward.T - np.sum(polygon * inward, axis=1)
    return np.asarray(depth.min(axis=1) >= inset_m)


def union_walls(
    polygons: Sequence[Floats], glass_edges: Sequence[tuple[int, ...]]
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Walls (n, 4) as x0, y0, x1, y1 around the union of counter-clockwise convex polygons, and which are glass (n,).

    Each polygon's edges are kept where they lie inside no other polygon. glass_edges: for each polygon the edges that
    are glass; edge i starts at corner i. Two polygons that only touch keep the wall between them.
    """
    corners = np.concatenate(polygons)
    offsets = np.cumsum([0, *(len(polygon) for polygon in polygons)])
    is_glass = np.zeros(len(corners), dtype=np.bool_)
    for offset, edges in zip(offsets, glass_edges, strict=False):
        is_glass[[offset + edge for edge in edges]] = True
    pieces, owners = _outer_pieces(corners, offsets)
    return pieces, is_glass[owners]


@njit(cache=True)
def _outer_pieces(corners: Floats, offsets: npt.NDArray[np.int64]) -> tuple[Floats, npt.NDArray[np.int64]]:
    polygons = offsets.shape[0] - 1
    bounds = np.empty((polygons, 4))
    for index in range(polygons):
        part = corners[offsets[index] : offsets[index + 1]]
        bounds[index] = (part[:, 0].min(), part[:, 1].min(), part[:, 0].max(), part[:, 1].max())
    pieces, owners = [], []
    for own in range(polygons):
        for corner in range(offsets[own], offsets[own + 1]):
            after = corner + 1 if corner + 1 < offsets[own + 1] else offsets[own]
            x, y = corners[corner]
            dx, dy = corners[after, 0] - x, corners[after, 1] - y
            length = np.hypot(dx, dy)
            spans = [(2.0, 2.0)]
            for other in range(polygons):
                low_x, low_y, high_x, high_y = bounds[other]
                if (
                    other == own
                    or max(x, x + dx) < low_x
                    or min(x, x + dx) > high_x
                    or max(y, y + dy) < low_y
                    or min(y, y + dy) > high_y
                ):
                    continue
                # Cyrus and Beck: the part of the edge that is inside all half planes.
                enter, leave = 0.0, 1.0
                for k in range(offsets[other], offsets[other + 1]):
                    follows = k + 1 if k + 1 < offsets[other + 1] else offsets[other]
                    edge_x, edge_y = corners[follows, 0] - corners[k, 0], corners[follows, 1] - corners[k, 1]
                    scale = np.hypot(edge_x, edge_y)
                    depth = (edge_x * (y - corners[k, 1]) - edge_y * (x - corners[k, 0])) / scale - _ON_BOUNDARY_M
                    slope = (edge_x * dy - edge_y * dx) / scale
                    if abs(slope) < 1e-12:
                        if depth <= 0.0:
                            leave = -1.0
                    elif slope > 0.0:
                        enter = max(enter, -depth / slope)
                    else:
                        leave = min(leave, -depth / slope)
                if enter < leave:
                    spans.append((enter, leave))
            spans.sort()
            reached = 0.0
            for begin, end in spans:
                stop = min(begin, 1.0)
                if (stop - reached) * length > _SHORTEST_WALL_M:
                    pieces.append((x + reached * dx, y + reached * dy, x + stop * dx, y + stop * dy))
                    owners.append(corner)
                reached = max(reached, end)
    walls = np.empty((len(pieces), 4))
    for index in range(len(pieces)):
        walls[index] = pieces[index]
    return walls, np.array(owners)
