"""Maps as the files that Nav2's map server reads: an image, and a YAML file that says how to read it."""

import io
from pathlib import Path

import numpy as np
import yaml
from PIL import Image

from ngo_common.files import write_together
from ngo_common.map_files import read_map_file
from ngo_estimator.mapping.occupancy_grid import OccupancyMap

FORMATS = ("pgm", "png")
MODES = ("trinary", "scale", "raw")
FREE, OCCUPIED = 0.25, 0.65  # Nav2's own thresholds.

_WHITE, _TRANSPARENT = 255, 0


def write_map(
    name: Path,
    found: OccupancyMap,
    image_format: str = "",
    mode: str = "trinary",
    free: float = FREE,
    occupied: float = OCCUPIED,
) -> list[Path]:
    """Write ``NAME.pgm`` or ``NAME.png``, and ``NAME.yaml``, both or neither.

    Args:
        name: path without an ending, in a folder that exists.
        found: the map, of which the known part is written.
        image_format: pgm or png; empty: pgm, and png for the mode scale.
        mode: trinary keeps free, occupied and unknown; scale and raw keep the probabilities.
        free: probability up to which a cell is free; occupied: from which on it is occupied.

    Returns:
        The files written.

    Raises:
        ValueError: of one line, for a map without cells, and for what Nav2 could not read.
        OSError: a file cannot be written; those that were there before still are.
    """
    found = found.cropped()
    image_format = image_format or ("png" if mode == "scale" else "pgm")
    _check(name, found, image_format, mode, free, occupied)
    image, description = name.with_name(f"{name.name}.{image_format}"), name.with_name(f"{name.name}.yaml")
    picture = io.BytesIO()
    # An image's first row is the highest in y.
    Image.fromarray(_pixels(found.values, mode, free, occupied)[::-1]).save(
        picture, "PPM" if image_format == "pgm" else "PNG"
    )
    text = yaml.safe_dump(
        {
            "image": image.name,
            "mode": mode,
            "resolution": round(found.resolution_m, 9),
            "origin": [*found.origin_xy.round(9).tolist(), 0.0],
            "negate": 0,
            "occupied_thresh": occupied,
            "free_thresh": free,
        },
        sort_keys=False,
        default_flow_style=None,
    )
    return write_together({image: [picture.getvalue()], description: [text.encode()]})


def read_map(description: Path) -> OccupancyMap:
    """Read a map of the mode trinary, as Nav2's map server does; raises ``ValueError`` for another mode."""
    values, resolution, origin = read_map_file(description)
    return OccupancyMap(values, resolution, origin[:2])


def _check(name: Path, found: OccupancyMap, image_format: str, mode: str, free: float, occupied: float) -> None:
    if mode not in MODES:
        raise ValueError(f"map mode is '{mode}'; expected {', '.join(MODES[:-1])} or {MODES[-1]}")
    if image_format not in FORMATS:
        raise ValueError(f"image format is '{image_format}'; expected {' or '.join(FORMATS)}")
    if mode == "scale" and image_format != "png":
        raise ValueError(f"image format is {image_format}; expected png: the mode scale needs transparent pixels")
    if not 0.0 <= free < occupied <= 1.0:
        raise ValueError(
            f"thresholds of free and occupied are {free:g} and {occupied:g}; expected 0 <= free < occupied <= 1"
        )
    if name.name in ("", ".", ".."):
        raise ValueError(f"file is '{name}'; expected a name without an ending")
    if not name.parent.is_dir():
        raise ValueError(f"there is no folder '{name.parent}'")
    if not found.values.size:
        raise ValueError("the map is empty; nothing was written")


def _pixels(values: np.ndarray, mode: str, free: float, occupied: float) -> np.ndarray:
    """Grey values of the cells, with transparency behind them in the mode scale."""
    unknown = values < 0
    if mode == "raw":
        return np.where(unknown, _WHITE, values).astype(np.uint8)
    if mode == "scale":
        grey = np.rint((100.0 - values) * 2.55).clip(0, 255)
        return np.stack((np.where(unknown, 128, grey), np.where(unknown, _TRANSPARENT, 255)), -1).astype(np.uint8)
    # Nav2 writes 205, which it reads as free again by its own threshold: (255 - 205) / 255 is less than 0.25.
    between = round(255.0 * (1.0 - 0.5 * (free + occupied)))
    sure = OccupancyMap(values, 1.0, np.zeros(2)).trinary(free, occupied).values
    return np.select([sure == 0, sure == 100], [254, 0], between).astype(np.uint8)
