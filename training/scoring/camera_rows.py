"""Drives of a camera through Doom maps, with the motion of simulated wheels, and the rows that are measured on them."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np

from ngo_estimator.frontend.camera import tracked_odometry
from ngo_estimator.frontend.camera.camera_config import CameraConfig
from ngo_estimator.frontend.camera.picture_odometry import PictureOdometry
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.camera_model import CameraModel, tilted
from ngo_estimator.geometry.planar_views import epipolar_errors, ransac
from ngo_estimator.graph.corrector import CorrectedGraph, GraphProblem
from ngo_estimator.loops import picture_fit
from ngo_estimator.slam.picture_back_end import PictureBackEnd
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from ngo_sim.episodes import record_episode
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from training.baselines.graph_peers import least_squares
from training.data.doom_drives import Map
from training.scoring.metrics import absolute_error_m, path_length_m, trajectory_error, within
from training.scoring.table import Measured

Ablation = Literal["nothing", "tracks", "points", "planar", "sift", "corrector", "wheels"]

_EYE_M = 41.0 / 32.0
_AHEAD = 0.2
"""Forward part of a ray that the plane of a picture holds."""

_OPTICAL = np.array(((0.0, -1.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)))
"""Axes of optics (right, down, ahead) by those of the base."""

_WRONG_M, _WRONG_RAD = 0.5, np.radians(5.0)
"""A loop that is off by more is wrong."""


@dataclass(frozen=True)
class CameraDrive:
    """Grey pictures of a drive, its true poses ``(frames, 3)`` from the first on, those by wheels, and the camera."""

    pictures: list[np.ndarray]
    truth: np.ndarray
    given: np.ndarray
    camera: CameraModel
    period_s: float


def camera_drive(of: Map, seed: int, frames: int, wheels_seed: int) -> CameraDrive:
    """A drive of the explorer on a map, with wheels of their own seed."""
    return _drive(Maze3DConfig(wad=of[0], map=of[1], width=320, height=240), "explorer", seed, frames, wheels_seed)


def maze_drive(seed: int, frames: int) -> CameraDrive:
    """A drive through a maze with 35 pictures a second and steps of about 0.1 m, as a fast robot takes them."""
    config = Maze3DConfig(width=320, height=240, frame_skip=1, thrust=12, turn_deg=1.1)
    return _drive(config, "random_goals", seed, frames, seed)


def _drive(config: Maze3DConfig, driver: str, seed: int, frames: int, wheels_seed: int) -> CameraDrive:
    world, pictures = Maze3D(config, render_mode="rgb_array"), []

    def watch(world: Maze3D, _: np.ndarray) -> None:
        picture = world.render()
        assert picture is not None
        pictures.append(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY))

    try:
        poses = record_episode(world, driver, frames, seed, watch=watch).poses_xyyaw
    finally:
        world.close()
    across, down = (2.0 * focal for focal in config.focal_lengths_px)
    matrix = np.array(((across, 0.0, 319.5), (0.0, down, 239.5), (0.0, 0.0, 1.0)))
    camera = CameraModel(640, 480, matrix, "plumb_bob", np.zeros(0), tilted(0.0, _EYE_M))
    truth = se2.between(poses[:1], poses)
    return CameraDrive(pictures, truth, given_motion(truth, wheels_seed), camera, config.period_s)


def given_motion(truth: np.ndarray, seed: int) -> np.ndarray:
    """Poses ``(frames, 3)`` by wheels that nobody calibrated, for true ones from the origin on.

    For the whole drive they count way and turn wrong by shares (1 % and 2 %, deviations of the drives) and turn with
    the way (0.02 rad/m). In each step noise grows with the root of the way (0.015 m and 0.02 rad at 1 m) and with the
    turn (3 %).
    """
    rng, steps = np.random.default_rng([seed, 48]), se2.between(truth[:-1], truth[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])
    share, turn, drift = 1.0 + rng.normal(0.0, 0.01), 1.0 + rng.normal(0.0, 0.02), rng.normal(0.0, 0.02)
    noise = rng.standard_normal((len(steps), 3)) * np.sqrt(way)[:, None] * (0.015, 0.015, 0.02)
    counted = steps * (share, share, turn) + noise
    counted[:, 2] += drift * way + rng.standard_normal(len(steps)) * 0.03 * np.abs(steps[:, 2])
    poses = np.zeros((len(truth), 3))
    for frame, step in enumerate(counted):
        poses[frame + 1] = se2.compose(poses[frame], step)
    return poses


class _Orb:
    """A ``Describer``: ORB (Rublee et al. 2011), each bit a number."""

    def __init__(self, most: int) -> None:
        self._orb = cv2.ORB.create(nfeatures=most)

    def describe(self, grey: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found, codes = self._orb.detectAndCompute(grey, None)
        if len(found) == 0:
            return np.zeros((0, 2)), np.zeros(0), np.zeros((0, 256), np.float32)
        bits = np.unpackbits(np.asarray(codes, np.uint8), axis=1).astype(np.float32)
        std = 0.5 * 1.2 ** np.array([point.octave for point in found])  # pixels of its level of the pyramid
        return np.array([point.pt for point in found]), std, (bits - 0.5) / 8.0


class _Believes:
    """A ``Corrector`` that believes all loops."""

    def correct(self, problem: GraphProblem, start: CorrectedGraph | None = None) -> CorrectedGraph:
        loops, steps = np.ones(len(problem.loops)), np.ones(len(problem.steps))
        return CorrectedGraph(problem, least_squares(problem), loops, steps, 0.0)


class _BelievingTrajectory(PictureTrajectory):
    def _new_back_end(self) -> PictureBackEnd:
        back_end = super()._new_back_end()
        back_end._corrector = _Believes()
        return back_end


def five_points(
    first: np.ndarray,
    second: np.ndarray,
    tolerance_rad: np.ndarray | float,
    samples: int,
    near: tuple[float, float] = (0.0, np.pi),
) -> tuple[np.ndarray, np.ndarray] | None:
    """As ``planar_views.ransac``, by five points of any motion (Nister 2004), whose yaw and direction count."""
    ahead = np.flatnonzero((first[:, 0] > _AHEAD) & (second[:, 0] > _AHEAD))
    if len(ahead) < 5:
        return None
    (a, b), tolerance = (-rays[ahead, 1:] / rays[ahead, :1] for rays in (first, second)), np.median(tolerance_rad)
    essential, agree = cv2.findEssentialMat(
        a, b, np.eye(3), cv2.RANSAC, prob=0.999, threshold=float(tolerance), maxIters=samples
    )
    if essential is None or essential.shape != (3, 3):
        return None
    _, turn, moved, _ = cv2.recoverPose(essential, a, b, np.eye(3), mask=agree)
    back = (_OPTICAL.T @ turn @ _OPTICAL).T  # in base axes: from the second picture's to the first's
    motion = np.array((np.arctan2(back[1, 0], back[0, 0]), np.arctan2(*(-back @ _OPTICAL.T @ moved)[1::-1, 0])))
    if abs(se2.wrap(motion[0] - near[0])) > near[1]:
        return None
    return motion, epipolar_errors(first, second, motion[:1], motion[1:])[0] < tolerance_rad


def estimators(camera: CameraModel, without: Ablation) -> tuple[PictureOdometry, PictureTrajectory]:
    """Both estimators, without tracked corners, their ranges, SIFT (ORB), wheels or the robust corrector."""
    settings: dict[str, Any] = {
        "tracks": {"least_inliers": CameraConfig.corners + 1},
        "points": {"range_pixel_std": 1e6},
    }
    config = CameraConfig(**settings.get(without, {}))
    describer = _Orb(config.features) if without == "sift" else None
    odometry = PictureOdometry(camera, config, describer, by_floor=without == "wheels")
    return odometry, _BelievingTrajectory() if without == "corrector" else PictureTrajectory()


@contextmanager
def solver(without: Ablation) -> Iterator[None]:
    """Meanwhile pairs of pictures are solved by five points, where it is without the planar solver."""
    modules = (tracked_odometry, picture_fit)
    try:
        for module in modules:
            module.ransac = five_points if without == "planar" else ransac  # type: ignore[attr-defined]
        yield
    finally:
        for module in modules:
            module.ransac = ransac  # type: ignore[attr-defined]


def measured(of: CameraDrive, without: Ablation) -> Measured:
    """All numbers of one drive."""
    cv2.setNumThreads(1)
    odometry, graph = estimators(of.camera, without)
    published, covariances = [], []
    began = time.process_time()  # of one thread, whatever else runs on the machine
    with solver(without):
        for frame, picture in enumerate(of.pictures):
            stamp_ns = round(frame * of.period_s * 1e9)
            if without != "wheels":
                odometry.add_wheels(stamp_ns, of.given[frame])
            odometry.add_picture(stamp_ns, picture[..., None])
            for step in odometry.ready():
                update = graph.update(step)
                published.append(update.pose_xyyaw)
                covariances.append(update.covariance)
        graph.finish()
    took_s = time.process_time() - began
    found = graph.trajectory()
    assert found is not None
    truth, given, relative = of.truth, of.given, se2.between(of.truth[found.loops[:, 0]], of.truth[found.loops[:, 1]])
    off = se2.wrapped(found.loop_relative_xyyaw - relative)
    wrong = (np.hypot(off[:, 0], off[:, 1]) > _WRONG_M) | (np.abs(off[:, 2]) > _WRONG_RAD)
    believed = found.loop_weights > 0.5
    turned = [se2.wrapped(se2.between(poses[:-10], poses[10:]) - se2.between(truth[:-10], truth[10:]))[:, 2]
              for poses in (given, found.odometry_xyyaw)]  # fmt: skip
    errors = {
        "path_m": path_length_m(truth),
        "given_ate_m": absolute_error_m(given, truth),
        "odometry_ate_m": absolute_error_m(found.odometry_xyyaw, truth),
        "corrected_ate_m": absolute_error_m(found.poses_xyyaw, truth),
        "given_final_percent": trajectory_error(given, truth).final_percent,
        "odometry_final_percent": trajectory_error(found.odometry_xyyaw, truth).final_percent,
        "corrected_final_percent": trajectory_error(found.poses_xyyaw, truth).final_percent,
        "given_turn_deg": float(np.degrees(np.median(np.abs(turned[0])))),
        "odometry_turn_deg": float(np.degrees(np.median(np.abs(turned[1])))),
        "within_3_std": within(np.array(published), np.array(covariances), truth[1:]),
        "loops": len(off),
        "believed": int(believed.sum()),
        "wrong": int(wrong.sum()),
        "wrong_believed": int((wrong & believed).sum()),
        "by_wheels": odometry.by_wheels / max(1, odometry.frames),
        "frames_a_second": len(of.pictures) / took_s,
    }
    if without == "wheels":
        errors["floorless"] = odometry.floorless / max(1, odometry.frames)
    return Measured.of(errors)
