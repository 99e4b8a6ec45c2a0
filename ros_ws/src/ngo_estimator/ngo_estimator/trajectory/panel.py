"""Panels of a picture: axes in metres of equal scale, with a grid and a legend.

Drawn by Pillow: with matplotlib, its import and the picture took 7 % of a run over a thousand frames.
"""

import math
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

SIZE = 682
"""Width and height of a panel (pixels)."""
BLACK, GRID = "#000000", "#dddddd"

_FINE = 2  # pixels that are drawn for one of the picture, along each axis: edges get smooth
_LEFT, _RIGHT, _TOP, _BOTTOM = 60, 14, 54, 46  # around the axes
_TICKS = 8
_MARGIN, _LEAST_EXTENT_M = 0.05, 1.0
_OPACITY = 0.35  # of one point: a wall that is drawn twice shows at once


def nice_step(extent_m: float) -> float:
    """A step of 1, 2 or 5 times a power of ten, of which up to eight fit into ``extent_m``."""
    rough = extent_m / _TICKS
    power = 10.0 ** math.floor(math.log10(rough))
    return next((factor * power for factor in (1.0, 2.0, 5.0) if factor * power >= rough), 10.0 * power)


class Panel:
    """One panel, with axes that hold all of ``shown``.

    Args:
        title: of the panel.
        shown: points ``(n, 2)`` (m), at least one in all.
    """

    def __init__(self, title: str, shown: Sequence[np.ndarray]) -> None:
        self._image = Image.new("RGB", (_FINE * SIZE, _FINE * SIZE), "white")
        self._draw = ImageDraw.Draw(self._image)
        low = np.min([points.min(axis=0) for points in shown if len(points)], axis=0)
        high = np.max([points.max(axis=0) for points in shown if len(points)], axis=0)
        extent = (1.0 + 2.0 * _MARGIN) * np.maximum(high - low, _LEAST_EXTENT_M)
        room = np.array([SIZE - _LEFT - _RIGHT, SIZE - _TOP - _BOTTOM])
        self._scale = float((room / extent).min())
        self._centre_m = 0.5 * (low + high)
        self._centre = np.array([_LEFT, _TOP]) + 0.5 * room
        self._half_m = 0.5 * room / self._scale
        self._legend = 0
        self._axes()
        self._text((SIZE - _RIGHT + _LEFT) / 2, _TOP - 16, title, 15, "mm")

    def line(self, points: np.ndarray, color: str, width: float = 2.0, label: str = "") -> None:
        """A line through points ``(n, 2)``, in the legend where it has a label."""
        self._draw.line(self._places(points), color, round(_FINE * width))
        if label:
            y = self._entry(label)
            self._draw.line([_FINE * (SIZE - _RIGHT - 34), y, _FINE * (SIZE - _RIGHT - 10), y], color, 2 * _FINE)

    def dot(self, point: np.ndarray, color: str, label: str = "") -> None:
        """A dot at a point ``(2,)``, in the legend where it has a label."""
        places = [(self._places(point[None])[0], color)]
        if label:
            places.append(((_FINE * (SIZE - _RIGHT - 22), self._entry(label)), color))
        for place, fill in places:
            self._draw.circle(place, 4.5 * _FINE, fill, BLACK, _FINE)

    def cloud(self, points: np.ndarray) -> None:
        """Points ``(n, 2)``, the darker the more of them lie on a pixel; what was drawn before lies below them."""
        x, y = np.floor(self._pixels(points)).astype(np.int64)
        inside = (x >= 0) & (x < SIZE) & (y >= 0) & (y < SIZE)
        counts = np.bincount(y[inside] * SIZE + x[inside], minlength=SIZE * SIZE).reshape(SIZE, SIZE)
        cover = Image.fromarray(np.round(255.0 * (1.0 - (1.0 - _OPACITY) ** counts)).astype(np.uint8))
        self._image.paste(BLACK, mask=cover.resize(self._image.size, Image.Resampling.NEAREST))

    def picture(self) -> Image.Image:
        """The panel as a picture of ``SIZE`` x ``SIZE``."""
        return self._image.reduce(_FINE)

    def _axes(self) -> None:
        left, right, top, bottom = (_FINE * v for v in (_LEFT, SIZE - _RIGHT, _TOP, SIZE - _BOTTOM))
        step = nice_step(2.0 * float(self._half_m.max()))
        digits = max(0, -math.floor(math.log10(step)))
        for axis in (0, 1):
            low, high = self._centre_m[axis] - self._half_m[axis], self._centre_m[axis] + self._half_m[axis]
            for tick in range(math.ceil(low / step), math.floor(high / step) + 1):
                at = self._centre_m.copy()
                at[axis] = tick * step
                x, y = self._places(at[None])[0]
                self._draw.line([x, top, x, bottom] if axis == 0 else [left, y, right, y], GRID, 1)
                beside = (x / _FINE, SIZE - _BOTTOM + 12, "mm") if axis == 0 else (_LEFT - 6, y / _FINE, "rm")
                self._text(beside[0], beside[1], f"{tick * step:.{digits}f}", 12, beside[2])
        self._draw.rectangle([left, top, right, bottom], outline=BLACK, width=1)
        self._text((SIZE - _RIGHT + _LEFT) / 2, SIZE - 14, "x (m)", 13, "mm")
        self._text(_LEFT - 6, _TOP - 16, "y (m)", 13, "rm")

    def _entry(self, label: str) -> float:
        """Write the next label of the legend; returns the height of its middle."""
        self._legend += 1
        y = _TOP + 18 * self._legend - 4
        self._text(SIZE - _RIGHT - 42, y, label, 12, "rm")
        return float(_FINE * y)

    def _places(self, points: np.ndarray) -> list[tuple[float, float]]:
        """Places of points ``(n, 2)`` in the image that is drawn on."""
        x, y = _FINE * self._pixels(points)
        return list(zip(x.tolist(), y.tolist(), strict=True))

    def _pixels(self, points: np.ndarray) -> np.ndarray:
        """Columns and rows ``(2, n)`` of points ``(n, 2)`` in the picture."""
        x, y = points.T - self._centre_m[:, None]
        return np.stack((self._centre[0] + self._scale * x, self._centre[1] - self._scale * y))

    def _text(self, x: float, y: float, text: str, size: int, anchor: str) -> None:
        self._draw.text((_FINE * x, _FINE * y), text, BLACK, _font(_FINE * size), anchor)


def _font(size: int) -> ImageFont.ImageFont | ImageFont.FreeTypeFont:
    return ImageFont.load_default(size)
