"""Hundreds of steps through small windows and few key frames, with whatever a run of hours brings: all stays sound."""

import numpy as np
import pytest
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from tests.unit.ngo_estimator.samples import small_optimizer
from tests.unit.ngo_estimator.slam.test_online_memory import SeesPoses, robust_graph

PERIOD_NS = 50_000_000


def optimizer_of(form: str) -> NeuralGraphOptimizer:
    torch.manual_seed(0)
    return robust_graph() if form == "robust" else small_optimizer(form, trained=True)


def assert_sound(update: TrajectoryUpdate, trajectory: Trajectory | None, trace: str) -> None:
    for name in ("pose_xyyaw", "covariance", "map_from_odom_xyyaw", "largest_move_m"):
        assert np.isfinite(getattr(update, name)).all(), (trace, name)
    spread = np.linalg.eigvalsh(update.covariance)
    assert spread[0] >= -1e-6 * spread[-1], trace
    if trajectory is None:
        return
    for name in ("poses_xyyaw", "online_xyyaw", "moved_m", "loop_relative_xyyaw", "loop_std", "loop_weights"):
        assert np.isfinite(getattr(trajectory, name)).all(), (trace, name)
    assert len(trajectory.poses_xyyaw) == len(trajectory.online_xyyaw) == len(trajectory.stamps_ns) == update.frames
    size = 1.0 + np.abs(trajectory.poses_xyyaw[:, :2]).max()
    np.testing.assert_allclose(trajectory.poses_xyyaw[-1, :2], update.pose_xyyaw[:2], atol=1e-6 * size, err_msg=trace)
    if len(trajectory.loops):
        assert trajectory.loops.min() >= 0 and trajectory.loops.max() < update.frames, trace
        assert (trajectory.loops[:, 0] < trajectory.loops[:, 1]).all(), trace


@pytest.mark.parametrize("form", ["robust", "loops"])
@pytest.mark.parametrize("seed", range(4))
def test_gaps_pauses_resets_and_extremes_behind_the_window_break_nothing(form: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    optimizer = optimizer_of(form)
    window, keys, per_step = (int(rng.choice(given)) for given in ((16, 17, 40, 80), (2, 3, 12), (0, 1, 2, 7)))
    core = OnlineTrajectory(optimizer, SeesPoses(), window, keys, per_step)
    trace = f"window {window}, key frames {keys}, {per_step} iterations a step"
    true, odom, stamp_ns, paused = np.zeros(3), np.zeros(3), 0, False
    for count in range(700):
        extreme = seed % 2 and rng.random() < 0.02
        step = np.array([0.1, 0.0, 0.05 + 0.02 * rng.normal()])
        if extreme:
            step = 10.0 ** rng.uniform(-6.0, 3.99, 3) * rng.choice([-1.0, 1.0], 3)
        true, odom = (se2.compose(torch.tensor(pose), torch.tensor(step)).numpy() for pose in (true, odom))
        before_ns, stamp_ns = stamp_ns, stamp_ns + PERIOD_NS
        event = rng.random()
        if event < 0.02:  # lost
            continue
        paused ^= event < 0.028
        if event > 0.9985:
            core.reset()
        variances = 10.0 ** rng.uniform(-300.0, 300.0, 3) if extreme else np.full(3, 1e-5)
        update = core.update(
            RelativeStep(
                stamp_ns=stamp_ns,
                from_stamp_ns=before_ns,
                relative_xyyaw=step,
                covariance=np.diag(variances),
                origin_stamp_ns=0,
                odom_xyyaw=odom,
                motion_feature=rng.normal(size=optimizer.config.aggregation.motion_feature_size).astype(np.float32),
                place_code=np.clip(true, -1e4, 1e4).astype(np.float32),
            ),
            optimize=not paused,
        )
        whole = core.trajectory() if count % 37 == 0 else None
        assert_sound(update, whole, f"step {count}, {trace}")
