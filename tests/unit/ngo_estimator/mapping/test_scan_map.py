"""The map follows a trajectory that is corrected: it equals one that is drawn from scratch at the poses of now."""

import math
from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.mapping.occupancy_grid import MapTooLarge, OccupancyGrid
from ngo_estimator.mapping.range_scan import RangeScan, range_scan
from ngo_estimator.mapping.scan_map import ScanMap, ScanMapConfig, together

FRAMES = 60
STEP_NS = 100_000_000
# Every frame counts, and the slightest motion.
EVERY = ScanMapConfig(spacing_m=1e-9, most_at_a_place=1000, moved_cells=1e-9)


def scan(seed: int) -> RangeScan:
    rng = np.random.default_rng(seed)
    return range_scan(np.linspace(-2.0, 2.0, 31), rng.uniform(0.5, 6.0, 31), np.zeros(3), 5.0)


SCANS = [scan(seed) for seed in range(FRAMES)]


def path(bend: float = 0.0, frames: int = FRAMES) -> np.ndarray:
    """Poses of a drive that bends to the left by ``bend`` rad a frame."""
    yaw = bend * np.arange(frames)
    return np.column_stack((np.cumsum(0.2 * np.cos(yaw)), np.cumsum(0.2 * np.sin(yaw)), yaw))


def stamps(frames: int = FRAMES, first: int = 0) -> np.ndarray:
    return 1_000_000_000 + STEP_NS * np.arange(first, first + frames)


def take(scan_map: ScanMap, frames: range, odometry: np.ndarray | None = None, origin_ns: int = 1) -> None:
    odometry = path() if odometry is None else odometry
    for frame in frames:
        stamp = int(stamps()[frame])
        step = RelativeStep(
            stamp, stamp - STEP_NS, np.zeros(3), np.eye(3), origin_ns, odometry[frame], np.zeros(0), np.zeros(0)
        )
        scan_map.take(step, [(stamp, SCANS[frame])])


def from_scratch(frames: list[int], poses: np.ndarray, config: ScanMapConfig = EVERY) -> np.ndarray:
    grid = OccupancyGrid(config.resolution_m)
    grid.add([SCANS[frame] for frame in frames], poses[frames])
    return grid.cells(config.occupancy).cropped().values


def test_the_map_equals_one_from_scratch_after_every_correction() -> None:
    scan_map = ScanMap(EVERY)
    for frames, bend in ((20, 0.0), (40, 0.01), (60, -0.02), (60, 0.003)):
        take(scan_map, range(len(scan_map) + scan_map.waiting, frames))
        update = scan_map.update(stamps(frames), path(bend, frames))
        assert (len(scan_map), update.left, update.restarted) == (frames, 0, False)
        np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(frames)), path(bend)))


def test_without_time_the_rest_is_left_and_the_next_updates_do_it() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(), path())
    late = scan_map.update(stamps(), path(0.01), budget_s=0.0)
    assert (late.moved, late.left, late.changed) == (0, FRAMES - 1, False), "the first frame is where it was"
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(FRAMES)), path()))
    assert scan_map.update(stamps(), path(0.01)).left == 0
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(FRAMES)), path(0.01)))


def test_scans_that_moved_most_go_first(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ngo_estimator.mapping.scan_map._RAYS_AT_ONCE", 31 * 10)
    times = iter([0.0, 0.0, 1.0])  # the deadline, and one look at the clock before each ten scans
    scan_map = ScanMap(EVERY)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(), path())
    monkeypatch.setattr("time.monotonic", lambda: next(times))
    update = scan_map.update(stamps(), path(0.01), budget_s=0.5)
    monkeypatch.undo()
    assert 0 < update.moved < 12
    mixed = np.concatenate((path()[: FRAMES - update.moved], path(0.01)[FRAMES - update.moved :]))
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(FRAMES)), mixed))


def test_small_motions_leave_the_map_alone() -> None:
    config = replace(EVERY, moved_cells=0.25)
    scan_map = ScanMap(config)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(), path())
    reach = max(scan.reach_m for scan in SCANS)
    nearly = path() + np.array([0.0, 0.4 * 0.25 * 0.05, 0.4 * 0.25 * 0.05 / reach])
    assert not scan_map.update(stamps(), nearly).changed
    assert scan_map.update(stamps(), path() + np.array([0.0, 0.26 * 0.05, 0.0])).moved == FRAMES
    turned = path() + np.array([0.0, 0.26 * 0.05, 2.0 * math.pi])
    assert not scan_map.update(stamps(), turned).changed, "a whole turn is none"


def test_a_place_keeps_its_newest_scans() -> None:
    config = replace(EVERY, most_at_a_place=8)
    scan_map = ScanMap(config)
    there = np.column_stack((0.01 + 1e-3 * np.arange(FRAMES), np.full((FRAMES, 2), 0.01)))
    for first in range(0, FRAMES, 20):
        take(scan_map, range(first, first + 20), there)
        scan_map.update(stamps(first + 20), there[: first + 20])
        newest = list(range(first + 12, first + 20))
        assert len(scan_map) == 8
        np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(newest, there))


@pytest.mark.parametrize(("epoch_s", "drives"), [(600.0, 1), (1e6, 7)])
def test_a_box_that_was_taken_away_is_gone_after_one_drive(epoch_s: float, drives: int) -> None:
    """Eight drives saw it from twelve places, and later ones see through it, each in place of another scan.

    Within one epoch it is free once 2.2 hits are less than 0.7 passes by 1.1.
    """
    scan_map, poses = ScanMap(ScanMapConfig(epoch_s=epoch_s)), np.zeros((12, 3))
    poses[:, 0] = 0.6 * np.arange(12)
    known: list[int] = []
    for drive in range(8 + drives):
        assert drive < 9 or not _is_free(scan_map, 10.0)
        for pose in poses:
            known.append(10**9 * (1000 * drive + 1) + len(known))
            step = RelativeStep(known[-1], known[-1] - 1, np.zeros(3), np.eye(3), drive, pose, np.zeros(0), np.zeros(0))
            ranges = np.array(((10.0 if drive < 8 else 12.0) - pose[0],))
            scan_map.take(step, [(known[-1], range_scan(np.zeros(1), ranges, np.zeros(3), 20.0))])
        scan_map.update(np.array(known), np.tile(poses, (drive + 1, 1)))
    assert len(scan_map) == 8 * len(poses)
    assert _is_free(scan_map, 10.0)


def _is_free(scan_map: ScanMap, x_m: float) -> bool:
    """Whether the cell at a place on the x axis is free."""
    found = scan_map.cells()
    column, row = np.floor((np.array((x_m, 0.0)) - found.origin_xy) / found.resolution_m).astype(int)
    return bool(found.trinary(0.25, 0.65).values[row, column] == 0)


def test_a_scan_waits_for_its_pose() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(30))
    assert scan_map.update(stamps(10), path()[:10]).entered == 10
    assert scan_map.waiting == 20
    assert scan_map.update(stamps(30), path()[:30]).entered == 20


@pytest.mark.parametrize("origin_ns", [1, 2], ids=["same origin", "new origin"])
def test_a_source_that_starts_anew_begins_a_new_map(origin_ns: int) -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(), path())
    # The same stamps again, and an old trajectory comes once more before the new one does.
    take(scan_map, range(15), origin_ns=origin_ns)
    assert not scan_map.update(stamps(), path()).changed
    update = scan_map.update(stamps(10), path(0.02)[:10])
    assert (update.restarted, update.entered, scan_map.waiting) == (True, 10, 5)
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(10)), path(0.02)))


def test_the_map_goes_on_where_a_trajectory_goes_on_with_another_odometry() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(20))
    scan_map.update(stamps(20), path(0.01, 20))
    take(scan_map, range(20, 40), origin_ns=2)  # the robot is found at frame 30
    both = np.append(stamps(20), stamps(10, first=30)), np.concatenate((path(0.01, 20), path(0.01)[30:40]))
    assert not scan_map.update(*both).restarted
    frames = [*range(20), *range(30, 40)]
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(frames, path(0.01)))
    assert scan_map.waiting == 0, "of the frames before that it passed over, no pose will come"
    # Frames that it lets go take their scans along.
    stay = [*range(0, 30, 2), 29]
    assert scan_map.update(both[0][stay], both[1][stay]).changed
    fewer = [frames[k] for k in stay]
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(fewer, path(0.01)))
    assert (len(scan_map), scan_map.waiting) == (16, 0)


def test_a_trajectory_that_begins_later_begins_a_new_map() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(40), path()[:40])
    update = scan_map.update(stamps(10, first=50), path(0.02)[:10])
    assert (update.restarted, update.entered, len(scan_map), scan_map.waiting) == (True, 10, 10, 0)


def test_a_scan_far_outside_is_left_out_and_the_others_move() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(), path())
    poses = path(0.01)
    poses[30, :2] = 1e7
    update = scan_map.update(stamps(), poses)
    assert "use a coarser resolution" in update.too_large
    assert update.left >= 1


def test_a_map_too_large_for_its_cells_gets_larger_ones_by_itself() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(FRAMES))
    scan_map.update(stamps(), path())
    poses = path(0.01)
    poses[30:, :2] += 1500.0
    update = scan_map.update(stamps(), poses)
    cells = scan_map.cells()
    assert not update.too_large and update.left == 0 and len(scan_map) == FRAMES
    assert cells.resolution_m == scan_map.resolution_m == 8.0 * EVERY.resolution_m
    assert cells.values.size <= 40_000_000


def test_a_restored_map_is_drawn_again_and_goes_on() -> None:
    scan_map, again = ScanMap(EVERY), ScanMap(replace(EVERY, most_waiting=5))
    take(scan_map, range(40))
    scan_map.update(stamps(38), path(0.0, 38))  # two wait for their poses
    again.restore(scan_map.state())
    # Another odometry goes on, later.
    take(again, range(40, 44), origin_ns=2)
    again.update(stamps(44), path(0.01, 44))
    assert (len(again), again.waiting, again.lost) == (44, 0, 0)
    np.testing.assert_array_equal(again.cells().cropped().values, from_scratch(list(range(44)), path(0.01)))


def test_a_restored_map_of_another_trajectory_is_left_out() -> None:
    scan_map, again = ScanMap(EVERY), ScanMap(EVERY)
    take(scan_map, range(10))
    scan_map.update(stamps(10), path(0.0, 10))
    again.restore(scan_map.state())
    take(again, range(20, 24), origin_ns=2)
    again.update(stamps(4, first=20), path(0.0, 24)[20:])
    assert (len(again), again.waiting) == (4, 0)


def test_scans_that_are_withdrawn_leave_the_map_and_wait_for_their_poses() -> None:
    scan_map = ScanMap(EVERY)
    take(scan_map, range(30))
    scan_map.update(stamps(30), path(0.01, 30))
    assert scan_map.withdraw(stamps(10, first=20)) and not scan_map.withdraw(stamps(10, first=20))
    assert (len(scan_map), scan_map.waiting) == (20, 10)
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(20)), path(0.01)))
    scan_map.update(stamps(30), path(0.01, 30))
    np.testing.assert_array_equal(scan_map.cells().cropped().values, from_scratch(list(range(30)), path(0.01)))


def test_parts_of_a_trajectory_that_leave_it_and_come_again_are_drawn_again() -> None:
    scan_map = ScanMap(EVERY, parts=True)
    take(scan_map, range(30))
    for first in (20, 0, 10, 0):  # found where it is now, joined with where it was, and parted
        scan_map.update(stamps(30 - first, first), path(0.01, 30)[first:])
        assert (len(scan_map), scan_map.waiting) == (30 - first, first)
        drawn = from_scratch(list(range(first, 30)), path(0.01))
        np.testing.assert_array_equal(scan_map.cells().cropped().values, drawn)
    assert scan_map.withdraw() and (len(scan_map), scan_map.waiting) == (0, 30)


def test_maps_that_are_too_large_together_get_larger_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    maps = [ScanMap(EVERY), ScanMap(EVERY)]
    for one, away_m in zip(maps, (0.0, 90.0), strict=True):
        take(one, range(20))
        one.update(stamps(20), path(0.01, 20) + (away_m, 0.0, 0.0))
    most = max(one.cells().values.size for one in maps)
    monkeypatch.setattr("ngo_estimator.mapping.occupancy_grid._MOST_CELLS", most)
    whole = together(maps)
    assert whole.values.size <= most and whole.resolution_m > 0.05
    assert {one.resolution_m for one in maps} == {whole.resolution_m}
    monkeypatch.setattr("ngo_estimator.mapping.occupancy_grid._MOST_CELLS", 1)
    with pytest.raises(MapTooLarge):
        together(maps)


def test_maps_of_several_robots_make_one() -> None:
    maps = [ScanMap(EVERY), ScanMap(EVERY)]
    for one, frames in zip(maps, (range(20), range(20, 40)), strict=True):
        take(one, frames)
        one.update(stamps(40), path(0.01, 40))
    np.testing.assert_array_equal(maps[0].cells(maps[1:]).cropped().values, from_scratch(list(range(40)), path(0.01)))
