"""A robot that stands is told by its ranges."""

from collections.abc import Iterable

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.standstill import StandstillBelief, StandstillDetector
from ngo_recordings.scan_stream import LidarScan
from tests.unit.ngo_estimator.ray_casting import HALLWAY, ROOM, cast, fan

PERIOD_NS = 100_000_000
ANGLES = fan(241, 240.0)


def scan(ranges: np.ndarray, k: int) -> LidarScan:
    return LidarScan(k * PERIOD_NS, float(ANGLES[0]), 0.0175, ranges.astype(np.float32), 0.05, 30.0, 0.0, "laser")


def seen(poses: Iterable[np.ndarray], noise_m: float, segments: np.ndarray = ROOM) -> list[np.ndarray]:
    random = np.random.default_rng(3)
    return [cast(segments, pose, ANGLES) + random.normal(0.0, noise_m, len(ANGLES)) for pose in poses]


def said(ranges: Iterable[np.ndarray]) -> list[bool]:
    detector = StandstillDetector()
    return [detector.stands(scan(each, k)) for k, each in enumerate(ranges)]


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.05])
def test_a_robot_stands_from_the_second_second_on(noise_m: float) -> None:
    assert said(seen([np.array((1.0, 1.0, 0.2))] * 60, noise_m)) == [False] * 10 + [True] * 50


@pytest.mark.parametrize("noise_m", [0.0, 0.01, 0.05])
@pytest.mark.parametrize("step", [(0.03, 0.0, 0.0), (0.0, 0.0, 0.02)])
def test_a_robot_that_drives_or_turns_does_not_stand(noise_m: float, step: tuple[float, float, float]) -> None:
    assert not any(said(seen([np.array((1.0, 1.0, 0.2)) + k * np.array(step) for k in range(40)], noise_m)))


def test_a_turn_of_a_degree_in_a_smooth_corridor_is_seen() -> None:
    poses = [np.array((0.05 * k, 0.0, 0.02 * np.sin(0.4 * k))) for k in range(40)]
    assert np.mean(said(seen(poses, 0.01, HALLWAY))) < 0.2


def test_people_walk_past_a_robot_that_stands() -> None:
    ranges = np.array(seen([np.array((1.0, 1.0, 0.2))] * 40, 0.01))
    for k in range(40):
        ranges[k, 4 * k : 4 * k + 10] = 0.5
    assert all(said(ranges)[10:])


def test_it_says_nothing_of_scans_that_show_nothing() -> None:
    assert not any(said([np.full(241, np.inf)] * 30))
    assert not any(said([np.full(241, np.nan)] * 30))


def test_another_number_of_rays_is_another_scanner() -> None:
    ranges = seen([np.array((1.0, 1.0, 0.2))] * 40, 0.01)
    found = said([*ranges[:20], *(each[:121] for each in ranges[20:])])
    assert found[19] and not any(found[20:30]) and found[39]


def test_a_pause_is_a_second_too() -> None:
    detector = StandstillDetector()
    first, second = seen([np.array((1.0, 1.0, 0.2))] * 2, 0.01)
    assert not detector.stands(scan(first, 0))
    assert detector.stands(scan(second, 300))


@pytest.mark.parametrize(("speed", "since_s", "believed"), [(0.5, 0, True), (2.5, 0, False), (2.5, 3, True)])
def test_scans_that_do_not_change_are_believed_where_the_robot_may_have_braked(
    speed: float, since_s: int, believed: bool
) -> None:
    """Else a corridor shows nothing: what follows is not believed either, until a scan changes."""
    belief, told_ns = StandstillBelief(2.0), 10**12
    belief.observe(told_ns, speed)
    begin_ns = told_ns + since_s * 10**9 + 9 * PERIOD_NS
    assert [belief.stands(begin_ns + k * PERIOD_NS, True) for k in range(50)] == [believed] * 50
    assert not belief.stands(begin_ns + 50 * PERIOD_NS, False)
    assert belief.stands(begin_ns + 60 * PERIOD_NS, True)
