"""The files of a map, read back by the rules of Nav2's map server: an independent reader with PIL and yaml."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from ngo_estimator.mapping.map_files import write_map
from ngo_estimator.mapping.occupancy_grid import OccupancyMap

VALUES = np.array([[-1, 0, 10, 25, 26], [40, 64, 65, 90, 100]], np.int8)
MAP = OccupancyMap(VALUES, 0.05, np.array([-3.15, 2.4]))


def read_by_nav2(description: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """What Nav2's map server publishes: percentages, row 0 lowest in y."""
    facts = yaml.safe_load(description.read_text())
    with Image.open(description.parent / facts["image"]) as image:
        has_alpha = "A" in image.getbands()
        pixels = np.asarray(image.convert("RGBA"), np.float64)
    mode, free, occupied = facts["mode"], facts["free_thresh"], facts["occupied_thresh"]
    channels = pixels if mode == "trinary" and has_alpha else pixels[..., :3]
    shade = channels.mean(axis=-1) / 255.0
    occupancy = shade if facts["negate"] else 1.0 - shade
    known = {"occupied": occupancy > occupied, "free": occupancy < free}
    if mode == "trinary":
        cells = np.select(list(known.values()), [100, 0], -1)
    elif mode == "scale":
        between = np.rint((occupancy - free) / (occupied - free) * 100.0)
        cells = np.select([pixels[..., 3] < 255, *known.values()], [-1, 100, 0], between)
    else:
        percent = np.round(shade * 255.0)
        cells = np.where(percent <= 100, percent, -1)
    return cells.astype(int)[::-1], facts


@pytest.mark.parametrize("image_format", ["", "pgm", "png"])
def test_trinary(tmp_path: Path, image_format: str) -> None:
    written = write_map(tmp_path / "hall", MAP, image_format)
    ending = image_format or "pgm"
    assert written == [tmp_path / f"hall.{ending}", tmp_path / "hall.yaml"]
    cells, facts = read_by_nav2(tmp_path / "hall.yaml")
    assert cells.tolist() == MAP.trinary(0.25, 0.65).values.tolist()
    assert facts == {
        "image": f"hall.{ending}",
        "mode": "trinary",
        "resolution": 0.05,
        "origin": [-3.15, 2.4, 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.25,
    }


def test_raw_keeps_every_percentage(tmp_path: Path) -> None:
    write_map(tmp_path / "hall", MAP, "pgm", "raw")
    assert read_by_nav2(tmp_path / "hall.yaml")[0].tolist() == VALUES.tolist()


def test_scale_spreads_what_lies_between_the_thresholds(tmp_path: Path) -> None:
    (image, _) = write_map(tmp_path / "hall", MAP, "", "scale")
    assert image.suffix == ".png"
    cells = read_by_nav2(tmp_path / "hall.yaml")[0]
    assert (cells == -1).tolist() == (VALUES == -1).tolist()
    assert cells[VALUES == 0].tolist() == [0] and cells[VALUES >= 90].tolist() == [100, 100]
    spread = [(value / 100.0 - 0.25) / 0.4 * 100.0 for value in (40, 64)]
    np.testing.assert_allclose([cells[1, 0], cells[1, 1]], spread, atol=1.0)


def test_nav2_finds_each_cell_where_it_is(tmp_path: Path) -> None:
    write_map(tmp_path / "hall", MAP)
    cells, facts = read_by_nav2(tmp_path / "hall.yaml")
    row, column = 1, 4
    x, y = (facts["origin"][axis] + (at + 0.5) * facts["resolution"] for axis, at in ((0, column), (1, row)))
    assert math.isclose(x, -2.925) and math.isclose(y, 2.475) and cells[row, column] == 100


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"mode": "fancy"}, "map mode is 'fancy'; expected trinary, scale or raw"),
        ({"image_format": "bmp"}, "image format is 'bmp'; expected pgm or png"),
        ({"mode": "scale", "image_format": "pgm"}, "expected png: the mode scale needs transparent pixels"),
        ({"free": 0.7}, "thresholds of free and occupied are 0.7 and 0.65; expected 0 <= free < occupied <= 1"),
        ({"name": Path("nowhere/hall")}, "there is no folder 'nowhere'"),
        ({"name": Path("..")}, "file is '..'; expected a name without an ending"),
        ({"found": OccupancyMap(np.zeros((0, 0), np.int8), 0.05, np.zeros(2))}, "the map is empty"),
    ],
)
def test_mistakes_are_named_and_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], complaint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=complaint):
        write_map(**{"name": Path("hall"), "found": MAP, **change})
    assert list(tmp_path.iterdir()) == []
