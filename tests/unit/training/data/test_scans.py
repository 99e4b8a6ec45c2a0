"""Simulated drives and scanners of the lidar's tables."""

import numpy as np
import pytest

from ngo_estimator.data.images import scan_image
from ngo_sim.episodes import Episode, record_episode
from training.data.building_drives import building_drive
from training.data.lidar_drives import TruePoses
from training.data.scans import ROWS, SCAN_IMAGE, ScannedMaze, Scanner
from training.data.simulated_drives import maze_drive, scanned_maze_drive
from training.data.worlds import WORLDS

SIZE = {"rows": 3, "cols": 3}
PERFECT = {"every": 1, "first": 0, "field_of_view_deg": 360.0, "noise_m": 0.0, "dropout": 0.0, "range_max_m": 100.0}


def episode(seed: int = 5, frames: int = 20, **changes: object) -> Episode:
    return record_episode(ScannedMaze(SCAN_IMAGE, SIZE, changes), "corners", frames, seed)


def test_an_episode_is_a_function_of_its_seed_alone() -> None:
    env = ScannedMaze(SCAN_IMAGE, SIZE)
    record_episode(env, "corners", 30, 4)
    again = record_episode(env, "corners", 20, 5)
    np.testing.assert_array_equal(again.observations, episode().observations)
    np.testing.assert_array_equal(again.poses_xyyaw, episode().poses_xyyaw)
    assert not np.array_equal(episode(6).observations, again.observations)
    with pytest.raises(ValueError, match="without a seed"):
        env.reset()


def test_noise_and_dropouts_are_those_asked_for() -> None:
    perfect = episode(**PERFECT).observations
    assert np.isfinite(perfect).all()
    # The rays of the scanner that are those of the format, so that nothing is interpolated.
    same = np.abs(np.degrees(SCAN_IMAGE.ray_angles_rad) % 0.5) < 1e-6
    noisy = episode(**{**PERFECT, "noise_m": 0.02}).observations - perfect
    assert noisy[:, same].std() == pytest.approx(0.02, rel=0.1) and abs(noisy[:, same].mean()) < 0.002
    coarse, fine = (np.isinf(episode(**{**PERFECT, "every": n, "dropout": 0.2}).observations).mean() for n in (4, 1))
    assert coarse == pytest.approx(0.2, abs=0.02)
    assert fine == pytest.approx(0.02, abs=0.01)  # most rays that it loses have another beside them


def test_what_is_drawn_is_in_its_ranges_and_varies() -> None:
    scanners = [Scanner.drawn(np.random.default_rng(seed)) for seed in range(300)]
    for values, low, high in (
        ([s.noise_m for s in scanners], 0.0, 0.03),
        ([s.dropout for s in scanners], 0.0, 0.05),
        ([s.range_max_m for s in scanners], 4.0, 30.0),
        ([s.field_of_view_deg for s in scanners], 180.0, 360.0),
    ):
        assert low <= min(values) < low + 0.1 * (high - low) and high - 0.2 * (high - low) < max(values) <= high
    assert {s.every for s in scanners} == {1, 2, 3, 4} and all(s.first < s.every for s in scanners)
    widths = [episode(seed, 1).maze.block_m for seed in range(20)]
    assert 0.8 <= min(widths) < 1.1 and 1.9 < max(widths) <= 2.5


def test_a_building_is_the_same_each_time_and_another_where_rooms_repeat() -> None:
    first, again = (building_drive(20_003, 3.0) for _ in range(2))
    aliased = building_drive(20_003, 3.0, aliased=True)
    assert len(first.scans) == len(first.wheels) > 10
    assert isinstance(first.reference, TruePoses)
    assert all(np.array_equal(a.ranges, b.ranges) for a, b in zip(first.scans, again.scans, strict=True))
    assert not np.array_equal(first.scans[0].ranges, aliased.scans[0].ranges)
    assert first.reference.stamps_ns.tolist() == [scan.stamp_ns for scan in first.scans]
    assert first.identity != aliased.identity


def test_a_scanned_maze_has_the_scans_that_the_networks_saw() -> None:
    frames = 5
    drive = scanned_maze_drive(1_500, frames, {})
    rng = np.random.default_rng(1_500)
    rows = int(rng.integers(ROWS[0], ROWS[1] + 1))
    size = {"rows": rows, "cols": rows, "extra_openings": int(rng.integers(0, 9))}
    episode = record_episode(ScannedMaze(SCAN_IMAGE, size, {}), WORLDS["maze2d"].driver, frames, 1_500)
    images = [
        scan_image(SCAN_IMAGE, scan.ranges, scan.angle_min, scan.angle_increment, 0.0, np.inf).reshape(-1)
        for scan in drive.scans
    ]
    np.testing.assert_allclose(images, episode.observations, atol=1e-6)
    assert isinstance(drive.reference, TruePoses)
    assert np.array_equal(drive.reference.poses_xyyaw, episode.poses_xyyaw)


def test_a_maze_is_seen_from_left_to_right() -> None:
    drive = maze_drive(1_500, 4)
    scan = drive.scans[0]
    assert (len(scan.ranges), drive.wheels) == (241, ())
    np.testing.assert_allclose(
        np.degrees((scan.angle_min, scan.angle_min + 240 * scan.angle_increment)), (150.0, -150.0), atol=1e-6
    )
