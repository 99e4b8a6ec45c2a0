"""Features of a picture that are found again from other places, and their descriptors."""

from typing import Protocol

import cv2
import numpy as np

Array = np.ndarray


_PIXEL_STD, _SIZE_STD = 0.3, 0.04
"""Deviations of a feature: pixels, and a share of its size. Large ones are where their blurred surroundings say."""


class Describer(Protocol):
    """Finds features in a grey picture ``(height, width)`` uint8."""

    def describe(self, grey: np.ndarray) -> tuple[Array, Array, np.ndarray]:
        """Pixels ``(n, 2)``, their deviations ``(n,)`` and unit descriptors ``(n, d)``, the strongest first."""


class Sift:
    """SIFT (Lowe 2004) with square roots of its histograms (Arandjelovic and Zisserman 2012)."""

    def __init__(self, most: int) -> None:
        self._sift = cv2.SIFT.create(nfeatures=most, contrastThreshold=0.02)

    def describe(self, grey: np.ndarray) -> tuple[Array, Array, np.ndarray]:
        """See ``Describer.describe``."""
        found, histograms = self._sift.detectAndCompute(grey, None)
        if histograms is None or len(found) == 0:
            return np.zeros((0, 2)), np.zeros(0), np.zeros((0, 128), np.float32)
        shares = histograms / np.maximum(histograms.sum(1, keepdims=True), 1e-9)
        pixels = np.array([point.pt for point in found])
        std = np.hypot(_PIXEL_STD, _SIZE_STD * np.array([point.size for point in found]))
        return pixels, std, np.sqrt(shares).astype(np.float32)
