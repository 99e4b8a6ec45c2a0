import numpy as np
import pytest

from ngo_estimator.view.tracks import StampedPoses, Track, begun_with_identity, placed, position_rmse_m

S = 1_000_000_000


def poses(*rows: tuple[float, float, float, float]) -> StampedPoses:
    """Rows of time (s), x, y, yaw."""
    values = np.array(rows)
    return StampedPoses((values[:, 0] * S).astype(np.int64), values[:, 1:])


def track(*rows: tuple[float, float, float, float]) -> Track:
    made, values = Track(), poses(*rows)
    for stamp, pose in zip(values.stamps_ns.tolist(), values.poses_xyyaw, strict=True):
        made.append(stamp, pose)
    return made


def test_a_track_keeps_its_poses_in_order_and_begins_anew_with_its_source() -> None:
    made = track((1, 0, 0, 0), (2, 1, 0, 0), (2, 9, 9, 0), (1.5, 9, 9, 0))
    assert made.stamps_ns.tolist() == [S, 2 * S]
    np.testing.assert_array_equal(made.poses_xyyaw[:, 0], [0.0, 1.0])
    made.append(S, np.array([5.0, 6.0, 7.0]))  # 1 s back
    assert made.stamps_ns.tolist() == [S]
    np.testing.assert_array_equal(made.poses_xyyaw, [[5.0, 6.0, 7.0]])


def test_poses_between_stamps_turn_the_short_way() -> None:
    between = poses((0, 0, 0, 3.0), (1, 2, 4, -3.0)).at(np.array([S // 2]))
    np.testing.assert_allclose(between[0, :2], [1.0, 2.0])
    assert abs(between[0, 2]) == pytest.approx(np.pi)


def test_a_track_is_laid_over_the_first_pose_that_it_shares() -> None:
    """The truth is known from 1 s on, in a frame that is turned by 90 degrees."""
    corrected = poses((0, 0, 0, 0), (1, 1, 0, 0), (2, 2, 0, 0))
    truth = poses((1, 5, 5, np.pi / 2), (2, 5, 6, np.pi / 2), (3, 4, 6, np.pi))
    here = placed(truth, corrected)
    assert here is not None
    np.testing.assert_allclose(here.poses_xyyaw, [[1, 0, 0], [2, 0, 0], [2, 1, np.pi / 2]], atol=1e-12)
    assert placed(poses((8, 0, 0, 0)), corrected) is None


def test_odometry_begins_with_the_identity_in_the_first_frame_alone() -> None:
    corrected = poses((1, 4, 4, 0), (2, 5, 4, 0), (3, 6, 4, 0))
    heard_from_the_start = begun_with_identity(track((2, 1, 0, 0), (3, 2, 0, 0)), corrected)
    assert heard_from_the_start.stamps_ns.tolist() == [S, 2 * S, 3 * S]
    np.testing.assert_array_equal(heard_from_the_start.poses_xyyaw[0], np.zeros(3))
    for rows in ([(3.0, 2.0, 0.0, 0.0)], [(0.5, 7.0, 7.0, 0.0), (2.0, 8.0, 7.0, 0.0)]):
        own = begun_with_identity(track(*rows), corrected)
        assert len(own.stamps_ns) == len(rows), "heard late, or the robot's own from before"


def test_the_error_is_the_rmse_over_the_stamps_that_both_cover() -> None:
    truth = poses((0, 0, 0, 0), (4, 4, 0, 0))
    off = poses((1, 1, 3, 0), (2, 2, 4, 0), (9, 9, 9, 0))
    assert position_rmse_m(off, truth, np.array([1, 2, 8]) * S) == pytest.approx(np.sqrt((9 + 16) / 2))
    assert position_rmse_m(off, truth, np.array([8 * S])) is None
