"""Whatever comes, in whatever order: both cores refuse it in one line or give finite poses, and go on."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ngo_estimator.checkpoint import WORLD_IMAGES, PlaceNetworks
from ngo_estimator.data.relative_step import RESTART_AFTER_NS, RejectedStep, RelativeStep
from ngo_estimator.frontend.camera.frame_pairing import FramePairing
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from ngo_estimator.frontend.rejected_frames import RejectedFrame
from ngo_estimator.networks.local_pose_network import LocalPoseNetwork
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate
from tests.unit.ngo_estimator.samples import local_config, place_config, small_optimizer

PERIOD_NS = 100_000_000
WORLDS = ["maze2d", "maze3d"]


def make_odometry(world: str) -> LocalOdometry:
    torch.manual_seed(0)
    network = LocalPoseNetwork(local_config(world, feature_size=6))
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    place = PlaceNetworks(place_config(world, code_size=12, embedding_size=8, pair_hidden_size=16))
    return LocalOdometry(network.requires_grad_(False), place.requires_grad_(False), world)


def make_trajectory() -> OnlineTrajectory:
    torch.manual_seed(0)
    head = PairHead(place_config("maze2d", code_size=12, embedding_size=8, pair_hidden_size=16))
    return OnlineTrajectory(small_optimizer("loops", trained=True), head.eval().requires_grad_(False), 40)


ODOMETRY = {world: make_odometry(world) for world in WORLDS}
TRAJECTORY = make_trajectory()


@dataclass(frozen=True)
class FramePlan:
    """One frame of a sequence, and what becomes of its action and of the relative pose that it gives."""

    advance_ns: int
    image: str
    action: int | None
    action_late: bool
    relative_pose: str
    repeat: int


# What is ordinary comes often, so that what is not meets a core in all its states.
plans = st.builds(
    FramePlan,
    advance_ns=st.sampled_from([PERIOD_NS] * 8 + [1, 0, -1, -PERIOD_NS, -2 * RESTART_AFTER_NS, 7 * PERIOD_NS, 10**17]),
    image=st.sampled_from(["plain"] * 8 + ["black", "largest", "nan", "infinite", "negative", "size", "type", "flat"]),
    action=st.sampled_from([0, 1, 2] * 3 + [None, 3, -1, 10**30]),
    action_late=st.sampled_from([False] * 5 + [True]),
    relative_pose=st.sampled_from(["passed"] * 8 + ["lost", "doubled", "held back", "nan", "infinite", "short", "0"]),
    repeat=st.sampled_from([1, 1, 1, 9]),
)


def image_of(world: str, kind: str, seed: int) -> np.ndarray:
    """An image of a world, spoilt in one way."""
    shape, dtype = WORLD_IMAGES[world].shape, np.dtype(WORLD_IMAGES[world].dtype)
    image = (np.random.default_rng(seed).random(shape) * (255 if dtype == np.uint8 else 1)).astype(dtype)
    if kind == "size":
        return image[:, :-1]
    if kind == "type":
        return image.astype(np.float64)
    if kind == "flat":
        return image.ravel()
    if kind == "black":
        return np.zeros_like(image)
    if dtype == np.uint8:
        return np.full_like(image, 255) if kind == "largest" else image
    values = {"largest": np.finfo(np.float32).max, "nan": np.nan, "infinite": np.inf, "negative": -1e30}
    if kind in values:
        image[0, seed % shape[1]] = values[kind]
    return image


def step_of(estimate: LocalEstimate, kind: str) -> RelativeStep:
    """What arrives of a relative pose."""
    names = [name for name in vars(estimate) if name not in ("missed_frames", "repeated")]
    step = RelativeStep(**{name: getattr(estimate, name) for name in names})
    if kind == "nan":
        return replace(step, relative_xyyaw=np.full(3, np.nan))
    if kind == "infinite":
        return replace(step, odom_xyyaw=np.array([0.0, np.inf, 0.0]))
    if kind == "short":
        return replace(step, motion_feature=step.motion_feature[:-1])
    if kind == "0":
        return replace(step, covariance=np.zeros((3, 3)))
    return step


def assert_one_line(error: Exception) -> None:
    assert str(error) and "\n" not in str(error)


def assert_finite(estimate: LocalEstimate) -> None:
    for name in ("relative_xyyaw", "covariance", "odom_xyyaw", "motion_feature", "place_code"):
        assert np.isfinite(getattr(estimate, name)).all(), name
    assert (np.diagonal(estimate.covariance) > 0.0).all()
    assert estimate.stamp_ns > estimate.from_stamp_ns >= estimate.origin_stamp_ns
    assert estimate.missed_frames >= 0


def assert_sound(update: TrajectoryUpdate) -> None:
    for name in ("pose_xyyaw", "covariance", "map_from_odom_xyyaw", "largest_move_m", "window_fill"):
        assert np.isfinite(getattr(update, name)).all(), name
    assert np.linalg.eigvalsh(update.covariance)[0] >= -1e-9 * max(1e-3, np.abs(update.covariance).max())
    assert update.frames >= 2


@pytest.mark.parametrize("world", WORLDS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
@given(sequence=st.lists(plans, min_size=1, max_size=14))
def test_no_sequence_of_messages_breaks_the_chain(world: str, sequence: list[FramePlan]) -> None:
    """Frames and actions through pairing, odometry and trajectory, as the two nodes chain them."""
    odometry, trajectory = ODOMETRY[world], TRAJECTORY
    odometry.reset()
    trajectory.reset()
    pairing = FramePairing(True, RESTART_AFTER_NS, 8)
    held_back: list[RelativeStep] = []
    stamp_ns = 10**18
    for count, plan in enumerate(each for each in sequence for _ in range(each.repeat)):
        if plan.action is not None and not plan.action_late:
            pairing.add_action(stamp_ns, plan.action)
        before_ns, stamp_ns = stamp_ns, stamp_ns + plan.advance_ns
        try:
            pairing.add_frame(stamp_ns, image_of(world, plan.image, count))
        except RejectedFrame as error:
            assert_one_line(error)
        if plan.action is not None and plan.action_late:
            pairing.add_action(before_ns, plan.action)
        for pair in pairing.ready():
            try:
                estimate = odometry.update(pair.stamp_ns, pair.image, pair.action)
            except RejectedFrame as error:
                assert_one_line(error)
                continue
            if estimate is None:
                continue
            assert_finite(estimate)
            step = step_of(estimate, plan.relative_pose)
            if plan.relative_pose == "held back":
                held_back.append(step)
                continue
            if plan.relative_pose == "lost":
                continue
            for arriving in [step, *([step] if plan.relative_pose == "doubled" else []), *held_back]:
                try:
                    update = trajectory.update(arriving, optimize=count % 5 > 0)
                except RejectedStep as error:
                    assert_one_line(error)
                    continue
                assert_sound(update)
                assert update.stamp_ns == arriving.stamp_ns
            held_back.clear()
    whole = trajectory.trajectory()
    if whole is not None:
        assert np.isfinite(whole.poses_xyyaw).all() and np.isfinite(whole.online_xyyaw).all()
        assert (np.diff(whole.stamps_ns) > 0).all()


def test_the_plain_sequence_does_reach_the_optimizer() -> None:
    """What the test above does with good messages alone is no empty exercise."""
    odometry, trajectory = ODOMETRY["maze2d"], TRAJECTORY
    odometry.reset()
    trajectory.reset()
    optimized = 0
    for count in range(40):
        estimate = odometry.update(10**18 + count * PERIOD_NS, image_of("maze2d", "plain", count), count % 3)
        if estimate is not None:
            optimized += trajectory.update(step_of(estimate, "passed")).optimized
    assert optimized == 4
    whole = trajectory.trajectory()
    assert whole is not None and np.abs(whole.poses_xyyaw - whole.odometry_xyyaw).max() > 1e-3
