"""Two views of a planar motion: exact where points are exact, with pitch, lever arm and distortion."""

import math

import numpy as np
import pytest

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import LOOKING_AHEAD, CameraModel, camera_mounting, tilted
from ngo_estimator.geometry.planar_views import epipolar_errors, minimal_motions, ransac
from ngo_estimator.geometry.view_pose import RangedRays, camera_at, fit_view, ray_errors, unmeasured

PINHOLE = np.array(((300.0, 0.0, 320.0), (0.0, 310.0, 240.0), (0.0, 0.0, 1.0)))
MOTION = np.array((0.5, 0.1, 0.3))
LENSES = {
    "plumb_bob": (-0.2, 0.05, 0.001, 0.0005, 0.0),
    "rational_polynomial": (0.1, 0.01, 0.0, 0.0, 0.0, 0.1, 0.01, 0.0),
    "equidistant": (0.01, -0.01, 0.002, 0.0),
}


def model_of(lens: str) -> CameraModel:
    return CameraModel(640, 480, PINHOLE, lens, np.array(LENSES[lens]), tilted(0.2, 0.8, 0.3))


def seen(lens: str, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, CameraModel]:
    """Rays to points ``(n, 3)`` before and after the motion, through pixels of a lens."""
    model, rays = model_of(lens), []
    for pose in (np.zeros(3), MOTION):
        offset = points - camera_at(pose, model.centre)
        offset[:, :2] = se2.rotate(np.asarray(-pose[2]), offset[:, :2])
        pixels, ahead = model.pixels(offset)
        assert ahead.all()
        rays.append(model.rays(pixels))
    return rays[0], rays[1], model


def points(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform((2.5, -1.5, 0.0), (9.0, 2.0, 2.0), (count, 3))


@pytest.mark.parametrize("lens", LENSES)
def test_two_points_tell_the_turn_and_the_direction(lens: str) -> None:
    first, second, model = seen(lens, points(2))
    _, motions = minimal_motions(first[None], second[None])
    way = camera_at(MOTION, model.centre) - model.centre
    off = np.abs(motions - (MOTION[2], np.arctan2(way[1], way[0])))
    assert np.minimum(off, np.pi - off).max(axis=1).min() < 1e-6  # the direction is known up to its sign


def test_wrong_pairs_and_repeated_ones_do_not_matter() -> None:
    first, second, _ = seen("plumb_bob", points(60))
    second[:20] = second[20:40]
    first[40:50], second[40:50] = first[40], second[40]  # features at one place
    found = ransac(first, second, 1e-3, 100)
    assert found is not None
    motion, agree = found
    assert abs(motion[0] - MOTION[2]) < 1e-3 and agree[20:].all() and agree[:20].mean() < 0.5
    assert epipolar_errors(first[20:], second[20:], motion[:1], motion[1:]).max() < 1e-3


def test_derivatives_are_those_of_the_errors() -> None:
    first, second, model = seen("plumb_bob", points(20))
    known = RangedRays(np.tile(model.centre, (20, 1)), first, np.full(20, 0.2), np.full(20, 0.01))
    pose, step = MOTION + 0.02, 1e-6
    errors, by_pose, by_inverse = ray_errors(known, second, pose, model.centre)
    moves = [(np.eye(3)[k] * step, np.zeros(3)) for k in range(3)] + [(np.zeros(3), np.array((0.0, 0.0, step)))]
    for k, (moved, raised) in enumerate(moves):
        there = ray_errors(known, second, pose + moved, model.centre + raised)[0]
        np.testing.assert_allclose((there - errors) / step, by_pose[:, :, k], atol=1e-5)
    nearer = RangedRays(known.origins, first, known.inverse + step, known.inverse_std)
    there = ray_errors(nearer, second, pose, model.centre)[0]
    np.testing.assert_allclose((there - errors) / step, by_inverse, atol=1e-5)


def test_rays_that_are_less_sure_do_not_turn_the_pose_together() -> None:
    first, second, model = seen("plumb_bob", points(60))
    second[:30] += 0.01 * np.array((-second[:30, 1], second[:30, 0], np.zeros(30))).T  # half, all in one sense
    second /= np.linalg.norm(second, axis=1, keepdims=True)
    anywhere, turns = (MOTION, np.diag((1e2, 1e2, 1.0))), []
    for std in (np.full(60, 1e-3), np.where(np.arange(60) < 30, 1e-2, 1e-3)):
        ranged = unmeasured(model.centre, first, 0.25)
        turns.append(fit_view(ranged, second, std, model.centre, MOTION + 0.01, anywhere, 1e-3, 1e-3).pose[2])
    off = np.abs(np.array(turns) - MOTION[2])
    assert off[1] < 1e-3 and off[0] > 2.0 * off[1]


def test_known_ranges_tell_the_scale_and_unknown_ones_leave_it_to_the_prior() -> None:
    where = points(40)
    first, second, model = seen("plumb_bob", where)
    std, far = np.full(40, 1e-3), np.linalg.norm(where - model.centre, axis=1)
    ranged = RangedRays(np.tile(model.centre, (40, 1)), first, 1.0 / far, np.full(40, 1e-4))
    nowhere = np.zeros(3), np.diag((1.0, 1.0, 1.0))
    found = fit_view(ranged, second, std, model.centre, np.zeros(3), nowhere, 1e-3, 1e-3)
    np.testing.assert_allclose(found.pose, MOTION, atol=1e-3)
    given = np.array((0.6, 0.12, 0.3)), np.diag((1e2, 1e2, 10.0))
    found = fit_view(unmeasured(model.centre, first, 0.25), second, std, model.centre, given[0], given, 1e-3, 1e-3)
    assert abs(found.pose[2] - MOTION[2]) < 1e-3
    way, true = (camera_at(pose, model.centre)[:2] - model.centre[:2] for pose in (found.pose, MOTION))
    assert abs(np.arctan2(way[1], way[0]) - np.arctan2(true[1], true[0])) < 5e-3
    assert 1.1 < np.linalg.norm(way) / np.linalg.norm(true) < 1.3
    assert np.sqrt(np.diag(found.covariance))[0] > 0.05


def test_a_frame_whose_z_is_up_is_the_cameras_body() -> None:
    np.testing.assert_array_equal(camera_mounting(np.zeros(3), np.eye(3))[:, :3], LOOKING_AHEAD)
    np.testing.assert_array_equal(camera_mounting(np.zeros(3), LOOKING_AHEAD)[:, :3], LOOKING_AHEAD)
    down = tilted(math.radians(30.0), 0.0)[:, :3]
    np.testing.assert_allclose(camera_mounting(np.zeros(3), down @ LOOKING_AHEAD.T)[:, :3], down)
    up = tilted(math.radians(-60.0), 0.0)[:, :3]
    np.testing.assert_array_equal(camera_mounting(np.zeros(3), up, optical=True)[:, :3], up)


@pytest.mark.parametrize(
    ("lens", "coefficients", "complaint"),
    [("polynomial", (), "the distortion is 'polynomial'"), ("plumb_bob", (0.1,), "has 1 coefficients")],
)
def test_an_unknown_lens_is_named(lens: str, coefficients: tuple[float, ...], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        CameraModel(640, 480, PINHOLE, lens, np.array(coefficients), tilted(0.0, 0.0))
    with pytest.raises(ValueError, match="not calibrated"):
        CameraModel(640, 480, np.zeros((3, 3)), "plumb_bob", np.zeros(0), tilted(0.0, 0.0))
