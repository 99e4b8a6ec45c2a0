import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from ngo_explorer.known_map import FREE, OCCUPIED, UNKNOWN, KnownMap

RADIUS_M, COMFORT_M = 0.22, 0.6


def known() -> KnownMap:
    return KnownMap(RADIUS_M, COMFORT_M)


def random_map(rng: np.random.Generator, rows: int, columns: int) -> np.ndarray:
    values = np.full((rows, columns), -1, np.int8)
    for _ in range(12):
        row, column = rng.integers(rows - 10), rng.integers(columns - 10)
        values[row : row + rng.integers(5, 60), column : column + rng.integers(5, 60)] = rng.choice((0, 0, 0, 100))
    return values


def placed(found: KnownMap, array: np.ndarray, shape: tuple[int, int], origin: np.ndarray) -> np.ndarray:
    """The part of an array of cells that a map of this shape and origin covers."""
    row, column = found.cell(origin + 0.5 * found.resolution_m)
    return array[row : row + shape[0], column : column + shape[1]]


def test_what_follows_from_the_cells_is_the_same_after_many_updates_as_after_one() -> None:
    rng = np.random.default_rng(3)
    followed, origin = known(), np.array((2.0, -1.0))
    values = random_map(rng, 150, 210)
    for number in range(8):
        row, column = rng.integers(100), rng.integers(150)
        part = slice(row, row + 40), slice(column, column + 50)
        values[part] = rng.choice((-1, 0, 100), values[part].shape, p=(0.1, 0.85, 0.05))
        followed.update(values, 0.05, origin, part if number % 2 else None)
    # The map grows to the lower left, as when a robot comes to a new wing.
    grown = np.pad(values, ((70, 0), (90, 30)), constant_values=-1)
    grown[:30, :40] = 0
    origin = origin - 0.05 * np.array((90, 70))
    followed.update(grown, 0.05, origin)
    fresh = known()
    fresh.update(grown, 0.05, origin)
    for name in ("state", "clearance_m", "frontier"):
        one, other = (placed(each, getattr(each, name), grown.shape, origin) for each in (followed, fresh))
        seen = grown != -1  # the clearance of a tile that nothing is known of does not matter
        np.testing.assert_array_equal(one[seen], other[seen], err_msg=name)
    assert followed.known_m2 == pytest.approx(fresh.known_m2) == np.count_nonzero(grown != -1) * 0.05**2
    assert len(followed.frontier_cells()) == np.count_nonzero(followed.frontier)


def test_clearance_is_the_distance_to_the_nearest_occupied_cell() -> None:
    values = random_map(np.random.default_rng(5), 120, 130)
    found = known()
    found.update(values, 0.05, np.zeros(2))
    exact = np.minimum(0.05 * distance_transform_edt(values != 100), COMFORT_M)
    np.testing.assert_allclose(placed(found, found.clearance_m, values.shape, np.zeros(2)), exact, atol=1e-6)


def test_cells_that_a_smaller_map_does_not_hold_are_unknown() -> None:
    found = known()
    found.update(np.zeros((100, 100), np.int8), 0.05, np.zeros(2))
    found.update(np.zeros((50, 50), np.int8), 0.05, np.zeros(2))
    assert found.known_m2 == pytest.approx(50 * 50 * 0.05**2)


def test_a_frontier_is_free_and_beside_the_unknown() -> None:
    values = np.full((9, 9), -1, np.int8)
    values[2:7, 2:7] = 0
    values[2, 2:7] = 100
    found = known()
    found.update(values, 0.1, np.zeros(2))
    expected = np.zeros((9, 9), bool)
    expected[3:7, [2, 6]] = expected[6, 2:7] = True
    np.testing.assert_array_equal(found.frontier[:9, :9], expected)


def test_another_resolution_is_refused() -> None:
    found = known()
    found.update(np.zeros((9, 9), np.int8), 0.1, np.zeros(2))
    with pytest.raises(ValueError, match="resolution"):
        found.update(np.zeros((9, 9), np.int8), 0.05, np.zeros(2))


@pytest.mark.parametrize("comfort_m", [0.6, 0.3])
def test_a_mark_stays_through_updates_until_it_is_forgotten(comfort_m: float) -> None:
    known, values = KnownMap(0.2, comfort_m), np.zeros((40, 40), np.int8)
    values[0] = 100
    known.update(values, 0.1, np.zeros(2))
    known.mark(np.array(((2.05, 2.05), (2.05, 0.25), (9.0, 9.0))))
    assert known.state[20, 20] == OCCUPIED and known.clearance_m[20, 22] == pytest.approx(0.2)
    assert known.state[2, 20] == FREE, "the wall beside it is the same"
    known.update(np.pad(values, ((0, 3), (2, 0))), 0.1, np.array((-0.2, 0.0)))
    assert known.state[known.cell(np.array((2.05, 2.05)))] == OCCUPIED
    grown, origin, mark = np.pad(values, ((0, 3), (2, 0))), np.array((-0.2, 0.0)), known.cell(np.array((2.05, 2.05)))
    for part in ((slice(15, 25), slice(20, 30)), (slice(0, 5), slice(0, 5))):
        known.update(grown, 0.1, origin, part)
        assert known.state[mark] == OCCUPIED
    assert known.forget_marks() and not known.forget_marks()
    assert known.state[mark] == FREE
    grown[20, 22] = -1
    known.update(grown, 0.1, origin, (slice(0, 5), slice(0, 5)))
    assert known.state[mark] == UNKNOWN, "after marks are forgotten the whole map says what is there"
