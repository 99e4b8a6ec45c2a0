"""A camera's ways are counted by wheels, and its key pictures are a map in which another drive is found."""

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.slam.joining import Joining
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from tests.unit.ngo_estimator.rendered_room import by_wheels, camera, drive, picture, rays_of

NOTHING = np.zeros(0, np.float32)
BEGIN_NS, PERIOD_NS = 1_000_000_000_000, 100_000_000


def steps_of(truth: np.ndarray, begin_ns: int) -> list[RelativeStep]:
    model = camera(240)
    odometry, rays, wheels = PictureOdometry(model), rays_of(model), by_wheels(truth)
    for k, pose in enumerate(truth):
        odometry.add_wheels(begin_ns + k * PERIOD_NS, wheels[k])
        odometry.add_picture(begin_ns + k * PERIOD_NS, picture(model, rays, pose))
    return list(odometry.ready(at_end=True))


def test_a_pose_is_as_unsure_as_the_wheels_scale_is_at_its_distance() -> None:
    core, covariance = PictureTrajectory(), np.eye(3) * 1e-8
    for k in range(1, 101):
        step = np.array((0.1, 0.0, 0.0)), np.array((0.1 * k, 0.0, 0.0))
        update = core.update(RelativeStep(k, k - 1, step[0], covariance, 0, step[1], NOTHING, NOTHING))
    std = np.sqrt(np.diagonal(update.covariance))
    assert 0.02 * 10.0 < std[0] < 0.21 and std[1] < 0.02


def test_another_drive_is_found_in_the_map_and_the_map_goes_on_with_it() -> None:
    whole, origin, first = drive(138), MapOrigin.of_first_pose(np.array((1.0, -2.0, 0.5))), PictureTrajectory()
    for step in steps_of(whole[:64], BEGIN_NS):
        first.update(step)
    first.finish()
    mapped = PictureTrajectory().restored(first.state())
    localisation, joining = mapped.localisation(origin), Joining(first, origin)
    truth = origin.poses(se2.between(whole[0], whole[80:]))
    off, joined = [], False
    for step, pose in zip(steps_of(whole[80:], BEGIN_NS + 200 * PERIOD_NS), truth[1:], strict=True):
        found = localisation.update(step).found
        assert not found.lost
        if found.pose_xyyaw is not None:
            off.append(se2.wrapped(found.pose_xyyaw - pose))
        if joined:
            off.append(se2.wrapped(origin.poses(first.update(step).pose_xyyaw) - pose))
        else:
            joined = joining.update(step).joined is not None
    assert joined and len(off) > 20
    assert np.abs(off)[:, :2].max() < 0.15 and np.abs(off)[:, 2].max() < 0.03
    assert (first.trajectory().loops[:, 1] > 64).any()  # type: ignore[union-attr]
