"""Tours over places that are short, or see the most early: by nearest insertion, then 2-opt and or-opt."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_explorer.known_map import Floats

Ints = NDArray[np.int64]

_WHOLE = 0.3  # of the whole length by all worth, in what a tour costs: small places are not left for the end


def tour(first_m: Floats, between_m: Floats, start: int = -1, worth: Floats | None = None) -> tuple[Ints, float]:
    """The order ``(n,)`` in which to visit n places, and what it costs: its length in m.

    With ``worth`` ``(n,)`` of the places, not all 0, the cost is the sum of the ways until each of them by its worth,
    as of a travelling repairman, and 0.3 of the whole length by all of the worth. first_m: ``(n,)`` ways from the
    robot. between_m: ``(n, n)`` ways between the places. start: the place to visit first; -1: any.
    """
    order = _inserted(first_m, between_m, start)
    worth = np.zeros(len(first_m)) if worth is None else worth
    cost = _improved(order, first_m, between_m, worth, 1 if start >= 0 else 0)
    return order, float(cost)


@njit(cache=True)
def _inserted(first: Floats, between: Floats, start: int) -> Ints:
    """Nearest insertion: the place nearest to the tour so far enters where it costs least."""
    count = len(first)
    order = np.empty(count, np.int64)
    order[0] = start if start >= 0 else int(np.argmin(first))
    inside = np.zeros(count, np.bool_)
    inside[order[0]] = True
    gaps = between[order[0]].copy()
    for filled in range(1, count):
        chosen = -1
        for place in range(count):
            if not inside[place] and (chosen < 0 or gaps[place] < gaps[chosen]):
                chosen = place
        best, position = np.inf, filled
        for at in range(1 if start >= 0 else 0, filled + 1):
            before = first[chosen] if at == 0 else between[order[at - 1], chosen]
            if at == filled:
                more = before
            else:
                after = order[at]
                more = before + between[chosen, after] - (first[after] if at == 0 else between[order[at - 1], after])
            if more < best:
                best, position = more, at
        order[position + 1 : filled + 1] = order[position:filled].copy()
        order[position] = chosen
        inside[chosen] = True
        gaps = np.minimum(gaps, between[chosen])
    return order


@njit(cache=True)
def _cost(order: Ints, first: Floats, between: Floats, worth: Floats) -> float:
    way = first[order[0]]
    total = way * worth[order[0]]
    for index in range(1, len(order)):
        way += between[order[index - 1], order[index]]
        total += way * worth[order[index]]
    return total + _WHOLE * way * worth.sum() if worth.any() else way


@njit(cache=True)
def _improved(order: Ints, first: Floats, between: Floats, worth: Floats, fixed: int) -> float:
    """Reverse and move parts of the tour while that makes it cheaper; the first ``fixed`` places stay."""
    count = len(order)
    best = _cost(order, first, between, worth)
    changed = True
    rounds = 0
    while changed and rounds < 50:
        changed = False
        rounds += 1
        for begin in range(fixed, count - 1):
            for end in range(begin + 1, count):
                tried = order.copy()
                tried[begin : end + 1] = order[begin : end + 1][::-1]
                cost = _cost(tried, first, between, worth)
                if cost < best - 1e-9:
                    order[:] = tried
                    best, changed = cost, True
        for size in range(1, min(4, count - fixed)):
            for begin in range(fixed, count - size + 1):
                for target in range(fixed, count - size + 1):
                    if target == begin:
                        continue
                    part = order[begin : begin + size].copy()
                    rest = np.concatenate((order[:begin], order[begin + size :]))
                    tried = np.concatenate((rest[:target], part, rest[target:]))
                    cost = _cost(tried, first, between, worth)
                    if cost < best - 1e-9:
                        order[:] = tried
                        best, changed = cost, True
    return best
