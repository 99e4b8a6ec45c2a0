"""The local odometry as a state machine: what each kind of frame does to it, and what it never does."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import PlaceNetworks, load_local, write_untrained
from ngo_estimator.data.relative_step import RESTART_AFTER_NS
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.frontend.camera.frame_pairing import PairedFrame
from ngo_estimator.frontend.camera.local_odometry import LocalEstimate, LocalOdometry
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, RejectedFrame, UnusableImage
from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import NO_ACTION, LocalPoseNetwork
from ngo_estimator.networks.odometry_smoothing import SmootherConfig
from tests.unit.ngo_estimator.samples import WORLDS, local_config, observations, place_config

PERIOD_NS = 100_000_000


def make(world: str = "maze2d", actions: int = 3) -> LocalOdometry:
    torch.manual_seed(0)
    config = local_config(world, actions=actions, feature_size=8, relative_std=(0.1, 0.02, 0.05))
    return LocalOdometry(LocalPoseNetwork(config), PlaceNetworks(place_config(world, code_size=16)), world)


def frames(count: int, world: str = "maze2d") -> np.ndarray:
    return observations(world, count).numpy()


def same(a: LocalEstimate, b: LocalEstimate) -> bool:
    return all(np.array_equal(value, getattr(b, name)) for name, value in vars(a).items())


@pytest.mark.parametrize("world", WORLDS)
def test_first_frame_gives_nothing_and_each_later_one_a_motion(world: str) -> None:
    odometry, images = make(world), frames(5, world)
    assert odometry.update(7, images[0], None) is None
    estimates = [odometry.update(7 + k * PERIOD_NS, images[k], k % 3) for k in range(1, 5)]
    pose = torch.zeros(3, dtype=torch.float64)
    for k, estimate in enumerate(estimates, start=1):
        assert estimate is not None
        assert (estimate.from_stamp_ns, estimate.stamp_ns) == (7 + (k - 1) * PERIOD_NS, 7 + k * PERIOD_NS)
        assert estimate.origin_stamp_ns == 7 and estimate.missed_frames == 0
        assert estimate.relative_xyyaw.shape == (3,) and estimate.relative_xyyaw.dtype == np.float64
        assert estimate.covariance.shape == (3, 3) and (np.diagonal(estimate.covariance) > 0.0).all()
        assert estimate.motion_feature.shape == (8,) and estimate.motion_feature.dtype == np.float32
        assert estimate.place_code.shape == (16,) and estimate.place_code.dtype == np.float32
        pose = se2.compose(pose, torch.from_numpy(estimate.relative_xyyaw))
        np.testing.assert_allclose(estimate.odom_xyyaw, pose.numpy(), atol=1e-12)
    assert odometry.world == world and odometry.image_format.shape == images[0].shape
    assert odometry.image_format.dtype == images.dtype.name and odometry.uses_action and odometry.period_s == 0.1


def test_estimates_are_those_of_the_networks() -> None:
    odometry, images = make(), frames(2)
    odometry.update(0, images[0], None)
    estimate = odometry.update(PERIOD_NS, images[1], 1)
    assert estimate is not None
    pair = [torch.from_numpy(images[k : k + 1]) for k in range(2)]
    with torch.no_grad():
        relative, log_std, feature = odometry._network(*pair, torch.tensor([1]))
        code = odometry._encoder(pair[1])
    np.testing.assert_array_equal(estimate.relative_xyyaw, relative[0].double().numpy())
    np.testing.assert_allclose(np.diagonal(estimate.covariance), torch.exp(2.0 * log_std[0].double()).numpy())
    np.testing.assert_array_equal(estimate.motion_feature, feature[0].numpy())
    np.testing.assert_array_equal(estimate.place_code, code[0].numpy())


@pytest.mark.parametrize(
    ("stamp_ns", "expected"),
    [
        (PERIOD_NS, DuplicateFrame),
        (PERIOD_NS - 1, LateFrame),
        (PERIOD_NS - RESTART_AFTER_NS + 1, LateFrame),
    ],
)
def test_frames_that_come_twice_or_late_are_refused(stamp_ns: int, expected: type[RejectedFrame]) -> None:
    odometry, images = make(), frames(3)
    odometry.update(0, images[0], None)
    odometry.update(PERIOD_NS, images[1], 0)
    with pytest.raises(expected):
        odometry.update(stamp_ns, images[2], 0)
    assert issubclass(expected, ValueError)


WRONG = {
    "another shape": (np.zeros((1, 240, 4), np.float32), 0),
    "no height": (np.zeros((241, 4), np.float32), 0),
    "another type": (np.zeros((1, 241, 4), np.float64), 0),
    "nan": (np.full((1, 241, 4), np.nan, np.float32), 0),
    "infinite": (np.full((1, 241, 4), np.inf, np.float32), 0),
    "negative depth": (np.full((1, 241, 4), -0.3, np.float32), 0),
    "colour out of range": (np.full((1, 241, 4), 1e30, np.float32), 0),
    "no action": (np.zeros((1, 241, 4), np.float32), None),
    "negative action": (np.zeros((1, 241, 4), np.float32), -1),
    "unknown action": (np.zeros((1, 241, 4), np.float32), 3),
}


@pytest.mark.parametrize("what", [*WRONG, "duplicate", "late"])
def test_a_refused_frame_leaves_no_trace(what: str) -> None:
    images = frames(4)
    odometry, undisturbed = make(), make()
    for core in (odometry, undisturbed):
        core.update(0, images[0], None)
        core.update(PERIOD_NS, images[1], 1)
    if what in WRONG:
        with pytest.raises(UnusableImage, match=r"expected|not finite"):
            odometry.update(2 * PERIOD_NS, *WRONG[what])
    else:
        with pytest.raises(RejectedFrame):
            odometry.update(PERIOD_NS if what == "duplicate" else PERIOD_NS // 2, images[3], 1)
    a, b = (core.update(2 * PERIOD_NS, images[2], 2) for core in (odometry, undisturbed))
    assert a is not None and b is not None and same(a, b)
    assert odometry.restarts == 0


@pytest.mark.parametrize("back_ns", [RESTART_AFTER_NS, 100 * RESTART_AFTER_NS])
def test_a_restarted_source_begins_a_new_odometry(back_ns: int) -> None:
    odometry, images, fresh = make(), frames(5), make()
    for k in range(3):
        odometry.update(1000 * RESTART_AFTER_NS + k * PERIOD_NS, images[k], 0)
    start = 1000 * RESTART_AFTER_NS + 2 * PERIOD_NS - back_ns
    for core in (odometry, fresh):
        assert core.update(start, images[3], 0) is None
    assert odometry.restarts == 1
    a, b = (core.update(start + PERIOD_NS, images[4], 0) for core in (odometry, fresh))
    assert a is not None and b is not None and same(a, b)
    assert a.origin_stamp_ns == start


def test_reset_forgets_everything() -> None:
    odometry, images, fresh = make(), frames(4), make()
    for k in range(3):
        odometry.update(k * PERIOD_NS, images[k], 0)
    odometry.reset()
    for core in (odometry, fresh):
        assert core.update(PERIOD_NS, images[0], 0) is None
    a, b = (core.update(2 * PERIOD_NS, images[3], 1) for core in (odometry, fresh))
    assert a is not None and b is not None and same(a, b)
    assert odometry.restarts == 0


@pytest.mark.parametrize("missed", [0, 1, 9])
def test_missing_frames_are_counted_and_widen_the_covariance(missed: int) -> None:
    images = frames(2)
    estimates = []
    for steps in (1, 1 + missed):
        odometry = make()
        odometry.update(0, images[0], None)
        # Stamps jitter; a fifth of a period is no missing frame.
        estimates.append(odometry.update(steps * PERIOD_NS + PERIOD_NS // 5, images[1], 0))
    plain, gap = estimates
    assert plain is not None and gap is not None
    assert (plain.missed_frames, gap.missed_frames) == (0, missed)
    np.testing.assert_array_equal(gap.relative_xyyaw, plain.relative_xyyaw)
    added = np.diagonal(gap.covariance - plain.covariance)
    np.testing.assert_allclose(np.sqrt(added), missed * np.array([0.1, 0.02, 0.05]), rtol=1e-6)


def test_the_network_is_told_the_latest_actions_until_a_frame_is_missed_or_the_odometry_begins_anew() -> None:
    config, images = local_config("maze2d", action_history=3), frames(6)
    odometry = LocalOdometry(LocalPoseNetwork(config), PlaceNetworks(place_config("maze2d")), "maze2d")
    told: list[list[int]] = []
    odometry._network.register_forward_pre_hook(lambda _, inputs: told.append(inputs[2][0].tolist()))
    stamps = iter(range(0, 1000 * PERIOD_NS, PERIOD_NS))
    odometry.update(next(stamps), images[0], 2)  # nobody knows what led to the first frame
    for action in (0, 1):
        odometry.update(next(stamps), images[1], action)
    with pytest.raises(UnusableImage):
        odometry.update(next(stamps), images[2], 3)
    for action in (2, 0, 0):
        odometry.update(next(stamps), images[3], action)
    assert told[:2] == [[NO_ACTION, NO_ACTION, 0], [NO_ACTION, 0, 1]]
    assert told[2:] == [[NO_ACTION, NO_ACTION, 2], [NO_ACTION, 2, 0], [2, 0, 0]]
    odometry.reset()
    odometry.update(next(stamps), images[4], 1)
    odometry.update(next(stamps), images[5], 2)
    assert told[-1] == [NO_ACTION, NO_ACTION, 2]


def test_steps_are_corrected_by_those_before_them_as_of_a_whole_drive_until_a_frame_is_missed() -> None:
    memory = SmootherConfig(8, (0.1, 0.02, 0.05), (1, 2), 4, causal=True)
    torch.manual_seed(0)
    network = LocalPoseNetwork(local_config("maze2d", actions=0, feature_size=8, memory=memory)).eval()
    assert network.memory is not None
    torch.nn.init.normal_(network.memory.head.weight)
    images = torch.from_numpy(frames(16))

    def drive(first: int) -> torch.Tensor:
        return torch.cat(network.remembered(*network(images[first:-1], images[first + 1 :])), dim=-1)

    with torch.inference_mode():
        alone, whole, after_it = torch.cat(network(images[:-1], images[1:])[:2], dim=-1), drive(0), drive(9)
    odometry = LocalOdometry(network, PlaceNetworks(place_config("maze2d")), "maze2d")
    for missed, expected in ((0, whole), (1, torch.cat((whole[:8], alone[8:9], after_it)))):
        odometry.reset()
        late = [k * PERIOD_NS + (missed * PERIOD_NS if k > 8 else 0) for k in range(16)]
        steps = [odometry.update(stamp_ns, image, None) for stamp_ns, image in zip(late, images.numpy(), strict=True)]
        found = [step.relative_xyyaw for step in steps if step is not None]
        np.testing.assert_allclose(found, expected[:, :3], atol=1e-6)
        stds = [np.sqrt(np.diagonal(step.covariance)) for step in steps if step is not None and not step.missed_frames]
        known = expected[[k for k in range(15) if not (missed and k == 8)], 3:]
        np.testing.assert_allclose(stds, known.exp(), rtol=1e-4)
    assert float((whole - alone).abs().max()) > 1e-3


@pytest.mark.parametrize("twist", [None, np.zeros(2), np.array([0.1, np.nan, 0.0]), 0.3])
def test_a_network_that_is_told_the_velocity_needs_it(twist: np.ndarray | None) -> None:
    config, images = local_config("maze2d", actions=0, twist=True), frames(2)
    odometry = LocalOdometry(LocalPoseNetwork(config), PlaceNetworks(place_config("maze2d")), "maze2d")
    assert odometry.uses_twist and not make().uses_twist
    odometry.update(0, images[0], None)
    with pytest.raises(UnusableImage, match="expected three finite numbers"):
        odometry.update(PERIOD_NS, images[1], None, twist)
    assert odometry.update(PERIOD_NS, images[1], None, np.array([0.4, 0.0, 0.1])) is not None


@pytest.mark.parametrize("world", WORLDS)
def test_loading_checks_that_the_networks_belong_together(world: str, tmp_path: Path) -> None:
    write_untrained(tmp_path, world)
    odometry = LocalOdometry.load(tmp_path, world)
    assert odometry.world == world
    assert odometry.period_s == load_local(tmp_path)[0].config.period_s
    with pytest.raises(CheckpointError, match="was trained for the world"):
        LocalOdometry.load(tmp_path, "maze3d" if world == "maze2d" else "maze2d")
    other = tmp_path / "other"
    write_untrained(other, "maze3d" if world == "maze2d" else "maze2d")
    for suffix in (".json", ".safetensors"):
        (tmp_path / f"place_encoder{suffix}").write_bytes((other / f"place_encoder{suffix}").read_bytes())
    with pytest.raises(CheckpointError) as error:
        LocalOdometry.load(tmp_path)
    assert "place_encoder.json" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["actions", "memory", "twist"])
def test_frames_at_once_are_as_one_by_one_with_gaps_refused_frames_and_restarts(kind: str) -> None:
    memory = SmootherConfig(8, (0.1, 0.02, 0.05), dilations=(1, 2), width=8, causal=True)
    settings = {
        "actions": {"actions": 3, "action_history": 3},
        "memory": {"actions": 3, "memory": memory},
        "twist": {"actions": 0, "twist": True},
    }[kind]

    def core() -> LocalOdometry:
        torch.manual_seed(0)
        config = local_config("maze2d", feature_size=8, relative_std=(0.1, 0.02, 0.05), **settings)  # type: ignore[arg-type]
        network = LocalPoseNetwork(config)
        if network.memory is not None:  # as one that has learned
            torch.nn.init.normal_(network.memory.head.weight)
        return LocalOdometry(network, PlaceNetworks(place_config("maze2d", code_size=16)), "maze2d")

    images = frames(16)
    broken = np.full_like(images[0], np.nan)
    # Step 6 is missing, one comes twice, one late, one is broken; then the source restarts, twice.
    numbers = [0, 1, 2, 3, 4, 5, 7, 7, 6, 8, 9, -100, -99, -98, -200, -199]
    played = [
        PairedFrame(k * PERIOD_NS, broken if at == 9 else images[at], at % 3, np.array([0.1 * at, 0.0, 0.2]))
        for at, k in enumerate(numbers)
    ]
    single, together = core(), core()
    expected: list[LocalEstimate | RejectedFrame | None] = []
    for frame in played:
        try:
            expected.append(single.update(frame.stamp_ns, frame.image, frame.action, frame.twist))
        except RejectedFrame as error:
            expected.append(error)
    found = [result for at in (0, 1, 9) for result in together.update_all(played[at : {0: 1, 1: 9, 9: 16}[at]])]
    assert [type(result) for result in found] == [type(result) for result in expected]
    assert sum(result is None for result in found) == together.restarts + 1 == single.restarts + 1 == 3
    for ours, one in zip(found, expected, strict=True):
        if isinstance(ours, RejectedFrame):
            assert str(ours) == str(one)
        if not isinstance(ours, LocalEstimate):
            continue
        for name, value in vars(ours).items():
            theirs = getattr(one, name)
            if isinstance(value, np.ndarray):
                np.testing.assert_allclose(value, theirs, rtol=1e-4, atol=1e-6, err_msg=name)
            else:
                assert value == theirs, name
