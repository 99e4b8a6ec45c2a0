"""Counts of an occupancy grid against answers by hand, and scans taken out again to the last bit."""

import math

import numpy as np
import pytest

from ngo_estimator.mapping.occupancy_grid import MapTooLarge, OccupancyConfig, OccupancyGrid, OccupancyMap
from ngo_estimator.mapping.range_scan import RangeScan, range_scan

ORIGIN = np.zeros((1, 3))
# One scan decides a cell, so that values can be read as words.
SURE = OccupancyConfig(hit=20.0, passed=5.0)


def rays(*angles_and_ranges: tuple[float, float], max_range_m: float = 100.0) -> RangeScan:
    angles, ranges = np.array(angles_and_ranges, np.float64).reshape(-1, 2).T
    return range_scan(angles, ranges, np.zeros(3), max_range_m)


def drawn(found: OccupancyMap) -> list[str]:
    """The map as seen from above: # occupied, . free, ? unknown; one that is neither is its percentage."""
    names = {-1: "?", 0: ".", 1: ".", 100: "#"}
    return ["".join(names.get(value, str(value)) for value in row) for row in found.values[::-1].tolist()]


def random_scans(count: int, seed: int) -> tuple[list[RangeScan], np.ndarray]:
    rng = np.random.default_rng(seed)
    angles = np.linspace(-2.0, 2.0, 61)
    scans = [range_scan(angles, rng.uniform(0.0, 6.0, 61), rng.normal(size=3) * 0.2, 5.0) for _ in range(count)]
    return scans, np.column_stack((rng.uniform(-8.0, 8.0, (count, 2)), rng.uniform(-4.0, 4.0, count)))


def test_a_slanted_ray_passes_the_cells_that_it_crosses() -> None:
    """From (0, 0) to (2, 1): the line crosses x = 0.5 at y = 0.25, y = 0.5 at x = 1, and x = 1.5 at y = 0.75."""
    grid = OccupancyGrid(1.0)
    grid.add([rays((math.atan2(1.0, 2.0), math.hypot(1.0, 2.0)))], ORIGIN)
    assert drawn(grid.cells(SURE).cropped()) == ["?.#", "..?"]


def test_a_wall_that_rays_meet_at_a_small_angle_has_no_free_cells() -> None:
    """The robot drives along a corridor of 1 m, and looks ahead."""
    grid, angles = OccupancyGrid(0.05), np.linspace(-0.6, 0.6, 140)
    poses = np.column_stack((np.linspace(0.0, 2.0, 9), np.zeros((9, 2))))
    walls = np.where(angles > 0.0, 0.51, -0.49)  # each in the middle of a row
    ahead = [np.minimum(walls / np.sin(angles), (8.01 - x) / np.cos(angles)) for x in poses[:, 0]]
    grid.add([range_scan(angles, ranges, np.zeros(3), 20.0) for ranges in ahead], poses)
    found = grid.cells(OccupancyConfig())
    column = int((3.5 - found.origin_xy[0]) / 0.05)

    def free(y: float) -> np.ndarray:
        row = found.values[int((y - found.origin_xy[1]) / 0.05), column : column + 60]
        return (row >= 0) & (row <= 25)

    assert not free(0.5).any() and not free(-0.5).any()
    assert free(0.25).all()


def test_probabilities_are_sums_of_log_odds() -> None:
    grid = OccupancyGrid(1.0)
    scan, pose = rays((0.0, 1.0)), ORIGIN
    for _ in range(2):
        grid.add([scan], pose)
    grid.add([rays((0.0, 2.0))], pose)
    # The second cell: two ends, one passage.
    odds = math.exp(2 * 0.9 - 0.5)
    first, second, third = grid.cells(OccupancyConfig(hit=0.9, passed=0.5)).cropped().values[0].tolist()
    assert second == round(100.0 * odds / (1.0 + odds)) == 79
    assert third == round(100.0 * math.exp(0.9) / (1.0 + math.exp(0.9))) == 71
    assert first == round(100.0 / (1.0 + math.exp(3 * 0.5))) == 18


def test_what_newer_epochs_saw_through_is_gone_and_a_person_is_not_a_wall() -> None:
    """Of a wall of 50 scans, 10 newer ones that see through it leave nothing; a single one leaves it."""
    grid, wall, beyond = OccupancyGrid(1.0), rays((0.0, 2.0)), rays((0.0, 4.0))
    grid.add([wall] * 50, np.zeros((50, 3)), np.repeat((3, 4), 25))
    grid.add([beyond], ORIGIN, np.array((5,)))
    assert drawn(grid.cells(OccupancyConfig()).cropped())[0][2] not in ".?"
    grid.add([beyond] * 9, np.zeros((9, 3)), np.full(9, 5))
    found = grid.cells(OccupancyConfig()).trinary(0.25, 0.65).cropped()
    assert drawn(found) == ["....#"]
    assert grid.cells(OccupancyConfig(settled=math.inf)).cropped().values[0, 2] == 100
    # One scan that ends where all others looked through is a person; three in a row are a thing.
    person = rays((0.0, 1.0))
    grid.add([person], ORIGIN, np.array((6,)))
    assert drawn(grid.cells(OccupancyConfig()).trinary(0.25, 0.65).cropped()) == ["....#"]
    grid.add([person] * 2, np.zeros((2, 3)), np.full(2, 6))
    assert drawn(grid.cells(OccupancyConfig()).trinary(0.25, 0.65).cropped()) == [".#..#"]


def test_a_scan_counts_once_in_a_cell_and_its_ends_win() -> None:
    grid = OccupancyGrid(1.0)
    # The two long rays pass the cell in which the short one ends, and both pass the first.
    grid.add([rays((0.0, 1.0), (0.01, 3.0), (-0.01, 3.0))], ORIGIN)
    values = grid.cells(OccupancyConfig(hit=1.0, passed=1.0)).cropped().values[0].tolist()
    once = round(100.0 / (1.0 + math.e))
    assert values == [once, 100 - once, once, 100 - once]


def test_a_ray_longer_than_the_largest_range_is_free_up_to_it() -> None:
    grid = OccupancyGrid(1.0)
    grid.add([rays((0.0, 9.0), max_range_m=3.0)], ORIGIN)
    assert drawn(grid.cells(SURE).cropped()) == ["..."]


def test_ranges_that_say_nothing_are_not_entered() -> None:
    grid = OccupancyGrid(1.0)
    grid.add([rays((0.0, math.nan), (0.1, math.inf), (0.2, 0.0), (0.3, -1.0))], ORIGIN)
    assert grid.cells(SURE).cropped().values.size == 0


def test_what_is_taken_out_leaves_no_trace() -> None:
    scans, poses = random_scans(40, 1)
    some, all_of_them = OccupancyGrid(0.05), OccupancyGrid(0.05)
    some.add(scans[:20], poses[:20])
    all_of_them.add(scans, poses)
    all_of_them.remove(scans[20:], poses[20:])
    for config in (OccupancyConfig(), SURE):
        before, after = some.cells(config).cropped(), all_of_them.cells(config).cropped()
        np.testing.assert_array_equal(before.values, after.values)
        np.testing.assert_array_equal(before.origin_xy, after.origin_xy)


def test_neither_order_nor_growth_nor_looks_in_between_change_the_map() -> None:
    scans, poses = random_scans(30, 2)
    epochs = np.arange(30) // 10
    together, one_by_one = OccupancyGrid(0.05), OccupancyGrid(0.05)
    together.add(scans, poses, epochs)
    for k in reversed(range(30)):
        one = scans[k : k + 1], poses[k : k + 1], epochs[k : k + 1]
        one_by_one.add(*one)
        one_by_one.cells(SURE if k % 7 else OccupancyConfig())
        if k % 3 == 0:
            one_by_one.remove(*one)
            one_by_one.cells(SURE)
            one_by_one.add(*one)
    np.testing.assert_array_equal(together.cells(SURE).values, one_by_one.cells(SURE).values)


def test_a_map_says_which_part_of_it_has_changed() -> None:
    scans, poses = random_scans(12, 4)
    grid, parts = OccupancyGrid(0.05), list[int]()
    grid.add(scans, poses)
    before = grid.cells(SURE)
    assert before.changed is None
    for k in range(12):
        grid.remove(scans[k : k + 1], poses[k : k + 1])
        grid.add(scans[k : k + 1], poses[k : k + 1] * 0.5)
        now = grid.cells(SURE)
        assert now.changed is not None
        outside = np.ones(now.values.shape, np.bool_)
        outside[now.changed] = False
        assert (now.values[outside] == before.values[outside]).all()
        parts.append(int(outside.sum()))
        before = now
    assert max(parts) > 0
    assert grid.cells(SURE).part(*grid.cells(SURE).changed).values.size == 0


def test_a_map_too_large_for_memory_is_refused_and_the_rest_stays() -> None:
    grid = OccupancyGrid(0.05)
    grid.add([rays((0.0, 3.0))], ORIGIN)
    before = grid.cells(SURE).values
    for x in (1e6, math.nan):
        with pytest.raises(MapTooLarge, match="expected at most 40000000 cells: use a coarser resolution"):
            grid.add([rays((0.0, 3.0))], np.array([[x, x, 0.0]]))
    np.testing.assert_array_equal(grid.cells(SURE).values, before)


def test_walls_of_a_corridor_fill_a_row_of_cells_each() -> None:
    """A robot drives along the middle of a corridor of 1 m: both walls are 10 cells away, to the rounding of floats."""
    angles = np.linspace(-2.6, 2.6, 241)
    ranges = np.minimum(0.5 / np.abs(np.sin(angles)), 4.0 + 1e-9)
    scan = range_scan(angles, ranges, np.zeros(3), 4.0)
    grid = OccupancyGrid(0.05)
    poses = np.column_stack((np.arange(0.0, 3.0, 0.06), np.zeros((50, 2))))
    grid.add([scan] * len(poses), poses)
    found = grid.cells(OccupancyConfig()).trinary(0.25, 0.65).cropped()
    assert (found.values[:, 20:60] == 100).sum(axis=1).tolist() == [40] + 19 * [0] + [40]


def test_the_sum_of_grids_is_the_grid_of_all_scans() -> None:
    scans, poses = random_scans(12, 3)
    whole, parts = OccupancyGrid(0.1), [OccupancyGrid(0.1) for _ in range(3)]
    epochs = np.arange(len(scans)) // 7
    whole.add(scans, poses, epochs)
    for k, part in enumerate(parts[:2]):  # the third has no scan
        part.add(scans[k::2], poses[k::2], epochs[k::2])
    found, expected = (grid.cells(OccupancyConfig()) for grid in (OccupancyGrid.summed(parts), whole))
    np.testing.assert_array_equal(found.values, expected.values)
    np.testing.assert_array_equal(found.origin_xy, expected.origin_xy)
    with pytest.raises(ValueError, match="expected one side"):
        OccupancyGrid.summed([whole, OccupancyGrid(0.2)])
