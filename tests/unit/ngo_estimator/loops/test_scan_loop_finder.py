"""Loops of lidar key scans are right, and refused where they can't be told from wrong ones."""

import dataclasses
import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.scan_points import key_scan
from ngo_estimator.loops.scan_loop_candidates import covariance_windows
from ngo_estimator.loops.scan_loop_finder import ScanLoopFinder
from ngo_estimator.loops.scan_loops import EVIDENCE, ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig, ScanLoopConfig, WindowConfig
from tests.unit.ngo_estimator.loops.buildings import (
    HALLWAY,
    MOUNTING,
    TWICE,
    between,
    drifted,
    outline,
    scan_at,
    way,
)


def scanned(walls: np.ndarray, poses: np.ndarray) -> list[KeyScan]:
    random = np.random.default_rng(1)
    return [scan_at(walls, pose, random) for pose in poses]


def found(
    scans: list[KeyScan], poses: np.ndarray, config: ScanLoopConfig | None = None, windows: WindowConfig | None = None
) -> ScanLoops:
    """All loops of keys that come one by one, under poses that no loop corrects."""
    finder = ScanLoopFinder(ScanGraphConfig(config or ScanLoopConfig()))
    for count in range(1, len(scans) + 1):
        seen = poses[:count]
        # These poses stay as they are, so that their drift goes on through the loops.
        known = np.arange(count, 0, -1)[:, None, None] * np.diag((2e-3, 2e-3, 2e-4))
        finder.find(scans[:count], seen, covariance_windows(windows or WindowConfig(), known))
    return finder.loops


def errors(loops: ScanLoops, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    off = between(between(truth[loops.pairs[:, 0]], truth[loops.pairs[:, 1]]), loops.relative)
    return np.linalg.norm(off[:, :2], axis=1), np.degrees(np.abs(off[:, 2]))


def test_loops_of_a_second_round_are_right() -> None:
    drift = drifted(TWICE, (0.004, 0.002, 0.002))
    assert np.linalg.norm(drift[-1, :2] - TWICE[-1, :2]) > 0.5
    loops = found(scanned(HALLWAY, TWICE), drift)
    metres, degrees = errors(loops, TWICE)
    assert loops.accepted.sum() >= 20
    assert metres[loops.accepted].max() < 0.12 and np.median(metres[loops.accepted]) < 0.04
    assert degrees[loops.accepted].max() < 2.0
    assert (loops.pairs[:, 0] < loops.pairs[:, 1]).all()
    assert (np.linalg.eigvalsh(loops.covariance) > 0.0).all()


def test_evidence_tells_why_a_loop_was_accepted() -> None:
    config = ScanLoopConfig()
    loops = found(scanned(HALLWAY, TWICE), TWICE)
    response, second, on_lines, through, disagreement, agreeing = loops.evidence[loops.accepted].T
    assert len(EVIDENCE) == loops.evidence.shape[1]
    assert (response >= config.least_response).all() and (second <= config.most_second).all()
    assert (on_lines >= config.least_on_lines).all() and (through <= config.most_seen_through).all()
    assert (disagreement <= config.most_disagreement).all() and (agreeing >= 1).all()


def test_a_loop_is_accepted_when_a_neighbour_agrees() -> None:
    scans, finder = scanned(HALLWAY, TWICE), ScanLoopFinder(ScanGraphConfig(ScanLoopConfig(most_per_key=1)))
    for count in range(1, len(scans) + 1):
        fresh = finder.find(scans[:count], TWICE[:count], np.tile((0.5, 0.5, 0.2), (count, 1)))
        assert finder.loops.accepted[fresh].all()
        if len(finder.loops) == 1:
            assert not finder.loops.accepted.any() and len(fresh) == 0
        elif len(finder.loops) == 2:
            # The second makes both acceptable, and both are given out, once.
            assert len(fresh) == 2 and finder.loops.accepted.all()
            break
    else:
        pytest.fail("no two loops were found")


def test_work_and_memory_for_a_key_are_bounded() -> None:
    config = ScanLoopConfig(most_per_key=1, most_submaps=2)
    scans, finder = scanned(HALLWAY, TWICE), ScanLoopFinder(ScanGraphConfig(config))
    for count in range(1, len(scans) + 1):
        finder.find(scans[:count], TWICE[:count], np.tile((0.5, 0.5, 0.2), (count, 1)))
        assert len(finder._submaps) <= 2
    _, each = np.unique(finder.loops.pairs[:, 1], return_counts=True)
    assert len(each) > 5 and each.max() == 1


def visits(*places: tuple[float, float]) -> np.ndarray:
    """Five poses at each place, close together."""
    return np.array([(x + 0.1 * k, y, 0.2 + 0.05 * k) for x, y in places for k in range(5)])


ROOM = outline((0, 0), (4, 0), (4, 3), (2.5, 3), (2.5, 3.8), (0, 3.8))
FAR_OFF = outline((0, 20), (9, 20), (9, 27), (3, 29))


@pytest.mark.parametrize(("apart_m", "believed"), [(4.08, False), (40.0, True)])
def test_two_rooms_that_are_alike_are_refused_as_not_unique(apart_m: float, believed: bool) -> None:
    """The submap of the first visits holds both rooms: where both are in reach, neither is believed."""
    walls = np.concatenate((ROOM, ROOM + (apart_m, 0, apart_m, 0), FAR_OFF))
    poses = visits((1.0, 1.5), (1.0 + apart_m, 1.5), (2, 22), (5, 22), (5, 24), (2, 24), (2, 22), (5, 24), (1.0, 1.5))
    config = ScanLoopConfig(every=1, place_step=1, submap_keys=11, least_gap_m=5.0)
    loops = found(scanned(walls, poses), poses, config, WindowConfig(least_m=5.0))
    # The last two keys see the room alone: the four scans that are searched together were all taken in it.
    back = loops.accepted & (loops.pairs[:, 1] >= len(poses) - 2)
    assert back.any() == believed
    assert (loops.pairs[back, 0] < 5).all()


def test_walls_that_were_seen_through_are_refused() -> None:
    """A partition was built since the first visit: most lines fit, but they lie behind it."""
    poses = visits((1.0, 1.5), (2, 22), (5, 22), (5, 24), (2, 24), (2, 22), (5, 24), (1.0, 1.5))
    hall = np.concatenate((outline((0, 0), (7, 0), (7, 3), (5, 3), (5, 4), (0, 4)), FAR_OFF))
    partition = np.array(((3.5, 0.8, 3.6, 2.4),))
    before, after = scanned(hall, poses[:-5]), scanned(np.concatenate((hall, partition)), poses[-5:])
    config = ScanLoopConfig(every=1, place_step=1, submap_keys=5, least_gap_m=5.0)
    tolerant = found(before + after, poses, dataclasses.replace(config, most_seen_through=1.0))
    back = tolerant.pairs[:, 1] >= len(poses) - 2
    assert tolerant.accepted[back].any()
    assert (tolerant.evidence[back, EVIDENCE.index("seen_through")] > config.most_seen_through).all()
    strict = found(before + after, poses, config)
    assert len(strict) and not (strict.pairs[:, 1] >= len(poses) - 2).any()


def test_a_loop_in_a_corridor_is_uncertain_along_it() -> None:
    corridor = outline((-30, 0), (30, 0), (30, 2), (-30, 2))
    there = way((-4.0, 1.0), (4.0, 1.0), (-4.0, 1.0), (4.0, 1.0))
    random = np.random.default_rng(1)
    scans = [scan_at(corridor, pose, random, farthest_m=8.0) for pose in there]
    loops = found(scans, there, ScanLoopConfig(most_second=1.0))
    assert loops.accepted.any()
    along, across = np.sqrt(loops.covariance[:, 0, 0]), np.sqrt(loops.covariance[:, 1, 1])
    assert (along > 10.0 * across).all()


def test_scans_that_see_nothing_have_no_loops() -> None:
    random = np.random.default_rng(0)
    nothing = [scan_at(outline((100, 0), (101, 0), (101, 1)), pose, random) for pose in TWICE]
    assert all(len(scan.points) == 0 for scan in nothing)
    assert len(found(nothing, TWICE)) == 0
    half = len(TWICE) // 2
    # Submaps at the end of the first half hold the first keys that see something.
    late = found(nothing[:half] + scanned(HALLWAY, TWICE)[half:], TWICE).pairs[:, 0]
    assert (late > half - ScanLoopConfig().submap_keys).all()


def test_loops_of_the_newest_keys_wait_when_others_are_let_go() -> None:
    finder, scans = ScanLoopFinder(ScanGraphConfig()), scanned(HALLWAY, np.zeros((8, 3)))
    for scan in scans:
        finder.views.append(scan)
    pairs = np.array(((0, 2), (1, 3), (0, 6), (1, 7)))
    finder.add(ScanLoops(pairs, np.zeros((4, 3)), np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 6)), np.ones(4, bool)))
    newest = np.isin(np.arange(8), (3, 7))  # the ends of two streams
    finder.thin(np.arange(8) != 4, ScanLoops.none(), newest)
    np.testing.assert_array_equal(finder.loops.pairs, ((1, 3), (1, 6)))


def test_wrong_shapes_are_refused() -> None:
    scans = scanned(HALLWAY, TWICE[:2])
    with pytest.raises(ValueError, match="expected \\(keys, 3\\)"):
        ScanLoopFinder(ScanGraphConfig()).find(scans, TWICE[:3], np.ones((2, 3)))
    with pytest.raises(ValueError, match="narrowest"):
        ScanLoopFinder(ScanGraphConfig(ScanLoopConfig(every=1))).find(scans, TWICE[:2], np.zeros((2, 3)))


@pytest.mark.skipif("NGO_LIDAR_LOGS" not in os.environ, reason="NGO_LIDAR_LOGS, the folder of real logs, is not set")
@pytest.mark.parametrize("name", ["freiburg-101", "seattle", "belgioioso"])
def test_loops_of_real_buildings_are_right(name: str) -> None:
    scans, truth = corrected_log(Path(os.environ["NGO_LIDAR_LOGS"]) / "radish" / f"{name}.log.gz")
    random = np.random.default_rng(0)
    steps = np.abs(between(truth[:-1], truth[1:]))[:, :1]
    drift = drifted(truth, random.normal(0.0, 1.0, (len(truth) - 1, 3)) * (0.01 * steps + 0.005) * (1.0, 1.0, 0.3))
    loops = found(scans, drift)
    metres, degrees = errors(loops, truth)
    assert loops.accepted.sum() >= 15
    assert metres[loops.accepted].max() < 0.5 and degrees[loops.accepted].max() < 5.0


def corrected_log(path: Path) -> tuple[list[KeyScan], np.ndarray]:
    """Scans of a CARMEN log and the poses that GMapping gave them."""
    scans, poses = [], []
    with gzip.open(path, "rt") as lines:
        for words in map(str.split, lines):
            if words[:1] == ["FLASER"]:
                count = int(words[1])
                ranges = np.array(words[2 : 2 + count], float)
                angles = np.radians(np.linspace(-90.0, -90.0 + (count - 1) * (0.5 if count > 200 else 1.0), count))
                scans.append(key_scan(0, angles, ranges, (0.05, 81.8), MOUNTING))
                poses.append([float(word) for word in words[2 + count : 5 + count]])
    return scans, np.array(poses)


def test_angles_of_buildings_are_right() -> None:
    """The scanner of these tests sees a wall at its distance."""
    scan = scan_at(outline((-1, -1), (3, -1), (3, 1), (-1, 1)), np.zeros(3), np.random.default_rng(0))
    assert scan.ranges[90] == pytest.approx(3.0, abs=0.05)
    assert scan.ranges[180] == pytest.approx(1.0, abs=0.05)
    assert math.isclose(scan.angles[90], 0.0, abs_tol=1e-12)
