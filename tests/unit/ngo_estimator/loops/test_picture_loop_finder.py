"""Loops of key pictures: found at the place, refused where the graph is sure of another one, and in bounded memory."""

from dataclasses import replace

import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_picture import KeyPicture
from ngo_estimator.geometry.view_pose import camera_at
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.picture_loop_finder import PictureLoopFinder
from ngo_estimator.loops.picture_settings import PictureLoopConfig

CENTRE = np.array((0.2, 0.0, 0.8))
STEPS, ROUND = 45, 30


def seen(pose: np.ndarray, points: np.ndarray, looks: np.ndarray) -> KeyPicture:
    """Those of the points ``(n, 3)`` that are ahead of a robot, each of which looks like nothing else."""
    offset = points - camera_at(pose, CENTRE)
    offset[:, :2] = se2.rotate(np.asarray(-pose[2]), offset[:, :2])
    rays = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    ahead = rays[:, 0] > 0.7
    return KeyPicture(CENTRE, 2e-3, rays[ahead], looks[ahead])


def driven(config: PictureLoopConfig, drift_rad: float, std_rad: float) -> tuple[PictureLoopFinder, np.ndarray]:
    """A finder after one and a half rounds with an odometry that turns too far, and the true poses."""
    rng = np.random.default_rng(1)
    points = rng.uniform((-8.0, -8.0, 0.0), (8.0, 8.0, 3.0), (1200, 3))
    points = points[np.linalg.norm(points[:, :2], axis=1) > 5.0]
    looks = rng.standard_normal((len(points), 32)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    angle = np.arange(STEPS) * (2.0 * np.pi / ROUND)
    truth = np.stack((2.0 * np.cos(angle), 2.0 * np.sin(angle), angle + 0.5 * np.pi), axis=1)
    finder, graph = PictureLoopFinder(config), PoseGraph()
    finder.append(seen(truth[0], points, looks))
    for before, pose in zip(truth, truth[1:], strict=False):
        graph.append(se2.between(before, pose) + (0.0, 0.0, drift_rad), np.diag((1e-4, 1e-4, std_rad**2)))
        graph.add_node()
        finder.append(seen(pose, points, looks))
        finder.find(graph)
    return finder, truth


def test_loops_have_the_true_relative_pose() -> None:
    finder, truth = driven(PictureLoopConfig(), drift_rad=0.002, std_rad=0.01)
    loops = finder.loops
    assert {second for _, second in loops.pairs.tolist()} >= set(range(ROUND, STEPS))
    off = se2.wrapped(loops.relative - se2.between(truth[loops.pairs[:, 0]], truth[loops.pairs[:, 1]]))
    deviations = np.sqrt(np.diagonal(loops.covariance, axis1=1, axis2=2))
    assert (np.abs(off) < 3.0 * deviations).all()
    assert np.abs(off[:, 2]).max() < 0.01 and np.median(np.abs(off)) < 0.02


def test_a_graph_that_is_sure_of_another_place_takes_no_loop() -> None:
    finder, _ = driven(PictureLoopConfig(), drift_rad=0.02, std_rad=1e-4)
    assert len(finder.loops) == 0


def test_old_pictures_are_let_go() -> None:
    finder, _ = driven(replace(PictureLoopConfig(), most_pictures=20), drift_rad=0.002, std_rad=0.01)
    assert len(finder) == STEPS and (finder.loops.pairs[:, 1] - finder.loops.pairs[:, 0] < 20).all()
    kept = finder.state()["pictures.lengths"]
    assert (kept[:-20] == kept.min()).all() and (kept[-20:] > kept.min()).all()
