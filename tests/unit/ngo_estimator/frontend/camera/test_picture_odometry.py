"""Odometry of pictures where they, or the wheels, tell nothing."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.frontend.camera.feature_tracks import corners, followed, repeated
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.frontend.camera.tracked_odometry import _likelier
from ngo_estimator.geometry.camera_model import tilted
from ngo_estimator.geometry.planar_motion import between
from ngo_estimator.geometry.view_pose import ViewPose
from tests.unit.ngo_estimator.rendered_room import PLAIN, TILES, by_wheels, camera, drive, picture, rays_of

PERIOD_NS = 100_000_000


@pytest.mark.parametrize("black", [range(3), range(4, 6)])
def test_black_pictures_go_on_by_wheels(black: range) -> None:
    model, truth = camera(160), drive(10)
    rays, wheels = rays_of(model), by_wheels(truth)
    odometry = PictureOdometry(model)
    inliers = []
    for k, pose in enumerate(truth):
        seen = picture(model, rays, pose)
        odometry.add_wheels(k * PERIOD_NS, wheels[k])
        odometry.add_picture(k * PERIOD_NS, np.zeros_like(seen) if k in black else seen)
        assert len(list(odometry.ready())) == (k > 0)
        inliers.append(odometry.inliers)
    assert not any(inliers[k] for k in black) and inliers[-1] > 20
    assert odometry.by_wheels == len([k for k in range(1, 10) if k in black or k - 1 in black])


def dark(times_s: np.ndarray, wheels: list[tuple[float, np.ndarray]]) -> tuple[PictureOdometry, list[RelativeStep]]:
    """Steps in the dark with poses of the wheels by their stamps (s)."""
    odometry, steps = PictureOdometry(camera(160)), list[RelativeStep]()
    waiting = iter([*wheels, (math.inf, np.zeros(3))])
    stamp_s, pose = next(waiting)
    for time_s in times_s.tolist():
        while stamp_s <= time_s + 1e-6:
            odometry.add_wheels(round(stamp_s * 1e9), pose)
            stamp_s, pose = next(waiting)
        odometry.add_picture(round(time_s * 1e9), np.zeros((120, 160, 1), np.uint8))
        steps += odometry.ready()
    return odometry, steps


def test_nobody_is_sure_of_the_way_while_the_wheels_are_silent() -> None:
    def on_half_circle(time_s: float) -> np.ndarray:
        angle = np.pi * np.clip((time_s - 2.0) / 10.0, 0.0, 1.0)
        return np.array((np.sin(angle), 1.0 - np.cos(angle), angle))

    times_s = np.arange(0.0, 14.0, 0.1)
    heard = [(t, on_half_circle(t)) for t in times_s.tolist() if not 2.1 < t < 11.9]
    odometry, steps = dark(times_s, heard)
    gap_variance = 0.0
    for step in steps:
        begin, end = step.from_stamp_ns * 1e-9, step.stamp_ns * 1e-9
        off = step.relative_xyyaw - between(on_half_circle(begin), on_half_circle(end))
        assert off @ np.linalg.solve(step.covariance, off) < 9.0
        if begin > 1.9 and end < 12.1:
            gap_variance += step.covariance[0, 0]
        else:
            assert step.covariance[0, 0] < 0.01**2
    assert 4.0 < math.sqrt(gap_variance) < 6.0  # m/s for half of the gap, whatever the rate of the pictures
    assert odometry.unplaced == len(times_s) - len(steps) - 1 > 0  # more pictures than may wait


def test_slow_wheels_are_believed_from_reading_to_reading() -> None:
    times_s = np.arange(0.0, 5.0, 1.0)
    _, steps = dark(times_s, [(t, np.array((0.3 * t, 0.0, 0.0))) for t in times_s.tolist()])
    assert len(steps) == 4 and all(step.covariance[0, 0] < 0.02**2 for step in steps)


def test_wheels_that_start_again_elsewhere_are_not_believed() -> None:
    times_s = np.arange(0.0, 2.0, 0.1)
    wheels = [(t, np.array((0.3 * t + (10.0 if t < 1.0 else 0.0), 5.0 if t < 1.0 else 0.0, 0.0))) for t in times_s]
    odometry, steps = dark(times_s, wheels)
    assert odometry.jumps == 1
    assert steps[-1].odom_xyyaw == pytest.approx((0.3 * 1.9, 0.0, 0.0), abs=1e-6)
    open_m = [math.sqrt(step.covariance[0, 0]) for step in steps]
    assert np.argmax(open_m) == 9 and open_m[9] > 0.1 > 10.0 * open_m[8]


def test_a_clock_that_is_wrong_is_told_by_the_stamps() -> None:
    times_s = np.arange(0.0, 10.0, 0.1)
    for ahead_s in (30.0, -30.0):
        odometry, steps = dark(times_s + 100.0 + ahead_s, [(100.0 + t, np.zeros(3)) for t in times_s.tolist()])
        steps += odometry.ready(at_end=True)
        assert not steps and odometry.unplaced == 100
        newest = f"{109.9:.3f} s" if ahead_s > 0.0 else "none"
        assert odometry.clocks == f"newest stamp of pictures {109.9 + ahead_s:.3f} s, of odometry {newest}"


def test_a_pose_far_from_the_wheels_counts_where_far_more_corners_agree() -> None:
    def view(yaw: float, agree: int) -> ViewPose:
        return ViewPose(np.array((0.1, 0.0, yaw)), np.diag((1e-6, 1e-6, 1e-6)), np.arange(100) < agree)

    assert _likelier(view(0.0, 40), view(0.07, 60)).pose[2] == 0.0
    assert _likelier(view(0.0, 10), view(0.07, 60)).pose[2] == 0.07


def test_corners_of_stripes_look_alike_elsewhere() -> None:
    noise = cv2.GaussianBlur(np.random.default_rng(2).integers(0, 256, (120, 160), np.uint8), (0, 0), 2.5)
    stripes = np.tile(noise[:, :12], (1, 14))[:, :160]
    for grey, shares in ((cv2.equalizeHist(noise), (0.0, 0.1)), (cv2.equalizeHist(stripes), (0.8, 1.0))):
        at = corners(grey, 60, 6.0, np.zeros((0, 2)))
        at = at[(at > 25.0).all(1) & (at < (135, 95)).all(1)]
        there, found, residual = followed(grey, grey, at, at)
        for offset_px in (8.0, 25.0):
            alike = repeated(grey, grey, at, there, at + (offset_px, 0.0), residual)
            assert len(at) > 10 and found.all() and shares[0] <= alike.mean() <= shares[1]


def heading_stds(walls: np.ndarray, width: int, stride: int) -> np.ndarray:
    """Deviations (rad) of the heading of each step of a drive past such walls."""
    model, truth = camera(width), drive(6 * stride)[::stride]
    rays, wheels = rays_of(model), by_wheels(truth)
    odometry, steps = PictureOdometry(model), list[RelativeStep]()
    for k, pose in enumerate(truth):
        odometry.add_wheels(k * PERIOD_NS, wheels[k])
        odometry.add_picture(k * PERIOD_NS, picture(model, rays, pose, walls))
        steps += odometry.ready()
    return np.sqrt([step.covariance[2, 2] for step in steps])


def test_a_picture_is_no_surer_than_the_wheels_where_walls_repeat() -> None:
    by_wheels_alone = heading_stds(np.zeros_like(TILES), 160, 2)
    assert (heading_stds(TILES, 160, 2) > 0.99 * by_wheels_alone).all()
    assert (heading_stds(PLAIN, 160, 2) < 0.3 * by_wheels_alone).all()


def test_a_wide_picture_is_surer_than_the_wheels_where_nothing_repeats() -> None:
    assert (heading_stds(PLAIN, 640, 1) < 0.3 * heading_stds(np.zeros_like(PLAIN), 640, 1)).all()


def test_the_floor_tells_the_scale_and_where_it_is_not_seen_nobody_is_sure_of_the_way() -> None:
    model, truth = camera(320), drive(16)
    up = model.base_from_camera.copy()
    up[:, :3] = tilted(-0.6, 0.9)[:, :3]
    for mounted, floor in ((model.base_from_camera, True), (up, False)):
        seeing = replace(model, base_from_camera=mounted)
        rays, steps, odometry = rays_of(seeing), list[RelativeStep](), PictureOdometry(seeing, by_floor=True)
        for k, pose in enumerate(truth):
            odometry.add_picture(k * PERIOD_NS, picture(seeing, rays, pose))
            steps += odometry.ready()
        assert odometry.floorless == (0 if floor else 15)
        off_m = np.linalg.norm(steps[-1].odom_xyyaw[:2] - between(truth[0], truth[-1])[:2])
        std_m = math.sqrt(sum(step.covariance[0, 0] for step in steps))
        assert off_m < 3.0 * std_m
        assert off_m < 0.05 and std_m < 0.1 if floor else std_m > 0.2


def test_a_robot_that_stood_while_pictures_paused_stays_where_it_was() -> None:
    model, truth = camera(320), drive(8)
    rays, steps, odometry = rays_of(model), list[RelativeStep](), PictureOdometry(model, by_floor=True)
    for k, pose in enumerate((*truth, truth[-1])):
        stamp_ns = k * PERIOD_NS + (30_000_000_000 if k == len(truth) else 0)
        odometry.add_picture(stamp_ns, picture(model, rays, pose))
        steps += odometry.ready()
    assert odometry.inliers > 20 and np.abs(steps[-2].relative_xyyaw).max() > 0.05
    assert np.abs(steps[-1].relative_xyyaw).max() < 0.005
