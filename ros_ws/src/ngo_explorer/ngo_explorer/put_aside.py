"""Frontiers that could not be reached or seen: put aside, and tried again once the map there has changed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ngo_explorer.frontiers import Frontier
from ngo_explorer.known_map import Cells, Floats, KnownMap

_SAME_M = 0.6  # frontiers whose middles are nearer than this are the same place
_AROUND_M = 1.0
_CHANGED_SHARE = 0.05  # of the cells around a place
_MOST_TRIES = 4  # of one place: sensor noise changes a map for ever


@dataclass(eq=False)
class _Place:
    point_xy: Floats
    reason: str
    seen: Cells
    tries: int = 1
    viewpoints: list[Floats] = field(default_factory=list)
    aside: bool = True


class PutAside:
    """The places that were given up for now."""

    def __init__(self) -> None:
        self._places, self._points = list[_Place](), np.zeros((0, 2))

    def add(self, known: KnownMap, frontier: Frontier, viewpoint_xy: Floats, reason: str, again: bool = False) -> None:
        """Put a frontier aside; with ``again`` only this viewpoint, and the frontier may be tried from another one."""
        place = self._at(frontier.point_xy)
        if place is None:
            place = _Place(frontier.point_xy, reason, _around(known, frontier.point_xy), tries=0)
            self._places.append(place)
            self._points = np.vstack((self._points, place.point_xy))
        place.tries += 1
        place.reason, place.seen = reason, _around(known, frontier.point_xy)
        if again:
            place.viewpoints.append(np.array(viewpoint_xy))
        place.aside = not again or place.tries >= _MOST_TRIES

    def reason(self, known: KnownMap, frontier: Frontier, for_ever: bool = False) -> str:
        """Why a frontier is aside now; empty: it may be tried. With ``for_ever`` a change of the map says nothing."""
        place = self._at(frontier.point_xy)
        if place is None or not place.aside:
            return ""
        if for_ever or place.tries >= _MOST_TRIES or not _changed(place.seen, _around(known, place.point_xy)):
            return place.reason
        place.aside = False
        return ""

    def another_chance(self) -> bool:
        """Try once more what failed a single time; returns whether there is anything."""
        once = [place for place in self._places if place.aside and place.tries == 1]
        for place in once:
            place.aside = False
        return bool(once)

    def barred(self, frontier: Frontier) -> Floats:
        """``(n, 2)`` viewpoints that showed nothing of a frontier."""
        place = self._at(frontier.point_xy)
        return np.array(place.viewpoints if place is not None else []).reshape(-1, 2)

    def _at(self, point_xy: Floats) -> _Place | None:
        if not self._places:
            return None
        gaps = np.hypot(*(self._points - point_xy).T)
        nearest = int(np.argmin(gaps))
        return self._places[nearest] if gaps[nearest] < _SAME_M else None


def _around(known: KnownMap, point_xy: Floats) -> Cells:
    row, column = known.cell(point_xy)
    reach = int(_AROUND_M / known.resolution_m)
    found = np.full((2 * reach + 1, 2 * reach + 1), -1, np.int8)
    rows, columns = known.state.shape
    low, left = max(0, row - reach), max(0, column - reach)
    part = known.state[low : max(low, min(rows, row + reach + 1)), left : max(left, min(columns, column + reach + 1))]
    found[low - row + reach : low - row + reach + part.shape[0], left - column + reach :][:, : part.shape[1]] = part
    return found


def _changed(before: Cells, after: Cells) -> bool:
    return bool(np.count_nonzero(before != after) > _CHANGED_SHARE * before.size)
