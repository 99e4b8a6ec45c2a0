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


def followed(before: Grey, now: Grey, pixels: Array, guess: Array) -> tuple[Array, np.ndarray]:
    """Where corners ``(n, 2)`` of one picture are in the next, and which were found ``(n,)``.

    By pyramids of optical flow (Lucas and Kanade 1981; Bouguet 2001), forth and back.

    Args:
        guess: where they are expected ``(n, 2)``.
    """
    if len(pixels) == 0:
        return pixels, np.zeros(0, bool)
    start = np.ascontiguousarray(pixels, np.float32).reshape(-1, 1, 2)
    hint = np.ascontiguousarray(guess, np.float32).reshape(-1, 1, 2)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, now, start, hint.copy(), None, None, _WINDOW, _LEVELS, _STOP, flags
    )
    back, again, _ = cv2.calcOpticalFlowPyrLK(now, before, there, start.copy(), None, None, _WINDOW, 1, _STOP, flags)
    off = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    height, width = now.shape
    at = there.reshape(-1, 2).astype(np.float64)
    inside = (at > 1.0).all(1) & (at[:, 0] < width - 2.0) & (at[:, 1] < height - 2.0)
    return at, (found.ravel() == 1) & (again.ravel() == 1) & (off < _BACK_PX) & inside


def repeated(before: Grey, now: Grey, pixels: Array, there: Array, elsewhere: Array) -> np.ndarray:
    """Which corners ``(n,)`` that were followed look alike elsewhere: of these, what was found is what was expected.

    The search back begins ``elsewhere`` ``(n, 2)``. It ends at another place than where the corner was, and fits there
    by less than four times the residual (mean grey levels of a pixel; one at least) of the right place.
    """
    if len(pixels) == 0:
        return np.zeros(0, bool)
    start, right, wrong = (np.ascontiguousarray(at, np.float32).reshape(-1, 1, 2) for at in (there, pixels, elsewhere))
    (_, _, known), (back, again, residual) = (
        cv2.calcOpticalFlowPyrLK(now, before, start, hint, None, None, _WINDOW, 1, _STOP, cv2.OPTFLOW_USE_INITIAL_FLOW)
        for hint in (right, wrong)
    )
    other = np.linalg.norm(back.reshape(-1, 2) - pixels, axis=1) >= _BACK_PX
    alike: np.ndarray = residual.ravel() < _ALIKE * np.maximum(known.ravel(), 1.0)
    return (again.ravel() == 1) & other & alike


def corners(grey: Grey, most: int, apart_px: float, taken: Array) -> Array:
    """New corners ``(n, 2)``, at most ``most``, away from each other and from those that are followed ``(m, 2)``."""
    if most <= 0:
        return np.zeros((0, 2))
    free = np.full(grey.shape, 255, np.uint8)
    for x, y in taken.round().astype(int).tolist():
        cv2.circle(free, (x, y), int(apart_px), 0, -1)
    found = cv2.goodFeaturesToTrack(grey, most, 0.003, apart_px, mask=free)  # Shi and Tomasi 1994
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
