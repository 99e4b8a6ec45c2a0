"""Reads maps as Nav2's map server has them: an image, and a YAML file that says how to read it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError


class MapFile(NamedTuple):
    """A map: values int8 ``(rows, columns)``, 0 free, 100 occupied, -1 unknown; row 0 is the lowest in y.

    ``origin_xyyaw`` ``(3,)`` is the pose of the lower left corner of cell [0, 0] (m, m, rad).
    """

    values: NDArray[np.int8]
    resolution_m: float
    origin_xyyaw: NDArray[np.float64]


def read_map_file(description: Path) -> MapFile:
    """Read a map of the mode trinary, which is the mode of files that name none.

    Raises ``ValueError`` for another mode, and for files that are no map; ``OSError`` where one cannot be read.
    """
    try:
        facts: Any = yaml.safe_load(description.read_text())
        mode = facts.get("mode", "trinary")
        resolution, origin = float(facts["resolution"]), np.array(facts["origin"], np.float64)
        occupied, free, negate = float(facts["occupied_thresh"]), float(facts["free_thresh"]), bool(facts["negate"])
        image_file = description.parent / str(facts["image"])
    except (yaml.YAMLError, UnicodeDecodeError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{description}: no description of a map: {type(error).__name__}, {error}") from None
    if mode != "trinary":
        raise ValueError(f"{description}: its mode is {mode}; expected trinary")
    if not (0.0 < resolution < np.inf and origin.shape == (3,) and np.isfinite(origin).all()):
        raise ValueError(
            f"{description}: its resolution is {resolution} and its origin {origin.tolist()}; expected a positive "
            "number and three finite ones"
        )
    try:
        with Image.open(image_file) as image:
            grey = np.asarray(image.convert("L"), np.float64)[::-1] / 255.0
    except UnidentifiedImageError:
        raise ValueError(f"{image_file}: expected an image") from None
    occupancy = grey if negate else 1.0 - grey
    values = np.select([occupancy > occupied, occupancy < free], [100, 0], -1).astype(np.int8)
    return MapFile(values, resolution, origin)
