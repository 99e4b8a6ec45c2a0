"""Ranges to the walls of a Doom level at the height of the eye."""

from types import SimpleNamespace

import numpy as np

from ngo_sim.doom_map import UNITS_PER_M
from ngo_sim.doom_walls import wall_ranges, walls_at


def line(*ends_m: float) -> SimpleNamespace:
    return SimpleNamespace(**dict(zip(("x1", "y1", "x2", "y2"), (UNITS_PER_M * end for end in ends_m), strict=True)))


def sector(floor: float, ceiling: float, *lines: SimpleNamespace) -> SimpleNamespace:
    return SimpleNamespace(floor_height=floor, ceiling_height=ceiling, lines=lines)


def test_a_step_below_the_eye_is_no_wall_and_one_above_it_is() -> None:
    between, behind = line(2.0, -1.0, 2.0, 1.0), line(5.0, -1.0, 5.0, 1.0)
    angles = np.array([0.0, np.pi])
    for height, expected in ((16.0, 5.0), (64.0, 2.0)):
        sectors = [sector(0.0, 128.0, between), sector(height, 128.0, line(2.0, 1.0, 2.0, -1.0), behind)]
        ranges = wall_ranges(walls_at(sectors, 41.0), np.zeros(3), angles)
        assert ranges.dtype == np.float32
        np.testing.assert_allclose(ranges, [expected, np.inf], atol=1e-6)
