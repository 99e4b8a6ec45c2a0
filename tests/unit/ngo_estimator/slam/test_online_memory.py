"""What lies behind the window: it is bounded, it still closes loops, and corrections reach everything between."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.samples import place_config
from training.scoring.online_estimate import steps_of

SIDE_STEPS = 100  # of a square that the robot drives round and round
LAP = 4 * SIDE_STEPS
STEP_STD = np.array([0.002, 0.002, 0.002])


class SeesPoses(PairHead):
    """Its place codes are true poses: it measures what they say, and takes for one place what is near."""

    def __init__(self) -> None:
        super().__init__(place_config("maze2d", code_size=3, embedding_size=32, pair_hidden_size=1))
        generator = torch.Generator().manual_seed(0)
        self.frequencies = nn.Parameter(torch.randn(3, 16, generator=generator), requires_grad=False)

    def embed(self, codes: Tensor) -> Tensor:
        xy, yaw = codes[..., :2], codes[..., 2:]
        phase = torch.cat((xy, 2.0 * torch.sin(yaw)), dim=-1) @ self.frequencies + torch.cos(yaw)
        return torch.cat((torch.cos(phase), torch.sin(phase)), dim=-1) / 4.0

    def forward(self, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        measured = se2.between(a, b)
        near = (measured[..., :2].norm(dim=-1) < 1.0) & (measured[..., 2].abs() < 1.0)
        scale = torch.tensor([0.01, 0.005]).log().expand(*measured.shape[:-1], 2)
        return measured, scale, 20.0 * near.float() - 10.0


def robust_graph(iterations: int = 5) -> NeuralGraphOptimizer:
    config = NeuralGraphOptimizerConfig(
        PoseAggregationConfig(1), iterations, network=False, search=LoopSearch(2, 256, 3, 1, 1)
    )
    return NeuralGraphOptimizer(config).eval().requires_grad_(False)


def drive(steps: int, bias_rad: float = 3e-4, seed: int = 0) -> tuple[list[RelativeStep], np.ndarray]:
    """Round a square of 10 m, with an odometry that is noisy and turns too much; and the true poses."""
    rng = np.random.default_rng(seed)
    true = np.zeros((steps, 3))
    true[:, 0] = 0.1
    true[SIDE_STEPS - 1 :: SIDE_STEPS, 2] = np.pi / 2
    poses = se2.r2g(torch.from_numpy(true)).numpy()
    poses[:, 2] = np.angle(np.exp(1j * poses[:, 2]))
    relative = true + rng.normal(size=true.shape) * STEP_STD + np.array([0.0, 0.0, bias_rad])
    log_std = np.tile(np.log(STEP_STD), (steps, 1))
    features = {"relative": relative, "log_std": log_std, "motion": np.zeros((steps, 1)), "codes": poses}
    return list(steps_of(features)), np.concatenate((np.zeros((1, 3)), poses))


def rmse(poses: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.square(poses[:, :2] - truth[:, :2]).sum(1).mean()))


def run(core: OnlineTrajectory, steps: list[RelativeStep]) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """Corrected poses at the end, each as first published, and the largest move in each update."""
    moves = [core.update(step).largest_move_m for step in steps]
    whole = core.trajectory()
    assert whole is not None
    return whole.poses_xyyaw, whole.online_xyyaw, moves


def test_places_from_far_before_the_window_close_loops_and_correct_all_between() -> None:
    """A window of a tenth of a lap never sees a place twice: only key frames do."""
    steps, truth = drive(5 * LAP)
    odometry = np.concatenate((np.zeros((1, 3)), np.stack([step.odom_xyyaw for step in steps])))
    bounded = OnlineTrajectory(robust_graph(), SeesPoses(), window_frames=40, key_frames=40)
    poses, online, _ = run(bounded, steps)
    few, _, _ = run(OnlineTrajectory(robust_graph(), SeesPoses(), window_frames=40, key_frames=2), steps)
    assert rmse(odometry, truth) > 1.0
    assert rmse(poses, truth) < 0.1 * rmse(odometry, truth)
    assert rmse(few, truth) > 2.0 * rmse(poses, truth)
    assert rmse(online[LAP + 80 :], truth[LAP + 80 :]) < 0.2 * rmse(odometry, truth)
    # Every part of every lap is better, those before the first revisit, too.
    for start in range(0, 5 * LAP, SIDE_STEPS):
        part = slice(start + 1, start + SIDE_STEPS)
        if rmse(odometry[part], truth[part]) > 0.3:
            assert rmse(poses[part], truth[part]) < 0.5 * rmse(odometry[part], truth[part]), start


def test_it_is_as_good_as_the_whole_trajectory_at_once_and_jumps_no_further() -> None:
    steps, truth = drive(3 * LAP)
    bounded, _, moves = run(OnlineTrajectory(robust_graph(), SeesPoses(), 400, 64), steps)
    whole, _, whole_moves = run(OnlineTrajectory(robust_graph(), SeesPoses(), 10 * LAP), steps)
    assert rmse(bounded, truth) < max(1.5 * rmse(whole, truth), 0.03)
    assert max(moves) < 1.1 * max(whole_moves)
    # Where the window moves nothing tears: steps stay those of the odometry but for a small correction.
    corrected = se2.between(torch.from_numpy(bounded[:-1].copy()), torch.from_numpy(bounded[1:].copy())).numpy()
    measured = np.stack([step.relative_xyyaw for step in steps])
    difference = corrected - measured
    difference[:, 2] = np.angle(np.exp(1j * difference[:, 2]))
    assert np.abs(difference[:, :2]).max() < 0.03 and np.abs(difference[:, 2]).max() < 0.02


def test_answers_before_an_optimisation_follow_the_last_pose_by_odometry() -> None:
    steps, _ = drive(LAP + 160)
    before = OnlineTrajectory(robust_graph(), SeesPoses(), 160, 16)
    after = OnlineTrajectory(robust_graph(), SeesPoses(), 160, 16, iterations_per_step=1)
    for count, step in enumerate(steps, start=1):
        expected, update = before.update(step), after.update(step)
        assert not update.optimized
        if count % 8:
            np.testing.assert_allclose(update.pose_xyyaw, expected.pose_xyyaw, atol=1e-9)
            np.testing.assert_allclose(update.covariance, expected.covariance, rtol=1e-6, atol=1e-9)
            assert after.correct() is None
            continue
        correction = after.correct()
        assert expected.optimized and correction is not None and correction.optimized
        np.testing.assert_allclose(correction.pose_xyyaw, expected.pose_xyyaw, atol=1e-9)
        a, b = after.trajectory(), before.trajectory()
        assert a is not None and b is not None
        np.testing.assert_array_equal(a.poses_xyyaw, b.poses_xyyaw)


def test_loops_found_in_a_pause_are_closed_after_it() -> None:
    """The pause spans the whole second lap, more than a window: what was recognised in it is not forgotten."""
    steps, truth = drive(2 * LAP + 240)
    core = OnlineTrajectory(robust_graph(), SeesPoses(), window_frames=160, key_frames=64)
    for count, step in enumerate(steps):
        core.update(step, optimize=not LAP <= count < 2 * LAP)
    whole = core.trajectory()
    assert whole is not None
    paused = (whole.loops[:, 1] > LAP + 80) & (whole.loops[:, 1] < 2 * LAP - 160)
    assert (whole.loop_weights[paused] > 0.5).sum() > 3
    lap = slice(LAP, 2 * LAP)
    assert rmse(whole.poses_xyyaw[lap], truth[lap]) < 0.5 * rmse(whole.odometry_xyyaw[lap], truth[lap])


def test_finish_does_what_is_due() -> None:
    steps, _ = drive(80)
    at_once = OnlineTrajectory(robust_graph(), SeesPoses())
    later = OnlineTrajectory(robust_graph(), SeesPoses(), iterations_per_step=1)
    for step in steps:
        at_once.update(step)
        later.update(step)
    assert later.unfinished
    later.finish()
    a, b = later.trajectory(), at_once.trajectory()
    assert a is not None and b is not None
    np.testing.assert_array_equal(a.poses_xyyaw, b.poses_xyyaw)


@pytest.mark.parametrize("per_step", [0, 1])
def test_a_pause_of_many_windows_is_caught_up_with(per_step: int) -> None:
    steps, truth = drive(4 * LAP)
    core = OnlineTrajectory(robust_graph(), SeesPoses(), window_frames=40, key_frames=40, iterations_per_step=per_step)
    for count, step in enumerate(steps):
        core.update(step, optimize=not 1.5 * LAP < count < 3 * LAP)
    trajectory = core.trajectory()
    assert trajectory is not None
    assert len(trajectory.poses_xyyaw) == len(truth)
    assert rmse(trajectory.poses_xyyaw, truth) < 0.5 * rmse(trajectory.odometry_xyyaw, truth)


def test_what_is_kept_does_not_grow() -> None:
    core = OnlineTrajectory(robust_graph(1), SeesPoses(), window_frames=80, key_frames=16)
    steps, _ = drive(4 * LAP)
    sizes = []
    for count, step in enumerate(steps, start=1):
        core.update(step)
        if count % LAP == 0:
            back_end = core._back_end
            assert back_end._finder is not None
            sizes.append((len(back_end._keys), len(back_end._finder.loops), back_end._finder._codes._buffer.size))
    assert max(size[0] for size in sizes) <= 16 + 32
    assert sizes[-1][1] <= 1.3 * sizes[1][1] and sizes[-1][2] == sizes[0][2]


@pytest.mark.parametrize("window", [16, 24, 64])
def test_without_loops_poses_behind_the_window_stay_where_the_odometry_has_them(window: int) -> None:
    steps, _ = drive(700)
    blind = SeesPoses()
    blind.forward = lambda a, b: (se2.between(a, b), torch.zeros(*a.shape[:-1], 2), torch.full(a.shape[:-1], -1e3))  # type: ignore[method-assign]
    poses, online, _ = run(OnlineTrajectory(robust_graph(1), blind, window, 8), steps)
    odometry = np.concatenate((np.zeros((1, 3)), np.stack([step.odom_xyyaw for step in steps])))
    assert rmse(poses, odometry) < 1e-3 and rmse(online, odometry) < 1e-3


def test_loops_are_handed_out_as_they_were_measured() -> None:
    steps, truth = drive(3 * LAP)
    core = OnlineTrajectory(robust_graph(), SeesPoses(), window_frames=200, key_frames=40)
    for step in steps:
        core.update(step)
    whole = core.trajectory()
    assert whole is not None and len(whole.odometry_std) == len(whole.poses_xyyaw) - 1
    believed = whole.loop_weights > 0.5
    earlier, later = (torch.from_numpy(truth[whole.loops[believed, k]]) for k in (0, 1))
    error = se2.between(
        torch.from_numpy(whole.loop_relative_xyyaw[believed].copy()), se2.between(earlier, later)
    ).numpy()
    assert (whole.loops[believed, 0] < len(truth) - 200).sum() > 20
    # Those that had to be hung upon another key frame carry the error of a few corrected poses.
    assert np.median(np.linalg.norm(error[:, :2], axis=1)) < 0.01
    assert np.linalg.norm(error[:, :2], axis=1).max() < 0.3
    assert (whole.loop_std > 0.0).all() and np.isfinite(whole.loop_std).all()
