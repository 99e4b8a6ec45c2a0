"""Loops of pictures and of key frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.data.state_arrays import restore, state_of
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.key_picture import KeyPicture
from ngo_estimator.geometry.view_pose import camera_at
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.loops.pair_measurement import PairMeasurement
from ngo_estimator.loops.picture_fit import PictureFit
from ngo_estimator.loops.picture_loop_finder import PictureLoopFinder
from ngo_estimator.loops.picture_settings import PictureGraphConfig, PictureLoopConfig
from ngo_estimator.loops.place_loop_finder import PlaceLoopFinder
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.slam.picture_back_end import PictureBackEnd
from tests.unit.ngo_estimator.samples import small_pair_head

CENTRE = np.array((0.2, 0.0, 0.8))
STEPS, ROUND = 45, 30


def seen(pose: np.ndarray, points: np.ndarray, looks: np.ndarray, rough: float) -> KeyPicture:
    """Those of the points ``(n, 3)`` that are ahead of a robot, each of which looks like nothing else.

    Every other one is found too far to the left, by an angle ``rough``, which its deviation tells.
    """
    offset = points - camera_at(pose, CENTRE)
    offset[:, :2] = se2.rotate(np.asarray(-pose[2]), offset[:, :2])
    rays = offset / np.linalg.norm(offset, axis=1, keepdims=True)
    std_rad = np.where(np.arange(len(rays)) % 2, 2e-3, 2e-3 + rough)
    rays[::2, :2] = se2.rotate(np.asarray(rough), rays[::2, :2])
    ahead = rays[:, 0] > 0.7
    return KeyPicture.of(CENTRE, rays[ahead], std_rad[ahead], looks[ahead])


def place() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points ``(n, 3)`` around, what they look like, and poses ``(STEPS, 3)`` of one and a half rounds."""
    rng = np.random.default_rng(1)
    points = rng.uniform((-8.0, -8.0, 0.0), (8.0, 8.0, 3.0), (1200, 3))
    points = points[np.linalg.norm(points[:, :2], axis=1) > 5.0]
    looks = rng.standard_normal((len(points), 32)).astype(np.float32)
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    angle = np.arange(STEPS) * (2.0 * np.pi / ROUND)
    return points, looks, np.stack((2.0 * np.cos(angle), 2.0 * np.sin(angle), angle + 0.5 * np.pi), axis=1)


def driven(
    config: PictureLoopConfig, drift_rad: float, std_rad: float, rough: float = 0.0, belief: float = 0.0
) -> tuple[PictureLoopFinder, np.ndarray]:
    """A finder after one and a half rounds with an odometry that turns too far, and the true poses.

    No loop moves the graph, whatever the ``belief`` in it is.
    """
    points, looks, truth = place()
    finder, graph = PictureLoopFinder(config), PoseGraph()
    finder.append(seen(truth[0], points, looks, 0.0))
    for before, pose in zip(truth, truth[1:], strict=False):
        graph.append(se2.between(before, pose) + (0.0, 0.0, drift_rad), np.diag((1e-4, 1e-4, std_rad**2)))
        graph.add_node()
        finder.append(seen(pose, points, looks, rough if len(finder) > ROUND else 0.0))
        finder.find(graph, np.full(len(finder.loops), belief))
    return finder, truth


def test_loops_have_the_true_relative_pose() -> None:
    finder, truth = driven(PictureLoopConfig(), drift_rad=0.002, std_rad=0.01)
    loops = finder.loops
    assert {second for _, second in loops.pairs.tolist()} >= set(range(ROUND, STEPS))
    off = se2.wrapped(loops.relative - se2.between(truth[loops.pairs[:, 0]], truth[loops.pairs[:, 1]]))
    deviations = np.sqrt(np.diagonal(loops.covariance, axis1=1, axis2=2))
    assert (np.abs(off) < 3.0 * deviations).all()
    assert np.abs(off[:, 2]).max() < 0.01 and np.median(np.abs(off)) < 0.02


def test_nothing_is_triangulated_over_a_motion_that_nobody_saw() -> None:
    points, looks, truth = place()
    finder, graph = PictureLoopFinder(PictureLoopConfig()), PoseGraph()
    pictures = [seen(pose, points, looks, 0.0) for pose in truth[:10]]
    finder.append(pictures[0])
    for node in range(1, 10):
        relative = se2.between(truth[node - 1], truth[node]) + (0.5 * (node == 5), 0.0, 0.0)
        graph.append(relative, np.diag((0.25, 0.25, 1e-4)), joins=node == 5)
        graph.add_node()
        finder.append(pictures[node])
    for node in range(2, 8):
        fitted = finder.fitted(node, pictures[node + 2], graph, (0.0, 1.0))
        assert fitted is not None
        off = se2.wrapped(fitted.relative - se2.between(truth[node], truth[node + 2]))
        assert np.hypot(*off[:2]) < 0.05, node


def test_features_that_are_found_roughly_turn_no_loop() -> None:
    finder, truth = driven(PictureLoopConfig(), drift_rad=0.002, std_rad=0.01, rough=0.03)
    loops = finder.loops[finder.loops.pairs[:, 1] > ROUND]
    off = se2.wrapped(loops.relative - se2.between(truth[loops.pairs[:, 0]], truth[loops.pairs[:, 1]]))
    assert len(loops) > 10 and np.abs(off[:, 2]).max() < 0.01


def test_what_is_measured_roughly_is_no_loop() -> None:
    finder, _ = driven(replace(PictureLoopConfig(), most_rad=0.006), drift_rad=0.002, std_rad=0.01)
    assert len(finder.loops) == 0


def test_a_graph_that_is_sure_of_another_place_takes_no_loop() -> None:
    finder, _ = driven(PictureLoopConfig(), drift_rad=0.02, std_rad=1e-4)
    assert len(finder.loops) == 0


@pytest.mark.parametrize(("std_rad", "taken"), [(0.002, True), (0.1, False)])
def test_as_many_deviations_off_a_loop_is_taken_where_the_graph_knows_more(std_rad: float, taken: bool) -> None:
    finder, _ = driven(PictureLoopConfig(), drift_rad=0.5 * std_rad, std_rad=std_rad)
    assert (len(finder.loops) > 0) == taken


def test_only_loops_that_are_believed_make_the_graph_surer() -> None:
    refused, believed = (driven(PictureLoopConfig(), 0.002, 0.01, belief=belief)[0].loops for belief in (0.0, 1.0))
    assert 0 < len(believed) < len(refused)  # what contradicts the believed ones is not taken


def test_loops_that_wait_for_an_optimisation_make_the_graph_no_surer() -> None:
    points, looks, truth = place()
    back_end, nothing, covariance = PictureBackEnd(PictureGraphConfig()), np.zeros(0), np.diag((1e-4, 1e-4, 1e-4))
    codes = [seen(pose, points, looks, 0.0).packed() for pose in truth]
    for k, relative in enumerate(se2.between(truth[:-1], truth[1:]) + (0.0, 0.0, 0.002)):
        step = RelativeStep(
            k + 1, k, relative, covariance, 0, relative, nothing, codes[k + 1], from_place_code=codes[0]
        )
        if k == 0:
            back_end.begin_at(step)
        back_end.append(step)
        back_end.work(optimize=False)
    unsure, _ = driven(PictureLoopConfig(), 0.002, 0.01, belief=0.0)
    assert back_end.waiting_loops == pytest.approx(len(unsure.loops), abs=2)


def test_where_a_sure_graph_does_not_expect_it_there_is_no_loop_on_a_large_map_either() -> None:
    finder = PictureLoopFinder(PictureLoopConfig())
    poses = np.array(((0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (60.0, 60.0, 0.0)))
    for deviations, expected in ((3.0, True), (5.0, False)):
        off = np.array((3.0 + 0.03 * deviations, 0.0, 0.0))
        fitted = PictureFit(off, np.diag((0.03**2, 0.03**2, 0.006**2)), 40)
        assert finder._expected(fitted, poses, (0, 1), np.eye(3) * 1e-9) == expected


def test_a_key_picture_keeps_what_features_look_like_in_a_byte_each() -> None:
    points, looks, truth = place()
    picture = seen(truth[0], points, looks, 0.0)
    again = KeyPicture.unpacked(picture.packed())
    np.testing.assert_array_equal(again.codes, picture.codes)
    whole = KeyPicture.of(CENTRE, points, np.ones(len(points)), looks)
    assert whole.codes.nbytes == looks.size and np.linalg.norm(whole.descriptors - looks, axis=1).max() < 0.02


def test_old_pictures_are_let_go() -> None:
    finder, _ = driven(replace(PictureLoopConfig(), most_pictures=20), drift_rad=0.002, std_rad=0.01)
    assert len(finder) == STEPS and (finder.loops.pairs[:, 1] - finder.loops.pairs[:, 0] < 20).all()
    kept = finder.state()["pictures.lengths"]
    assert (kept[:-20] == kept.min()).all() and (kept[-20:] > kept.min()).all()


def loop(start: int, end: int) -> PlaceLoops:
    """A loop along a line of nodes that are a metre apart."""
    relative, nothing = torch.tensor([[float(end - start), 0.0, 0.0]]), torch.zeros(1, 2)
    measured = PairMeasurement(relative, nothing, nothing)
    return PlaceLoops.found(np.array([start]), end, np.array([start - 1]), measured, np.ones(1), np.ones(1), False)


@pytest.mark.parametrize("closed", [True, False])
def test_a_loop_from_a_key_frame_is_as_sure_as_the_loops_that_were_closed_before(closed: bool) -> None:
    graph, keys, nothing = PoseGraph(), KeyFrames(2), np.zeros((1, 0), np.float32)
    for _ in range(5):
        graph.append(np.array((1.0, 0.0, 0.0)), np.diag((0.1, 0.1, 1e-9)))
        graph.add_node()
    for _ in range(2):
        keys.add(KeyFrame(nothing, nothing, np.zeros((1, 3))))
    finder = PlaceLoopFinder(small_pair_head(), LoopSearch(), 1, 8, graph, keys, scale=2.0)
    finder.loops = loop(0, 4).extended(loop(1, 5))
    if closed:
        finder.weigh(np.array([0]), np.ones(1), np.array([[100.0, 100.0, 1e9]]))
    finder._limit_drift(np.array([1]))
    # Back by a step, over the loop, and on by a step; the variance is four times as large as the graph says.
    expected = 4.0 * 2.0 * (0.1 + 0.01 + 0.1) if closed else np.inf
    np.testing.assert_allclose(finder.loops.most_drift[1, :2], expected, rtol=1e-3)
    assert np.isinf(finder.loops.most_drift[0]).all()


def test_a_loop_that_was_taken_out_stays_away_when_the_state_is_loaded() -> None:
    head, graph = small_pair_head(), PoseGraph()
    original, loaded = (PlaceLoopFinder(head, LoopSearch(), 1, 8, graph, KeyFrames(2), scale=1.0) for _ in range(2))
    for _ in range(5):
        graph.append(np.array((1.0, 0.0, 0.0)), np.eye(3))
        graph.add_node()
        original.append(np.zeros(head.config.code_length, np.float32))
    original.loops = loop(0, 4).extended(loop(1, 5))
    assert original.drop(np.array([False, True])) == 1
    restore(loaded, state_of(original))
    np.testing.assert_array_equal(loaded.loops.pairs, ((0, 4),))
    np.testing.assert_array_equal(loaded._dropped, ((1, 5),))
