"""Evidence that a stretch of the way is, or is not, in a place: answers that are known."""

from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import rotated
from ngo_estimator.loops.place_evidence import _MOST_EVER, PlaceEvidence, distinct_walls, place_evidence
from ngo_estimator.loops.walls_seen_through import PlacedScans, placed, range_profile
from ngo_estimator.slam.own_map import _ELSEWHERE
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
    assert same.walls >= 7 and same.mean < 0.02 and same.said
    assert other.walls < same.walls and other.mean > 0.05


def test_a_map_that_contradicts_itself_may_be_contradicted_and_a_place_as_likely_is_a_rival() -> None:
    steady, opened = scans(HALLWAY), scans(LONGER, 1)
    pairs = zip(vars(steady).values(), vars(opened).values(), strict=True)
    both = PlacedScans(*(np.concatenate(pair) for pair in pairs))
    assert place_evidence(steady, (steady,)).own == 0.0 and place_evidence(both, (steady,)).own > 0.003
    at, bent = PlaceEvidence(8, mean=0.1, own=0.02), PlaceEvidence(8, mean=0.1, own=0.002)
    assert at.suffices and not bent.suffices and not PlaceEvidence(7).suffices
    better = replace(at, mean=0.04)
    assert bent.rivals(at) and not bent.rivals(better) and not replace(bent, walls=7).rivals(at)
    assert at.rivals(better) and not replace(at, walls=7).rivals(better), "what suffices is a rival of all"


def test_a_claim_is_never_made_where_it_would_be_taken_back() -> None:
    wrong = PlaceEvidence(99, mean=0.32, own=0.22)
    assert not wrong.suffices and not wrong.is_clear and replace(wrong, mean=0.29).suffices
    assert _MOST_EVER < _ELSEWHERE


def test_a_stretch_far_away_says_nothing() -> None:
    nothing = place_evidence(scans(HALLWAY), ())
    assert (nothing.walls, nothing.mean, nothing.said) == (0, 0.0, False)
