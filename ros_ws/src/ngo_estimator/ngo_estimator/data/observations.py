"""From what a sensor gives to what the networks take (no ROS here)."""

from typing import Protocol

import numpy as np

from ngo_estimator.data.images import ImageFormat, reduced, scan_image


class ScanGeometry(Protocol):
    """Of a scan whose rays run counter-clockwise from ``angle_min_rad``; its image has them the other way round."""

    @property
    def angle_min_rad(self) -> float:
        """Angle of the rightmost ray, the last column."""

    @property
    def angle_increment_rad(self) -> float:
        """From each ray to the one on its left."""

    @property
    def range_min_m(self) -> float:
        """Below it nothing is measured."""

    @property
    def range_max_m(self) -> float:
        """Above it nothing is measured; not above ``range_min_m``: there is no such limit."""


def observation(
    image_format: ImageFormat, image: np.ndarray, scan: ScanGeometry | None = None, scan_yaw_rad: float = 0.0
) -> np.ndarray:
    """An observation of ``image_format`` from a picture, or from a laser scan of any geometry.

    Args:
        image_format: what the networks take.
        image: ``(height, width, channels)`` of uint8, or of float32 with depth (m, +inf: no return) in the last
            channel; of a scan ``(1, rays, 1)``, leftmost ray first.
        scan: the geometry of a scan.
        scan_yaw_rad: where the scanner's angle 0 points, counter-clockwise from straight ahead.

    Raises:
        ValueError: a sensor of another kind or size than the networks were trained for.
    """
    if image_format.is_scan:
        if scan is None:
            raise ValueError(f"image is {_words(image)}; expected a laser scan")
        left = scan.angle_min_rad + (image.shape[1] - 1) * scan.angle_increment_rad
        ranges = image.reshape(-1)
        limits = scan.range_min_m, scan.range_max_m
        return scan_image(image_format, ranges, left + scan_yaw_rad, -scan.angle_increment_rad, *limits)
    if scan is not None:
        raise ValueError(f"image is a laser scan of {image.shape[1]} rays; expected {_format_words(image_format)}")
    factor = image_format.reduction
    if factor > 1 and image.dtype == np.dtype(image_format.dtype):
        height, width, channels = image.shape
        if (height // factor, width // factor, channels) == image_format.shape:
            return reduced(image, factor)
    if factor > 1 or image.shape != image_format.shape or image.dtype != np.dtype(image_format.dtype):
        raise ValueError(f"image is {_words(image)}; expected {_format_words(image_format)}")
    return image


def _words(image: np.ndarray) -> str:
    height, width, channels = image.shape
    return f"{width} x {height} pixels of {channels} x {image.dtype}"


def _format_words(image_format: ImageFormat) -> str:
    factor = image_format.reduction
    size = f"{factor * image_format.width} x {factor * image_format.height} pixels"
    return f"{size} of {image_format.channels} x {image_format.dtype}"
