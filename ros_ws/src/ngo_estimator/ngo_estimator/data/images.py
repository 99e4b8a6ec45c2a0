"""How an observation becomes the input of a network: pictures, depth, and laser scans of any geometry."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_KINDS = {
    (1, "uint8"): "grey",
    (3, "uint8"): "colour",
    (1, "float32"): "depth",
    (4, "float32"): "colour and depth",
}
# Neighbouring rays whose ranges differ by a larger share than this end on different surfaces, between which is nothing.
_EDGE_SHARE = 0.2
# Rad; scanners have 50 times this. A finer one is no angle between rays, and float32 may not tell its rays apart.
_LEAST_INCREMENT = 1e-5


@dataclass(frozen=True)
class ImageFormat:
    """Shape and type of one observation.

    ``channels`` and ``dtype`` are 1 (grey) or 3 (colour) of ``uint8``, 1 (depth) or 4 (colour from 0 to 1, and depth)
    of ``float32``. Depth is in metres, ``+inf`` where nothing came back. A row scan is an image of height 1 whose first
    column is its leftmost ray. ``field_of_view_deg`` says that the row is made from laser scans by ``scan_image``: the
    angle from its first ray to its last, straight ahead in the middle.

    Depth d enters a network as ``depth_gain_m / (depth_softening_m + d)``: near walls, which say most about motion, get
    most of the range.

    ``reduction`` k says that the sensor's pictures are k times as high and wide, and made smaller by ``reduced``.
    """

    height: int
    width: int
    channels: int
    dtype: str
    field_of_view_deg: float | None = None
    depth_gain_m: float = 0.6
    depth_softening_m: float = 0.3
    reduction: int = 1

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 8:
            raise ValueError(
                f"image is {self.height} x {self.width}; expected a height of at least 1 and a width of at least 8"
            )
        if (self.channels, self.dtype) not in _KINDS:
            kinds = ", ".join(f"{channels} of {dtype} ({name})" for (channels, dtype), name in _KINDS.items())
            raise ValueError(f"image has {self.channels} channels of {self.dtype}; expected one of {kinds}")
        if not (0.0 < self.depth_gain_m < math.inf and 0.0 < self.depth_softening_m < math.inf):
            raise ValueError(
                f"depth_gain_m, depth_softening_m are {self.depth_gain_m}, {self.depth_softening_m}; "
                "expected positive distances"
            )
        if self.reduction < 1 or (self.reduction > 1 and self.is_scan):
            raise ValueError(f"reduction is {self.reduction}; expected a whole number from 1 on, and 1 for scans")
        if self.field_of_view_deg is not None:
            if (self.height, self.channels, self.dtype) != (1, 1, "float32"):
                raise ValueError(f"a scan is {self.shape} of {self.dtype}; expected (1, rays, 1) of float32")
            if not 0.0 < self.field_of_view_deg <= 360.0:
                raise ValueError(f"field_of_view_deg is {self.field_of_view_deg}; expected over 0 and at most 360")

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(height, width, channels)``."""
        return self.height, self.width, self.channels

    @property
    def largest_picture(self) -> tuple[int, int]:
        """Height and width of the largest picture that ``reduced`` makes one of this format."""
        return (self.height + 1) * self.reduction - 1, (self.width + 1) * self.reduction - 1

    @property
    def is_scan(self) -> bool:
        """Whether observations are made from laser scans by ``scan_image``."""
        return self.field_of_view_deg is not None

    @property
    def has_depth(self) -> bool:
        """Whether the last channel is depth in metres."""
        return self.dtype == "float32"

    @property
    def ray_angles_rad(self) -> np.ndarray:
        """The angles of a scan's rays ``(width,)``, counter-clockwise from straight ahead, leftmost first."""
        if self.field_of_view_deg is None:
            raise ValueError("an image that is no scan has no ray angles; expected a field_of_view_deg")
        half = math.radians(self.field_of_view_deg) / 2.0
        return np.linspace(half, -half, self.width)

    def check(self, image: np.ndarray) -> None:
        """Raise ``ValueError`` unless ``image`` is an observation of this format with possible values."""
        if image.shape != self.shape or image.dtype != np.dtype(self.dtype):
            raise ValueError(f"image is {image.shape} of {image.dtype}; expected {self.shape} of {self.dtype}")
        if not self.has_depth:
            return
        colour, depth = image[..., :-1], image[..., -1]
        if wrong := int((~np.isfinite(colour)).sum() + (np.isnan(depth) | (depth == -np.inf)).sum()):
            raise ValueError(f"image has {wrong} values that are not finite; expected numbers, and +inf for no return")
        if wrong := int((depth < 0.0).sum()):
            raise ValueError(f"image has {wrong} negative depths; expected metres from 0 on")
        if not np.isfinite(depth).any():
            raise ValueError(f"image has no return in {depth.size} depths; expected one at least")
        if wrong := int(((colour < 0.0) | (colour > 1.0)).sum()):
            raise ValueError(f"image has {wrong} colours out of range; expected 0 to 1")


def to_network(images: Tensor, image: ImageFormat) -> Tensor:
    """Observations ``(..., height, width, channels)`` as float32 ``(..., channels, height, width)`` for a network.

    Colours, and depth beside them, are centred: about -0.5 to 0.5. Depth alone is not, so that rays without a return
    enter as 0, as do the columns beyond the border.
    """
    if not image.has_depth:
        return (images.float() / 255.0 - 0.5).movedim(-1, -3)
    depth = image.depth_gain_m / (image.depth_softening_m + images[..., -1:].float())
    if image.channels == 1:
        return depth.movedim(-1, -3)
    return torch.cat((images[..., :-1].float() - 0.5, depth - 0.5), dim=-1).movedim(-1, -3)


def reduced(picture: np.ndarray, factor: int) -> np.ndarray:
    """A picture ``(height, width, channels)`` made smaller: ``(height // factor, width // factor, channels)``.

    Colours are the means of ``factor`` x ``factor`` pixels, depths those of the middle of them (a mean over an edge
    would be a distance at which nothing is). Rows and columns that are left over at the bottom and on the right go.
    """
    height, width, channels = picture.shape
    rows, columns = height // factor, width // factor
    blocks = picture[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, channels)
    middle = blocks[:, factor // 2, :, factor // 2]
    if picture.dtype == np.uint8:
        total = blocks.sum(axis=(1, 3), dtype=np.uint32)
        return ((total + factor * factor // 2) // (factor * factor)).astype(np.uint8)
    colours = blocks[..., :-1].mean(axis=(1, 3), dtype=np.float32)
    return np.concatenate((colours, middle[..., -1:]), axis=-1)


def scan_image(
    image: ImageFormat,
    ranges: np.ndarray,
    angle_min_rad: float,
    angle_increment_rad: float,
    range_min_m: float,
    range_max_m: float,
) -> np.ndarray:
    """Resample a laser scan to the rays of a format.

    Each ray gets the range of the scanner's nearest ray, interpolated towards the next one where both end on one
    surface. Where that one has no return, the next nearest counts that is at most half a ray of the format away: of a
    fine scanner some may be lost. Rays that the scanner does not look at, or whose range is NaN, 0, below
    ``range_min_m`` or above ``range_max_m``, become ``+inf``. Angles count counter-clockwise from straight ahead, as in
    sensor_msgs/LaserScan; the scanner may turn either way and begin anywhere.

    Args:
        image: the format, with a ``field_of_view_deg``.
        ranges: ``(rays,)`` m.
        angle_min_rad: angle of ``ranges[0]``.
        angle_increment_rad: from each ray to the next, negative for a scanner that turns clockwise.
        range_min_m, range_max_m: what the scanner can measure; a maximum that is not above the minimum, which some
            drivers leave at 0, is none.

    Returns:
        ``(1, width, 1)`` float32.

    Raises:
        ValueError: a geometry that no scanner has.
    """
    ranges = np.asarray(ranges, dtype=np.float32)
    step = abs(angle_increment_rad)
    if ranges.ndim != 1 or len(ranges) < 2:
        raise ValueError(f"scan has ranges of shape {ranges.shape}; expected (rays,) with two at least")
    if not (math.isfinite(angle_min_rad) and _LEAST_INCREMENT <= step < math.pi):
        raise ValueError(
            f"scan has angle_min {angle_min_rad:g} and angle_increment {angle_increment_rad:g}; expected finite angles "
            f"(rad) and an increment from {_LEAST_INCREMENT:g} to below pi, of either sign"
        )
    with np.errstate(invalid="ignore"):
        measured = (ranges > 0.0) & (ranges >= range_min_m) & (ranges < math.inf)
        if range_max_m > range_min_m:
            measured &= ranges <= range_max_m
    ranges = np.where(measured, ranges, np.float32(np.inf))

    # The place of each wanted ray among the scanner's, from half a ray before the first to just before a turn later.
    wanted = image.ray_angles_rad
    turn = math.copysign(1.0, angle_increment_rad) * (wanted - angle_min_rad)
    place = (np.mod(turn + 0.5 * step, math.tau) - 0.5 * step) / step
    nearest = np.floor(place + 0.5).astype(np.int64)
    count = len(ranges)
    closed = count * step > math.tau - 0.5 * step  # a whole turn: the last ray is the first one's neighbour

    def at(ray: np.ndarray) -> np.ndarray:
        if closed:
            return ranges[ray % count]
        return np.where((ray >= 0) & (ray < count), ranges[np.clip(ray, 0, count - 1)], np.float32(np.inf))

    side = np.where(place >= nearest, 1, -1)
    value, other = at(nearest), at(nearest + side)
    with np.errstate(invalid="ignore"):
        together = np.abs(other - value) <= _EDGE_SHARE * np.minimum(value, other)
        result = np.where(together, value + np.abs(place - nearest) * (other - value), value)
    reach = 0.5 * abs(float(wanted[1] - wanted[0])) / step
    lost = np.isinf(result) & (closed | (nearest < count))
    result[lost] = _next_return(ranges, place[lost], reach, closed)
    return result.astype(np.float32).reshape(1, -1, 1)


def _next_return(ranges: np.ndarray, place: np.ndarray, reach: float, closed: bool) -> np.ndarray:
    """Range of the nearest ray with a return that is at most ``reach`` rays from each place, or else ``+inf``."""
    seen = np.flatnonzero(np.isfinite(ranges))
    if closed:
        seen = np.concatenate((seen - len(ranges), seen, seen + len(ranges)))
    if not len(seen):
        return np.full(len(place), np.inf)
    after = np.searchsorted(seen, place)
    after, before = seen[np.minimum(after, len(seen) - 1)], seen[np.maximum(after - 1, 0)]
    ray = np.where(np.abs(after - place) <= np.abs(before - place), after, before)
    return np.where(np.abs(ray - place) <= reach, ranges[ray % len(ranges)], np.inf)
