"""The filter of the velocity: numbers that were worked out by hand, along a line."""

import numpy as np

from ngo_estimator.frontend.lidar.velocity_filter import VelocityFilter

STEADY = np.zeros(2)
VARIANCE = 0.01 * np.eye(3)


def carried(steps: int) -> VelocityFilter:
    """A filter after steps along x that nothing measured, from a velocity of one and variance 0.01."""
    found = VelocityFilter()
    found.begin(np.array((1.0, 0.0, 0.0)), VARIANCE, np.zeros((3, 3)))
    go_on(found, steps)
    return found


def go_on(found: VelocityFilter, steps: int) -> None:
    for _ in range(steps):
        foretold = found.predicted(0.0, found.velocity, 1.0, STEADY)
        found.correct(foretold, np.zeros(3), foretold[0][:3, :3])


def test_errors_of_the_velocity_add_up() -> None:
    """Three steps with the same error of the velocity: a variance of 3 squared times its own."""
    assert abs(carried(3).joint[0, 0] - 9.0 * 0.01) < 1e-9


def test_what_a_match_corrects_after_open_steps_is_shared_with_the_velocity() -> None:
    """A pose that is 0.4 off after three steps and a fourth means a velocity that is 0.1 off, and no jump."""
    found = carried(3)
    found.correct(found.predicted(0.0, found.velocity, 1.0, STEADY), np.array((0.4, 0.0, 0.0)), np.zeros((3, 3)))
    np.testing.assert_allclose(found.velocity, (1.1, 0.0, 0.0), atol=1e-6)


def test_a_change_of_the_velocity_is_learned_at_once_where_nothing_is_open() -> None:
    found = VelocityFilter()
    found.begin(np.array((1.0, 0.0, 0.0)), 1e-8 * np.eye(3), np.zeros((3, 3)))
    foretold = found.predicted(0.0, found.velocity, 1.0, np.array((0.1, 0.1)))
    found.correct(foretold, np.array((0.3, 0.0, 0.0)), 1e-8 * np.eye(3))
    np.testing.assert_allclose(found.velocity, (1.3, 0.0, 0.0), atol=1e-4)


def test_steps_between_key_scans_and_what_they_share_sum_to_the_whole() -> None:
    """Two and three steps: (2 + 3) squared is 2 squared and 3 squared and what the second has of the first."""
    found = carried(2)
    first = found.joint[:3, :3] + found.shared()
    found.begin_at_key()
    go_on(found, 3)
    second = found.joint[:3, :3] + found.shared()
    assert abs(first[0, 0] + second[0, 0] - 25.0 * 0.01) < 1e-8
