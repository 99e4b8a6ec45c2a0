"""Evidence that a stretch of the way is, or is not, in a place: answers that are known."""

from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import rotated
from ngo_estimator.loops.place_evidence import PlaceEvidence, distinct_walls, place_evidence
from ngo_estimator.loops.walls_seen_through import PlacedScans, placed, range_profile
from tests.unit.ngo_estimator.loops.buildings import HALLWAY, outline, scan_at

POSES = np.array([(x, 1.0, 0.0) for x in np.arange(1.0, 4.0, 0.3)])
LONGER = np.concatenate((outline((0, 0), (14, 0), (14, 8), (0, 8)), HALLWAY[4:]))


def scans(walls: np.ndarray, seed: int = 0) -> PlacedScans:
    random = np.random.default_rng(seed)
    seen = [scan_at(walls, pose, random) for pose in POSES]
    return placed(seen, [range_profile(scan) for scan in seen], POSES)


def wall(start: tuple[float, float], angle: float, length_m: float) -> tuple[np.ndarray, np.ndarray]:
    along = np.stack((np.arange(0.0, length_m, 0.05), np.zeros(round(length_m / 0.05))), axis=1)
    normal = np.tile(rotated(angle, np.array(((0.0, 1.0),))), (len(along), 1))
    return rotated(angle, along) + start, normal


@pytest.mark.parametrize("turned", [0.0, 0.4, 2.0])
def test_walls_are_counted_however_long_they_are(turned: float) -> None:
    drawn = [wall((0.0, 0.0), 0.0, 9.0), wall((0.0, 2.0), 0.0, 5.0), wall((0.0, 2.4), 0.0, 1.0), wall((3, 0), 1.0, 2.0)]
    points, normals = (np.concatenate(arrays) for arrays in zip(*drawn, strict=True))
    assert distinct_walls(rotated(turned, points), rotated(turned, normals)) == 4
    assert distinct_walls(points, np.zeros_like(normals)) == 0


def test_the_same_place_agrees_and_another_one_is_seen_through() -> None:
    place, others = scans(HALLWAY), (scans(HALLWAY, 1), scans(LONGER, 1))
    same, other = (place_evidence(place, (stretch,)) for stretch in others)
    assert same.walls >= 7 and same.through < 0.02 and same.said == 2
    assert other.walls < same.walls and other.through > 0.05


def test_a_map_that_contradicts_itself_may_be_contradicted_and_a_place_as_likely_is_a_rival() -> None:
    steady, opened = scans(HALLWAY), scans(LONGER, 1)
    pairs = zip(vars(steady).values(), vars(opened).values(), strict=True)
    both = PlacedScans(*(np.concatenate(pair) for pair in pairs))
    assert place_evidence(steady, (steady,)).own == 0.0 and place_evidence(both, (steady,)).own > 0.003
    at, bent = PlaceEvidence(8, 0.5, 3, mean=0.1, own=0.02), PlaceEvidence(8, 0.5, 3, mean=0.1, own=0.002)
    assert at.suffices and not bent.suffices and not PlaceEvidence(7, 0.0, 3).suffices
    assert bent.rivals(at) and not bent.rivals(replace(at, mean=0.04)) and not replace(bent, walls=7).rivals(at)


def test_the_worst_part_of_the_stretch_counts_and_one_far_away_says_nothing() -> None:
    place, same, other = scans(HALLWAY), scans(HALLWAY, 1), scans(LONGER, 1)
    both = place_evidence(place, (same, other))
    assert both.through == place_evidence(place, (other,)).through and both.said == 4
    nothing = place_evidence(place, ())
    assert (nothing.walls, nothing.through, nothing.said) == (0, 0.0, 0)
