"""Corners that are followed from picture to picture."""

import cv2
import numpy as np

Array = np.ndarray
Grey = np.ndarray

_WINDOW = (17, 17)
_LEVELS = 3
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.02)
_BACK_PX = 1.0
"""A corner that is followed back must come out so near to where it was."""

_ALIKE = 4.0
"""Residual of another place, by that of the right one, below which they look alike."""

_TILES_ACROSS, _IN_TILE = 8, 5
"""Tiles in a row of a picture, and corners in each that are spread."""


def followed(before: Grey, now: Grey, pixels: Array, guess: Array) -> tuple[Array, np.ndarray, Array]:
    """Where corners ``(n, 2)`` of one picture are in the next, which were found ``(n,)``, and the residual of the
    search back ``(n,)`` (mean grey levels of a pixel).

    By pyramids of optical flow (Lucas and Kanade 1981; Bouguet 2001), forth and back.

    Args:
        guess: where they are expected ``(n, 2)``.
    """
    if len(pixels) == 0:
        return pixels, np.zeros(0, bool), np.zeros(0)
    there, found, _ = _flow(before, now, pixels, guess, _LEVELS)
    back, again, residual = _flow(now, before, there, pixels, 1)
    off = np.linalg.norm(back - pixels.astype(np.float32), axis=1)
    height, width = now.shape
    at = there.astype(np.float64)
    inside = (at > 1.0).all(1) & (at[:, 0] < width - 2.0) & (at[:, 1] < height - 2.0)
    return at, found & again & (off < _BACK_PX) & inside, residual


def repeated(
    before: Grey, now: Grey, pixels: Array, there: Array, elsewhere: Array, residual: Array
) -> np.ndarray:  # fmt: skip
    """Which corners ``(n,)`` that were followed look alike elsewhere: of these, what was found is what was expected.

    The search back begins ``elsewhere`` ``(n, 2)``. It ends at another place than where the corner was, and fits there
    by less than four times the ``residual`` ``(n,)`` of the right place (one grey level at least).
    """
    if len(pixels) == 0:
        return np.zeros(0, bool)
    back, again, other = _flow(now, before, there, elsewhere, 1)
    moved = np.linalg.norm(back - pixels, axis=1) >= _BACK_PX
    alike: np.ndarray = other < _ALIKE * np.maximum(residual, 1.0)
    return again & moved & alike


def _flow(before: Grey, now: Grey, pixels: Array, guess: Array, levels: int) -> tuple[Array, np.ndarray, Array]:
    """Where points ``(n, 2)`` are in the other picture, which were found, and the residuals, from a ``guess``."""
    start, hint = (np.ascontiguousarray(at, np.float32).reshape(-1, 1, 2) for at in (pixels, guess))
    there, found, residual = cv2.calcOpticalFlowPyrLK(
        before, now, start, hint.copy(), None, None, _WINDOW, levels, _STOP, cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    kept = found.ravel() == 1
    return there.reshape(-1, 2), kept, np.where(kept, residual.ravel(), 0.0)  # OpenCV leaves it open of lost ones


def corners(grey: Grey, most: int, apart_px: float, taken: Array) -> Array:
    """New corners ``(n, 2)``, at most ``most``, away from each other and from those that are followed ``(m, 2)``."""
    if most <= 0:
        return np.zeros((0, 2))
    free = np.full(grey.shape, 255, np.uint8)
    for x, y in taken.round().astype(int).tolist():
        cv2.circle(free, (x, y), int(apart_px), 0, -1)
    found = cv2.goodFeaturesToTrack(grey, most, 0.003, apart_px, mask=free)  # Shi and Tomasi 1994
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)


def spread_corners(grey: Grey, top: int, apart_px: float, taken: Array) -> Array:
    """New corners ``(n, 2)`` below the row ``top``, a few in each tile: a floor has weaker ones than walls have."""
    height, width = grey.shape
    tile, at = width // _TILES_ACROSS, taken
    for y in range(top, height - tile // 2, tile):
        for x in range(0, width - tile // 2, tile):
            near = at - (x, y)
            near = near[((near > -apart_px) & (near < tile + apart_px)).all(1)]
            part = np.ascontiguousarray(grey[y : y + tile, x : x + tile])
            at = np.concatenate((at, corners(part, _IN_TILE - len(near), apart_px, near) + (x, y)))
    return at[len(taken) :]
