"""What is published: poses in the frame of the map, corrections that are smoothed, and paths at a pace."""

import numpy as np
import pytest
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.publication_pace import PublicationPace
from ngo_estimator.slam.tf_smoothing import SmoothedCorrection

QUARTER = 0.5 * np.pi


def test_without_a_motion_poses_pass_as_they_are() -> None:
    poses, origin = np.random.default_rng(0).normal(size=(5, 3)), MapOrigin.of_first_pose(np.zeros(3))
    assert origin.poses(poses) is poses
    covariance = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(origin.covariance_of(poses[0], covariance), covariance)


def test_the_pose_that_was_given_becomes_what_was_given() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        own, given = rng.normal(size=3), rng.normal(size=3)
        np.testing.assert_allclose(MapOrigin.of_pose(own, given).poses(own), given, atol=1e-12)


def test_a_quarter_turn_solved_by_hand() -> None:
    origin = MapOrigin.of_pose(np.array([1.0, 0.0, 0.0]), np.array([5.0, 5.0, QUARTER]))
    np.testing.assert_allclose(origin.map_from_start_xyyaw, [5.0, 4.0, QUARTER])
    poses = origin.poses(np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]]))
    np.testing.assert_allclose(poses, [[5.0, 4.0, QUARTER], [5.0, 7.0, QUARTER]])
    turned = origin.covariance_of(poses[1], np.diag([1.0, 4.0, 9.0]))
    np.testing.assert_allclose(turned, np.diag([4.0, 1.0, 9.0]), atol=1e-12)


def test_an_uncertain_heading_widens_across_with_the_distance() -> None:
    origin = MapOrigin.of_pose(np.zeros(3), np.array([1.0, 1.0, 0.0]), np.diag([0.01, 0.04, 0.09]))
    at_given = origin.covariance_of(np.array([1.0, 1.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(at_given, np.diag([0.01, 0.04, 0.09]))
    ahead = origin.covariance_of(np.array([11.0, 1.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(ahead[1, 1], 0.04 + 100 * 0.09)
    np.testing.assert_allclose((ahead[0, 0], ahead[1, 2]), (0.01, 10 * 0.09))


BASE = np.array([100.0, -40.0, 2.0])
BEFORE, AFTER = np.array([1.0, 2.0, 3.0]), np.array([2.0, 1.0, -3.0])  # half a degree beyond pi and back
PERIOD_NS = 50_000_000


def at_robot(map_from_odom: np.ndarray) -> np.ndarray:
    return se2.compose(torch.from_numpy(map_from_odom), torch.from_numpy(BASE)).numpy()


def test_without_a_time_constant_the_newest_value_passes() -> None:
    smoothed = SmoothedCorrection(0.0)
    for k, value in enumerate((BEFORE, AFTER)):
        np.testing.assert_array_equal(smoothed.update(k, value, BASE), value)


def test_the_gap_shrinks_by_e_in_a_time_constant_on_a_straight_line_at_the_robot() -> None:
    smoothed = SmoothedCorrection(1.0)
    start, end = at_robot(smoothed.update(0, BEFORE, BASE)), at_robot(AFTER)
    way = end - start
    way[2] = np.remainder(way[2] + np.pi, 2 * np.pi) - np.pi
    for k in range(1, 101):
        shown = at_robot(smoothed.update(k * PERIOD_NS, AFTER, BASE))
        share = 1.0 - np.exp(-k * PERIOD_NS * 1e-9)
        np.testing.assert_allclose(shown[:2], start[:2] + share * way[:2], atol=1e-9)
        turned = np.remainder(shown[2] - start[2] + np.pi, 2 * np.pi) - np.pi
        assert turned == pytest.approx(share * way[2])


def test_it_arrives_exactly_and_stays() -> None:
    smoothed = SmoothedCorrection(0.1)
    smoothed.update(0, BEFORE, BASE)
    np.testing.assert_allclose(smoothed.update(10**12, AFTER, BASE), AFTER, atol=1e-9)


def test_a_reset_and_a_stamp_that_stands_still() -> None:
    smoothed = SmoothedCorrection(1.0)
    smoothed.update(5, BEFORE, BASE)
    np.testing.assert_allclose(smoothed.update(5, AFTER, BASE), BEFORE, atol=1e-9)
    smoothed.reset()
    np.testing.assert_array_equal(smoothed.update(5, AFTER, BASE), AFTER)


@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_a_time_constant_that_cannot_be_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match="expected 0 or more"):
        SmoothedCorrection(value)


def publications(rate_hz: float, offered_s: list[float], took_s: float) -> list[float]:
    """When something that is offered at these times is published."""
    pace, published = PublicationPace(rate_hz), []
    for now_s in offered_s:
        if pace.is_due(now_s):
            published.append(now_s)
            pace.published(now_s, now_s + took_s)
    return published


def test_the_first_comes_at_once_and_then_at_most_at_the_rate() -> None:
    offered = [0.0625 * k for k in range(33)]
    assert publications(4.0, offered, 0.001) == [0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0]


def test_what_takes_long_comes_more_seldom() -> None:
    """A tenth of all time at most: 45 ms every 450 ms."""
    assert publications(10.0, [0.25 * k for k in range(9)], 0.045) == [0.0, 0.5, 1.0, 1.5, 2.0]


def test_a_rate_of_zero_lets_everything_pass() -> None:
    offered = [0.001 * k for k in range(10)]
    assert publications(0.0, offered, 5.0) == offered


@pytest.mark.parametrize("rate_hz", [-1.0, float("nan"), float("inf")])
def test_a_rate_that_cannot_be_is_refused(rate_hz: float) -> None:
    with pytest.raises(ValueError, match="expected 0 or more"):
        PublicationPace(rate_hz)


def test_equal_publishers_have_parts_of_the_share() -> None:
    pace = PublicationPace(10.0, equals=4)
    pace.published(100.0, 100.1)
    assert not pace.is_due(103.9) and pace.is_due(104.1)
