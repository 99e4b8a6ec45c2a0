"""The frame in which the demo's picture lays a map that begins at a robot's first pose."""

import numpy as np

from demo.explore_picture import in_frame_above, in_frame_of


def test_what_is_three_metres_ahead_of_a_robot_that_looks_along_y() -> None:
    pose = np.array((1.0, 2.0, np.pi / 2))
    np.testing.assert_allclose(in_frame_above(np.array(((3.0, 0.0), (0.0, 1.0))), pose), ((1.0, 5.0), (0.0, 2.0)))


def test_there_and_back_is_the_same_place() -> None:
    pose, points = np.array((-4.0, 7.0, 2.2)), np.random.default_rng(0).normal(size=(20, 2))
    np.testing.assert_allclose(in_frame_of(in_frame_above(points, pose), pose), points)
