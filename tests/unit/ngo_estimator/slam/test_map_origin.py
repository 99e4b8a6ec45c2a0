"""Where the trajectory lies in the map: a rigid motion, and what its uncertainty does."""

import numpy as np

from ngo_estimator.slam.map_origin import MapOrigin

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
