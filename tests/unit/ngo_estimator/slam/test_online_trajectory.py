"""The online trajectory: equal to the offline optimizer after every step, and unshaken by any sequence of steps."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import write_untrained
from ngo_estimator.data.relative_step import RESTART_AFTER_NS, RejectedStep, RelativeStep
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs

PERIOD_NS = 100_000_000
FORMS = ["loops", "paper"]
NO_LOOPS = LoopSearch(2, 8, 100_000, 0, 3)


def make(form: str = "loops", trained: bool = True, window_frames: int = 2000) -> OnlineTrajectory:
    # Fresh and with nothing to close, it passes the odometry on.
    changes = {} if trained or form == "paper" else {"search": NO_LOOPS}
    return OnlineTrajectory(
        small_optimizer(form, trained, **changes),
        None if form == "paper" else small_pair_head(),
        window_frames,
    )


def make_steps(count: int, seed: int = 0, origin_ns: int = 0) -> list[RelativeStep]:
    """Steps of an odometry that drives on without a gap."""
    relative, log_std, motion, codes = (value[0].numpy() for value in trajectory_inputs(1, count, seed))
    relative = relative.astype(np.float64)
    odom, result = torch.zeros(3, dtype=torch.float64), []
    for k in range(count):
        odom = se2.compose(odom, torch.from_numpy(relative[k]))
        result.append(
            RelativeStep(
                stamp_ns=origin_ns + (k + 1) * PERIOD_NS,
                from_stamp_ns=origin_ns + k * PERIOD_NS,
                relative_xyyaw=relative[k],
                covariance=np.diag(np.exp(2.0 * log_std[k].astype(np.float64))),
                origin_stamp_ns=origin_ns,
                odom_xyyaw=odom.numpy(),
                motion_feature=motion[k],
                place_code=codes[k],
            )
        )
    return result


@dataclass(frozen=True)
class Seen(Trajectory, TrajectoryUpdate):
    """An update, and the whole trajectory after it."""


def take(core: OnlineTrajectory, step: RelativeStep) -> Seen:
    update, whole = core.update(step), core.trajectory()
    assert whole is not None
    return Seen(**vars(update), **vars(whole))


def offline(core: OnlineTrajectory, steps: list[RelativeStep]) -> np.ndarray:
    """Poses (steps + 1, 3) of the offline optimizer."""
    columns = (
        np.stack([step.relative_xyyaw for step in steps]),
        np.stack([0.5 * np.log(np.diagonal(step.covariance)) for step in steps]),
        np.stack([step.motion_feature for step in steps]),
        np.stack([step.place_code for step in steps]),
    )
    tensors = [torch.from_numpy(column).float() for column in columns]
    poses = optimize_offline(core._optimizer, core._pair_head, *tensors).poses[0].numpy()
    return np.concatenate((np.zeros((1, 3)), poses))


def assert_same_poses(a: np.ndarray, b: np.ndarray, tolerance: float = 2e-4) -> None:
    assert a.shape == b.shape
    np.testing.assert_allclose(a[:, :2], b[:, :2], atol=tolerance)
    np.testing.assert_allclose(np.remainder(a[:, 2] - b[:, 2] + np.pi, 2 * np.pi) - np.pi, 0.0, atol=tolerance)


def assert_same_updates(a: Seen, b: Seen) -> None:
    for field in fields(Seen):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def assert_sound(update: Seen) -> None:
    """What holds after any step."""
    count = len(update.stamps_ns)
    assert update.stamps_ns.dtype == np.int64 and (np.diff(update.stamps_ns) > 0).all()
    assert update.poses_xyyaw.shape == update.odometry_xyyaw.shape == (count, 3)
    assert update.moved_m.shape == (count,) and (update.moved_m >= 0.0).all()
    assert update.loops.shape == (len(update.loop_weights), 2)
    if len(update.loops):
        assert (update.loops[:, 0] < update.loops[:, 1]).all() and update.loops.min() > 0 and update.loops.max() < count
        assert update.loop_weights.min() >= 0.0 and update.loop_weights.max() <= 1.0
    assert not update.poses_xyyaw[0].any()
    for name in ("poses_xyyaw", "odometry_xyyaw", "moved_m", "loop_weights", "map_from_odom_xyyaw", "covariance"):
        assert np.isfinite(getattr(update, name)).all(), name
    np.testing.assert_array_equal(update.covariance, update.covariance.T)
    eigenvalues = np.linalg.eigvalsh(update.covariance)
    assert eigenvalues[0] >= -1e-9 * max(eigenvalues[-1], 1e-12)
    map_from_odom, odom = (
        torch.from_numpy(update.map_from_odom_xyyaw.copy()),
        torch.from_numpy(update.odometry_xyyaw[-1].copy()),
    )
    newest = se2.compose(map_from_odom, odom).numpy()
    scale = 1.0 + np.abs(odom.numpy()).max()
    assert_same_poses(newest[None], update.poses_xyyaw[-1:], 1e-9 * scale)


# ---- online equals offline


def test_candidates_from_where_the_odometry_may_have_been_alone_are_the_same_online_and_offline() -> None:
    optimizers = [
        small_optimizer(trained=True, search=LoopSearch(2, 64, 2, 0, 3, **drift))
        for drift in ({}, {"drift_m": 0.3, "drift_rad": 0.4})
    ]
    steps = make_steps(160)
    poses = np.concatenate((np.zeros((1, 3)), np.stack([step.odom_xyyaw for step in steps])))

    def farthest(optimizer: NeuralGraphOptimizer, window_frames: int = 2000) -> tuple[Seen, OnlineTrajectory, float]:
        core = OnlineTrajectory(optimizer, small_pair_head(), window_frames)
        update = [take(core, step) for step in steps][-1]
        ends = (poses[update.loops[:, side], :2] for side in (0, 1))
        return update, core, float(np.hypot(*np.subtract(*ends).T).max(initial=0.0))

    anywhere, (nearby, core, reach), (_, _, reach_of_keys) = (
        farthest(optimizers[0]),
        farthest(optimizers[1]),
        farthest(optimizers[1], window_frames=80),
    )
    most = 1.0 + 0.3 * 160**0.5 + 0.8  # frames of a meta-pose are up to so far from its end
    assert 0.0 < max(reach, reach_of_keys) < most < anywhere[2]
    assert 0 < len(nearby.loops) < len(anywhere[0].loops)
    assert_same_poses(nearby.poses_xyyaw, offline(core, steps))


@pytest.mark.parametrize(
    ("form", "trained"), [*((form, trained) for form in FORMS for trained in (False, True)), ("smoothed", True)]
)
def test_after_every_step_it_equals_the_offline_optimizer_on_the_steps_so_far(form: str, trained: bool) -> None:
    core, steps = make(form, trained), make_steps(75)
    moved = 0.0
    for count, step in enumerate(steps, start=1):
        update = take(core, step)
        assert_sound(update)
        assert update.optimized == (count % 8 == 0) and not update.restarted and not update.gap
        if count < 8:
            odometry = np.concatenate((np.zeros((1, 3)), np.stack([s.odom_xyyaw for s in steps[:count]])))
            assert_same_poses(update.poses_xyyaw, odometry, 1e-9)
        elif count in (8, 9, 15, 16, 31, 40, 47, 64, 71, 75):
            assert_same_poses(update.poses_xyyaw, offline(core, steps[:count]))
        moved += float(update.moved_m.sum())
    if trained:
        assert moved > 0.1
        assert (len(update.loops) > 0) == (form != "paper")
    else:
        assert_same_poses(update.poses_xyyaw, update.odometry_xyyaw, 1e-4)
        assert moved < 1e-3


@pytest.mark.parametrize("form", ["loops", "smoothed"])
@pytest.mark.parametrize("window_frames", [16, 40, 400])
def test_meta_steps_and_features_are_those_of_all_steps_however_far_the_networks_reach(
    form: str, window_frames: int
) -> None:
    core, steps = make(form, True, window_frames), make_steps(240)
    inputs = [value[:1] for value in trajectory_inputs(1, 240)[:3]]
    for count, step in enumerate(steps, start=1):
        core.update(step)
        if count % 8 == 0:
            whole = core._optimizer.aggregate(*(value[:, :count] for value in inputs))
            assert whole.features is not None
            back_end, first = core._back_end, max(0, count - window_frames) // 8
            graph, window = back_end.graph, len(back_end._keys)
            for rows, expected in (
                (graph.relative[window:], whole.relative),
                (np.sqrt(np.diagonal(graph.step_covariance[window:], axis1=1, axis2=2)), whole.std),
                (back_end._odometry.features.slice(first), whole.features),
            ):
                np.testing.assert_allclose(rows, expected[0, first:].numpy(), rtol=1e-4, atol=1e-5)


def test_moved_is_how_far_each_pose_moved() -> None:
    core, before = make(), np.zeros((1, 3))
    for step in make_steps(32):
        update = take(core, step)
        expected = np.linalg.norm(update.poses_xyyaw[:-1, :2] - before[:, :2], axis=1)
        if update.optimized:
            np.testing.assert_allclose(update.moved_m[:-1][: len(before)], expected, atol=1e-12)
        else:
            assert not update.moved_m.any() and not expected.any()
        before = update.poses_xyyaw


def test_offline_refuses_less_than_a_meta_pose() -> None:
    with pytest.raises(ValueError, match="5 steps make no meta-pose; expected at least 8"):
        optimize_offline(small_optimizer(), small_pair_head(), *(value[0] for value in trajectory_inputs(1, 5)))


# ---- gaps and restarts


@pytest.mark.parametrize("lost", [slice(10, 11), slice(11, 19), slice(1, 30)])
def test_lost_steps_are_composed_from_the_odometry(lost: slice) -> None:
    steps = make_steps(40)
    known = [step for k, step in enumerate(steps) if k not in range(40)[lost]]
    core = make(trained=False)
    for step in known:
        update = take(core, step)
        assert update.gap == (step is steps[lost.stop]) and not update.restarted
        assert_sound(update)
    expected = np.concatenate((np.zeros((1, 3)), np.stack([step.odom_xyyaw for step in known])))
    assert_same_poses(update.poses_xyyaw, expected, 1e-4)
    np.testing.assert_array_equal(update.stamps_ns, [0, *(step.stamp_ns for step in known)])


def test_a_gap_widens_the_covariance_in_proportion_to_its_time() -> None:
    steps = make_steps(6)
    whole, gap = make(), make()
    take(whole, steps[0])
    take(gap, steps[0])
    plain = take(whole, replace(steps[5], from_stamp_ns=steps[0].stamp_ns, stamp_ns=steps[1].stamp_ns))
    wide = take(
        gap,
        replace(steps[5], stamp_ns=steps[1].stamp_ns + 4 * PERIOD_NS, from_stamp_ns=steps[1].stamp_ns + 3 * PERIOD_NS),
    )
    first = steps[0].covariance[2, 2]
    assert wide.gap and not plain.gap
    assert wide.covariance[2, 2] - first == pytest.approx(5.0 * (plain.covariance[2, 2] - first))


def test_it_may_begin_in_the_middle_of_an_odometry() -> None:
    core, steps = make(trained=False), make_steps(40)
    for step in steps[12:]:
        update = take(core, step)
    assert_sound(update)
    assert len(update.stamps_ns) == 29
    start = torch.from_numpy(steps[11].odom_xyyaw)
    np.testing.assert_allclose(update.odometry_xyyaw[0], start.numpy(), atol=1e-9)
    assert_same_poses(update.map_from_odom_xyyaw[None], se2.inverse(start).numpy()[None], 1e-4)


@pytest.mark.parametrize(
    "change",
    ["another origin, later", "another origin, earlier", "the same origin, a second ago"],
)
def test_a_restarted_odometry_begins_a_new_trajectory(change: str) -> None:
    core, fresh = make(), make()
    for step in make_steps(30, origin_ns=50 * RESTART_AFTER_NS):
        take(core, step)
    origin_ns = {"another origin, later": 60, "another origin, earlier": 20}.get(change, 0) * RESTART_AFTER_NS
    again = make_steps(20, seed=1, origin_ns=origin_ns)
    if not origin_ns:
        last = 50 * RESTART_AFTER_NS + 30 * PERIOD_NS
        back = last - RESTART_AFTER_NS - again[0].stamp_ns
        again = [
            replace(
                s,
                stamp_ns=s.stamp_ns + back,
                from_stamp_ns=s.from_stamp_ns + back,
                origin_stamp_ns=50 * RESTART_AFTER_NS,
            )
            for s in again
        ]
    for k, step in enumerate(again):
        update, expected = take(core, step), take(fresh, step)
        assert update.restarted == (k == 0)
        assert_same_updates(replace(update, restarted=False), expected)


def test_a_gap_too_far_to_cross_begins_a_new_trajectory() -> None:
    core, fresh, steps = make(), make(), make_steps(24)
    for step in steps[:12]:
        core.update(step)
    far = [replace(step, odom_xyyaw=step.odom_xyyaw + np.array([1e7, 0.0, 0.0])) for step in steps[13:]]
    for k, step in enumerate(far):
        update, expected = take(core, step), take(fresh, step)
        assert update.restarted == (k == 0) and not update.gap
        assert_same_updates(replace(update, restarted=False), expected)


def test_reset_forgets_everything() -> None:
    core, fresh, steps = make(), make(), make_steps(20)
    for step in steps:
        take(core, step)
    core.reset()
    for step in steps:
        assert_same_updates(take(core, step), take(fresh, step))


@pytest.mark.parametrize("form", FORMS)
def test_without_optimizing_it_follows_the_odometry_and_then_catches_up(form: str) -> None:
    core, other, steps = make(form), make(form), make_steps(64)
    for count, step in enumerate(steps, start=1):
        paused = 20 < count < 50
        before = None if count == 1 else core.trajectory()
        update, expected = core.update(step, optimize=not paused), other.update(step)
        assert update.optimized == (count % 8 == 0 and not paused)
        if paused and before is not None:
            now = core.trajectory()
            assert now is not None
            assert_same_poses(now.poses_xyyaw[:-1], before.poses_xyyaw, 1e-12)
            assert update.frames == count + 1 and not update.gap
        elif count >= 56:
            assert_same_poses(update.pose_xyyaw[None], expected.pose_xyyaw[None])


# ---- refused steps


NEEDS_A_TRAJECTORY = ("duplicate", "late")


def refused(step: RelativeStep) -> dict[str, RelativeStep]:
    bad = np.array([np.nan, 0.0, 0.0])
    return {
        "duplicate": replace(step, stamp_ns=step.from_stamp_ns, from_stamp_ns=step.from_stamp_ns - PERIOD_NS),
        "late": replace(
            step, stamp_ns=step.from_stamp_ns - PERIOD_NS // 2, from_stamp_ns=step.from_stamp_ns - PERIOD_NS
        ),
        "ends before it begins": replace(step, from_stamp_ns=step.stamp_ns + 1),
        "takes no time": replace(step, from_stamp_ns=step.stamp_ns),
        "relative nan": replace(step, relative_xyyaw=bad),
        "relative shape": replace(step, relative_xyyaw=np.zeros(2)),
        "relative huge": replace(step, relative_xyyaw=np.array([1e30, 0.0, 0.0])),
        "odometry infinite": replace(step, odom_xyyaw=np.array([np.inf, 0.0, 0.0])),
        "odometry huge": replace(step, odom_xyyaw=np.array([1e300, 0.0, 0.0])),
        "covariance shape": replace(step, covariance=np.eye(6)),
        "covariance zero": replace(step, covariance=np.zeros((3, 3))),
        "covariance negative": replace(step, covariance=-np.eye(3)),
        "covariance nan": replace(step, covariance=np.full((3, 3), np.nan)),
        "feature size": replace(step, motion_feature=np.zeros(7, np.float32)),
        "feature nan": replace(step, motion_feature=np.full(6, np.nan, np.float32)),
        "feature huge": replace(step, motion_feature=np.full(6, 1e38, np.float32)),
        "code size": replace(step, place_code=np.zeros(11, np.float32)),
        "code infinite": replace(step, place_code=np.full(12, np.inf, np.float32)),
    }


@pytest.mark.parametrize("what", refused(make_steps(1)[0]))
@pytest.mark.parametrize("count", [3, 15])
def test_a_refused_step_leaves_no_trace(what: str, count: int) -> None:
    core, undisturbed, steps = make(), make(), make_steps(24)
    for step in steps[:count]:
        take(core, step)
        take(undisturbed, step)
    with pytest.raises(RejectedStep) as error:
        core.update(refused(steps[count])[what])
    assert "\n" not in str(error.value)
    for step in steps[count:]:
        assert_same_updates(take(core, step), take(undisturbed, step))


@pytest.mark.parametrize("what", [w for w in refused(make_steps(1)[0]) if w not in NEEDS_A_TRAJECTORY])
def test_a_refused_first_step_is_not_the_first(what: str) -> None:
    core, steps = make(), make_steps(2)
    with pytest.raises(RejectedStep):
        core.update(refused(steps[0])[what])
    assert len(take(core, steps[0]).stamps_ns) == 2


def test_without_loops_place_codes_are_of_no_account() -> None:
    core, other = make("paper"), make("paper")
    for k, step in enumerate(make_steps(17)):
        code = np.full(k % 3, np.nan, np.float32)
        assert_same_updates(take(core, replace(step, place_code=code)), take(other, step))


# ---- window


def test_within_the_window_its_size_does_not_matter() -> None:
    small, large = make(window_frames=48), make(window_frames=2000)
    for count, step in enumerate(make_steps(48), start=1):
        update, expected = take(small, step), take(large, step)
        assert update.window_fill == count / 48 and expected.window_fill == count / 2000
        assert_same_updates(replace(update, window_fill=0.0), replace(expected, window_fill=0.0))


# ---- covariance


@pytest.mark.parametrize("form", FORMS)
def test_covariance_of_a_fresh_optimizer_is_that_of_sampled_odometry(form: str) -> None:
    steps = make_steps(13)
    std = np.array([0.01, 0.01, 0.02])
    core = make(form, trained=False)
    if form == "loops":
        core._optimizer.odometry_noise = torch.ones(3)  # fresh, it takes positions for twice as uncertain as they say
    for step in steps:
        update = take(core, replace(step, covariance=np.diag(std**2)))
    relative = torch.from_numpy(np.stack([step.relative_xyyaw for step in steps]))
    noise = torch.randn(20_000, 13, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ends = se2.r2g(relative + noise * torch.from_numpy(std))[:, -1]
    sampled = np.cov(ends.numpy().T)
    # Within a block correlations of position and heading are dropped.
    np.testing.assert_allclose(np.diagonal(update.covariance), np.diagonal(sampled), rtol=0.3)


def test_covariance_beyond_the_window_is_that_of_the_whole_odometry() -> None:
    """Without a loop it does not matter where the window begins."""
    windowed, whole = make("paper", trained=False, window_frames=16), make("paper", trained=False)
    for step in make_steps(80):
        beyond, expected = take(windowed, step), take(whole, step)
    np.testing.assert_allclose(beyond.covariance, expected.covariance, rtol=1e-3, atol=1e-9)
    assert_same_poses(beyond.poses_xyyaw, expected.poses_xyyaw)


# ---- arrays


def test_arrays_handed_out_never_change_and_cannot_be_written() -> None:
    core, kept = make(window_frames=64), []
    for step in make_steps(300):
        update = take(core, step)
        arrays = {name: value for name, value in vars(update).items() if isinstance(value, np.ndarray)}
        for name, value in arrays.items():
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0
            assert value.size == 0 or not value.flags.writeable, name
        kept.append((arrays, {name: value.copy() for name, value in arrays.items()}))
    for arrays, copies in kept:
        for name, value in arrays.items():
            np.testing.assert_array_equal(value, copies[name], err_msg=name)


def test_the_callers_arrays_may_change_afterwards() -> None:
    core, other = make(), make()
    for step in make_steps(24):
        own = replace(step, **{k: v.copy() for k, v in vars(step).items() if isinstance(v, np.ndarray)})
        update = take(core, own)
        for value in vars(own).values():
            if isinstance(value, np.ndarray):
                value[...] = 7.0
        assert_same_updates(update, take(other, step))


# ---- construction and loading


def test_a_window_of_less_than_two_meta_poses_is_refused() -> None:
    with pytest.raises(ValueError, match="window_frames is 15; expected at least 16"):
        make(window_frames=15)


def test_an_optimizer_with_loops_needs_a_pair_head() -> None:
    with pytest.raises(ValueError, match="pair head"):
        OnlineTrajectory(small_optimizer(), None)


def test_loading_checks_that_the_networks_belong_together(tmp_path: Path) -> None:
    write_untrained(tmp_path, "maze2d")
    core = OnlineTrajectory.load(tmp_path, 100, "maze2d")
    assert core.window_frames == 96
    with pytest.raises(CheckpointError, match="was trained for the world"):
        OnlineTrajectory.load(tmp_path, 100, "maze3d")
    from ngo_estimator.checkpoint import OPTIMIZER, load_optimizer, save_checkpoint

    optimizer, _ = load_optimizer(tmp_path)
    path = tmp_path / f"{OPTIMIZER}.safetensors"
    save_checkpoint(path, optimizer, OPTIMIZER, "maze2d", {"place_encoder_sha256": "0" * 64})
    with pytest.raises(CheckpointError, match="another place encoder") as error:
        OnlineTrajectory.load(tmp_path, 100)
    assert str(tmp_path) in str(error.value) and "\n" not in str(error.value)


def test_with_answers_first_loops_are_judged_anew_more_often_than_the_network_runs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    optimizer, kinds = small_optimizer("loops", True), []
    core = OnlineTrajectory(optimizer, small_pair_head(), 1200, iterations_per_step=1)
    iterate, resume = optimizer.iterate, core._back_end._resume

    def kind(steps: object, loops: object, corrections: object) -> object:
        kinds.append("network" if corrections is None else "anew")
        return iterate(steps, loops, corrections)

    monkeypatch.setattr(optimizer, "iterate", kind)
    monkeypatch.setattr(core._back_end, "_resume", lambda *given: (kinds.append("resumed"), resume(*given))[1])
    for step in make_steps(1600):
        core.update(step)
    core.finish()
    newest = kinds[-80:]
    judged = [number for number, of in enumerate(newest) if of != "resumed"]
    assert max(np.diff(judged)) == 8
    ran = [number for number, of in enumerate(newest) if of == "network"]
    assert len(ran) >= 3 and min(np.diff(ran)) > 8
    assert kinds[:8] == ["network"] * 8  # a short trajectory changes a lot with each meta-pose
