"""~/save_state and ~/load_state: a session goes on in another process, and what cannot be loaded changes nothing."""

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import Transition
from ngo_msgs.msg import RelativePose, Trajectory
from ngo_msgs.srv import LoadState, SaveState

from ngo_estimator.nodes.messages import relative_step, trajectory_message
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.online_trajectory import OnlineTrajectory

from .processes import NodeProcess, Probe, end
from .relative_poses import Drive, Optimizer
from .test_control import Managed

pytestmark = pytest.mark.processes

INITIAL = (1.0, -2.0, 0.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("states")


@pytest.fixture(scope="module")
def parameters(weights: Path, folder: Path) -> dict[str, Any]:
    return {
        "world": "maze2d",
        "weights": str(weights),
        "save_directory": str(folder),
        "window_frames": 40,
        "key_frames": 2,
        "initial_pose": list(INITIAL),
        "path_rate_hz": 0.0,
    }


@pytest.fixture(scope="module")
def drive(weights: Path, parameters: dict[str, Any], folder: Path) -> Drive:
    """A drive whose first 60 steps a node took, saved to ``office``, and was killed."""
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
        optimizer = Optimizer(process, weights, probe)
        drive = optimizer.drive()
        optimizer.pose_after(*drive.steps(1, 60))
        response = probe.call(SaveState, "ngo_node/save_state", SaveState.Request(path="office"))
        assert response.success and response.message == f"wrote 61 poses to {folder}/office"
        process.send(signal.SIGKILL)
        process.wait()
    return drive


def expected(weights: Path, steps: list[RelativePose]) -> Trajectory:
    """The trajectory that a node publishes which took these steps without a break."""
    core = OnlineTrajectory.load(weights, 40, key_frames=2, iterations_per_step=1)
    for step in steps:
        core.update(relative_step(step))
    whole = core.trajectory()
    assert whole is not None
    message = trajectory_message(whole, "map")
    poses = MapOrigin.of_first_pose(np.array(INITIAL)).poses(whole.poses_xyyaw)
    message.x, message.y, message.yaw = (np.ascontiguousarray(column).tolist() for column in poses.T)
    return message


class Loaded:
    """A node that was started with the state ``office``."""

    def __init__(self, process: NodeProcess, probe: Probe, weights: Path) -> None:
        self.process, self.probe, self._weights = process, probe, weights
        self.trajectories: list[Trajectory] = probe.collect(Trajectory, "ngo/trajectory")
        self._publisher = probe.node.create_publisher(RelativePose, "relative_pose", 1000)

    def take(self, steps: list[RelativePose]) -> None:
        """Publish relative poses."""
        self.wait_for_subscriptions(1)
        for step in steps:
            self._publisher.publish(step)

    def wait_for_subscriptions(self, count: int) -> None:
        """Wait until as many subscriptions of relative poses are known."""
        self.probe.spin_until(lambda: self._publisher.get_subscription_count() == count, f"{count} subscriptions")

    def load(self, path: str = "office", mode: int = LoadState.Request.CONTINUE) -> LoadState.Response:
        """Call the service."""
        return self.probe.call(LoadState, "ngo_node/load_state", LoadState.Request(path=path, mode=mode))

    def assert_is_at(self, steps: list[RelativePose]) -> None:
        """The trajectory becomes the one after these steps, to the last bit."""
        message = expected(self._weights, steps)
        newest = message.stamps_ns[-1]
        self.probe.spin_until(
            lambda: self.trajectories and self.trajectories[-1].stamps_ns[-1] == newest, "the trajectory"
        )
        for name in message.get_fields_and_field_types():
            if name not in ("header", "moved"):
                got, wanted = getattr(self.trajectories[-1], name), getattr(message, name)
                np.testing.assert_array_equal(got, wanted, err_msg=name)


@pytest.fixture(scope="module")
def loaded(weights: Path, parameters: dict[str, Any], drive: Drive) -> Iterator[Loaded]:
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", {**parameters, "state": "office"}) as process:
        yield Loaded(process, probe, weights)
        end(process)


def test_another_process_goes_on_as_if_the_first_had_never_stopped(loaded: Loaded, drive: Drive) -> None:
    loaded.process.wait_for_log("goes on from a saved state of 61 poses")
    loaded.assert_is_at(drive.steps(1, 60))
    loaded.take(drive.steps(61, 116))
    loaded.assert_is_at(drive.steps(1, 116))


@pytest.mark.parametrize("state", ["active", "inactive"])
def test_a_state_is_loaded_where_the_node_runs_already(loaded: Loaded, drive: Drive, state: str) -> None:
    node = Managed(loaded.probe, "ngo_node")
    if state == "inactive":
        assert node.change(Transition.TRANSITION_DEACTIVATE)
        loaded.wait_for_subscriptions(0)
    response = loaded.load()
    assert response.success, response.message
    assert response.message.startswith("loaded 61 poses from ") and response.message.endswith("/office")
    if state == "inactive":
        assert node.change(Transition.TRANSITION_ACTIVATE)
    loaded.assert_is_at(drive.steps(1, 60))
    # A step was lost meanwhile: the odometry bridges it.
    later = drive.steps(62, 68)
    loaded.take(later)
    loaded.assert_is_at([*drive.steps(1, 60), *later])


def test_another_odometry_does_not_replace_what_was_loaded(loaded: Loaded, drive: Drive, weights: Path) -> None:
    assert loaded.load().success
    other = Drive(OnlineTrajectory.load(weights), drive.stamp_ns(1000))
    loaded.take([other.step(1)])
    loaded.process.wait_for_log("dropped relative pose: .*expected the odometry of that one to go on, or a reset")
    loaded.take(drive.steps(61, 67))
    loaded.assert_is_at(drive.steps(1, 67))


def test_what_cannot_be_loaded_or_saved_is_one_line_and_changes_nothing(
    loaded: Loaded, drive: Drive, folder: Path
) -> None:
    assert loaded.load().success
    damaged = folder / "damaged"
    damaged.mkdir()
    for path in (folder / "office").iterdir():
        content = bytearray(path.read_bytes())
        content[-1] ^= 1 if path.suffix == ".safetensors" else 0
        (damaged / path.name).write_bytes(bytes(content))
    refused = {
        ("damaged", 0): "is damaged",
        ("nothing", 0): "No such file",
        ("../office", 0): "expected a folder in",
        ("office", 7): "mode is 7; expected 0 (CONTINUE) or 1 (RELOCALISE)",
    }
    for arguments, reason in refused.items():
        response = loaded.load(*arguments)
        assert not response.success and reason in response.message and "\n" not in response.message, response
    before = (folder / "office" / "state.json").read_bytes()
    (folder / "thesis").mkdir()
    (folder / "thesis" / "main.tex").write_text("years of work")
    for path, reason in (
        ("/tmp/elsewhere", "expected a folder in"),
        ("thesis", "expected a saved state"),
        ("a/b", "No"),
    ):
        answer = loaded.probe.call(SaveState, "ngo_node/save_state", SaveState.Request(path=path))
        assert not answer.success and reason in answer.message and "\n" not in answer.message, answer
    assert (folder / "office" / "state.json").read_bytes() == before
    loaded.take(drive.steps(61, 70))
    loaded.assert_is_at(drive.steps(1, 70))


def test_a_start_with_a_state_that_cannot_be_loaded_is_one_line_and_exit_code_2(
    parameters: dict[str, Any], drive: Drive
) -> None:
    changed = {**parameters, "state": "office", "window_frames": 48}
    with NodeProcess("ngo_estimator", "ngo_node", changed) as process:
        assert process.wait() == 2, process.log
        assert len(process.lines) == 1, process.log
        assert "was saved with window_frames 40; here it is 48" in process.lines[0], process.log
