"""What arrives broken at ngo_node: a real process, fed by the test with what a bad day brings.

Each test drives anew, with stamps long before those of the one before it, which is what a restarted source looks like.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Path as PathMessage
from ngo_msgs.msg import RelativePose
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from ngo_estimator.nodes import messages
from ngo_estimator.nodes.messages import to_ns, to_time
from ngo_estimator.slam.online_trajectory import OnlineTrajectory

from .processes import NodeProcess, Probe
from .relative_poses import Optimizer, assert_pose_is

pytestmark = pytest.mark.processes

SOURCE_TIMEOUT_S = 0.3


@pytest.fixture(scope="module")
def parameters(weights: Path) -> dict[str, object]:
    return {
        "world": "maze2d",
        "weights": str(weights),
        "diagnostics_period_s": 0.1,
        "source_timeout_s": SOURCE_TIMEOUT_S,
        "lost_position_std_m": 0.5,
    }


@pytest.fixture(scope="module")
def optimizer(weights: Path, parameters: dict[str, object]) -> Iterator[Optimizer]:
    with Probe() as probe, NodeProcess("ngo_estimator", "ngo_node", parameters) as process:
        yield Optimizer(process, weights, probe)
        assert process.running, process.log
        assert "Traceback" not in process.log, process.log


def test_lost_steps_become_a_gap_that_is_flagged_and_has_a_large_covariance(optimizer: Optimizer) -> None:
    drive = optimizer.drive()
    steps = [*drive.steps(1, 5), *drive.steps(16, 20)]
    gaps = optimizer.count("gaps")
    optimizer.diagnostics.clear()
    optimizer.publish(*steps)
    pose = optimizer.wait_for_stamp(drive.stamp_ns(20))
    assert_pose_is(pose, optimizer.expected(steps))
    optimizer.probe.spin_until(
        lambda: any("1 gaps in the relative poses" in status.message for status in optimizer.statuses()), "the flag"
    )
    optimizer.wait_for_value("gaps", lambda value: int(value) == gaps + 1)
    before, after = (np.array(optimizer.poses[k].pose.covariance).reshape(6, 6)[5, 5] for k in (4, 5))
    assert after > before + 10 * 0.01**2, "ten steps were lost, and one came"
    odometry = (drive.step(20).odom_x, drive.step(20).odom_y)
    assert np.hypot(*odometry) > 0.5, "the test drives nowhere"


def test_while_lost_covariance_and_diagnostics_say_so(optimizer: Optimizer) -> None:
    drive = optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 2))
    far = drive.step(9003)  # a quarter of an hour later
    optimizer.publish(far)
    pose = optimizer.wait_for_stamp(drive.stamp_ns(9003))
    assert np.sqrt(pose.pose.covariance[0]) > 0.5
    optimizer.wait_for_problem("lost: the standard deviation of the position is ")


def test_a_stream_that_ends_with_a_meta_pose_leaves_the_whole_path_optimised(optimizer: Optimizer) -> None:
    paths = optimizer.probe.collect(PathMessage, "ngo/path")
    optimizer.meet()
    drive = optimizer.drive()
    steps = drive.steps(1, 40)  # the fifth meta-pose is complete, and not optimised
    core = OnlineTrajectory.load(optimizer.weights, iterations_per_step=1)
    for step in steps:
        core.update(messages.relative_step(step))
    assert core.unfinished
    core.finish()
    expected = core.trajectory()
    assert expected is not None

    def ended_so() -> bool:
        if not paths or to_ns(paths[-1].header.stamp) != drive.stamp_ns(40):
            return False
        found = np.array([(pose.pose.position.x, pose.pose.position.y) for pose in paths[-1].poses])
        return found.shape == (41, 2) and bool(np.allclose(found, expected.poses_xyyaw[:, :2], atol=1e-9))

    optimizer.publish(*steps)
    optimizer.probe.spin_until(ended_so, "the path that is optimised to its end")


def test_time_that_jumps_back_is_a_clean_reset(optimizer: Optimizer) -> None:
    """A bag that is played in a loop: the same stamps, the same origin."""
    drive = optimizer.drive()
    once = optimizer.pose_after(*drive.steps(1, 30))
    restarts = optimizer.count("restarts")
    optimizer.poses.clear()
    again = optimizer.pose_after(*drive.steps(1, 30))
    assert len(optimizer.poses) == 30
    assert again == once
    optimizer.wait_for_value("restarts", lambda value: int(value) == restarts + 1)


def test_a_publisher_of_another_qos_is_named(optimizer: Optimizer) -> None:
    best_effort = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    with Probe("careless_odometry") as other:
        other.node.create_publisher(RelativePose, "relative_pose", best_effort)
        message = optimizer.wait_for_problem("/careless_odometry", "'/relative_pose'", "best effort publisher")
        assert "nothing comes from" in message, message
        optimizer.process.wait_for_log("WARN.*nothing comes from /careless_odometry on '/relative_pose'")
    drive = optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 2))


def test_of_two_publishers_the_first_is_held_and_both_are_named(optimizer: Optimizer) -> None:
    intruder, drive = optimizer.drive(seed=7), optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 3))
    with Probe("second_odometry") as other:
        publisher = other.node.create_publisher(RelativePose, "relative_pose", 5000)
        other.spin_until(lambda: publisher.get_subscription_count() == 1, "a match")
        step = 3
        both = "/probe and /second_odometry publish on '/relative_pose': only the first that was heard counts"

        def named() -> bool:
            nonlocal step
            step += 1
            optimizer.publish(drive.step(step))
            publisher.publish(intruder.step(step))
            optimizer.wait_for_stamp(drive.stamp_ns(step))
            return step >= 40 and f"dropped message on relative_pose: {both}" in optimizer.process.log

        # Paused, because where a busy machine holds up the next step, ngo_node ends an optimisation at once.
        optimizer.pause(True)
        with optimizer.probe.patient("ngo_node", SOURCE_TIMEOUT_S):
            optimizer.probe.spin_until(named, "a warning that names both")
        optimizer.pause(False)
        assert optimizer.stamps_ns() == [drive.stamp_ns(k) for k in range(1, step + 1)]
        assert_pose_is(optimizer.poses[-1], optimizer.expected(drive.steps(1, step), optimize=False))

        # The first falls silent: the other takes its place.
        def taken_over() -> bool:
            nonlocal step
            step += 1
            publisher.publish(intruder.step(step))
            return optimizer.stamps_ns()[-1] > intruder.origin_ns

        optimizer.probe.spin_until(taken_over, "the second to take over")
        optimizer.wait_for_stamp(intruder.stamp_ns(step))


def test_a_subscriber_that_stalls_holds_nobody_up(optimizer: Optimizer) -> None:
    """A stopped process with a reliable subscription to the path: poses go on, and it may come back."""
    others = optimizer.probe.node.count_subscribers("ngo/path")
    listener = subprocess.Popen(
        [sys.executable, "-m", "tests.ros.listener", "ngo/path"], stdout=subprocess.PIPE, text=True
    )
    try:
        optimizer.probe.spin_until(
            lambda: optimizer.probe.node.count_subscribers("ngo/path") == others + 1, "the listener"
        )
        drive = optimizer.drive()
        optimizer.pose_after(*drive.steps(1, 8))
        assert listener.stdout is not None and int(listener.stdout.readline()) > 0
        listener.send_signal(signal.SIGSTOP)
        took_s = []
        for step in range(9, 400):
            started = time.monotonic()
            optimizer.pose_after(drive.step(step))
            took_s.append(time.monotonic() - started)
        assert sorted(took_s)[-3] < 1.0, "a busy machine may hold up one or two"
        assert optimizer.stamps_ns() == [drive.stamp_ns(step) for step in range(1, 400)]
        listener.send_signal(signal.SIGCONT)
        while int(listener.stdout.readline()) != 400:
            assert listener.poll() is None
    finally:
        listener.kill()
        listener.wait()


@pytest.mark.parametrize("rate_hz", [10, 200])
def test_slow_and_fast_input_is_taken_whole_and_the_path_keeps_its_pace(optimizer: Optimizer, rate_hz: int) -> None:
    paths = optimizer.probe.collect(PathMessage, "ngo/path")
    optimizer.meet()
    drive, count = optimizer.drive(period_ns=10**9 // rate_hz), max(10, rate_hz)
    begin = time.monotonic()
    for step in range(1, count + 1):
        optimizer.probe.spin_until(lambda due=begin + step / rate_hz: time.monotonic() >= due, "the time")
        optimizer.publish(drive.step(step))
    optimizer.wait_for_stamp(drive.stamp_ns(count))
    assert optimizer.stamps_ns() == [drive.stamp_ns(step) for step in range(1, count + 1)]
    optimizer.probe.spin_until(
        lambda: paths and to_ns(paths[-1].header.stamp) == drive.stamp_ns(count), "the whole path"
    )
    seconds = time.monotonic() - begin
    assert len(paths) <= 10 * seconds + 2


def test_silence_is_said(optimizer: Optimizer) -> None:
    drive = optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 3))
    optimizer.diagnostics.clear()
    optimizer.probe.spin_until(
        lambda: any(
            status.level == DiagnosticStatus.STALE and status.message.startswith("no input for ")
            for status in optimizer.statuses()
        ),
        "STALE in diagnostics",
    )


def test_a_killed_node_that_comes_back_goes_on_in_the_middle(weights: Path, parameters: dict[str, object]) -> None:
    """The odometry has gone on: the new map begins where the first step that it hears does."""
    namespace = ("-r", "__ns:=/revived")
    with Probe("steady_odometry") as probe:
        with NodeProcess("ngo_estimator", "ngo_node", parameters, namespace) as process:
            first = Optimizer(process, weights, probe, "/revived")
            drive = first.drive()
            first.publish(*drive.steps(1, 10))
            first.wait_for_stamp(drive.stamp_ns(10))
            process.send(signal.SIGKILL)
            process.wait()
            first.publish(*drive.steps(11, 15))
        with NodeProcess("ngo_estimator", "ngo_node", parameters, namespace) as process:
            process.wait_for_log("ready")
            first.poses.clear()
            step = 15

            def heard() -> bool:
                nonlocal step
                step += 1
                first.publish(drive.step(step))
                return bool(first.poses)

            probe.spin_until(heard, "a pose of the new node")
            begin = to_ns(first.poses[0].header.stamp)
            steps = [message for message in drive.steps(16, step) if to_ns(message.header.stamp) >= begin]
            pose = first.wait_for_stamp(drive.stamp_ns(step))
            assert_pose_is(pose, first.expected(steps))


def test_a_clock_that_stands_still_or_jumps_stops_nothing(weights: Path, parameters: dict[str, object]) -> None:
    """With use_sim_time: stamps come from the input, and pace and diagnostics from a clock that always goes on."""
    with Probe("clock") as probe:
        clock = probe.node.create_publisher(Clock, "/clock", 10)
        simulated = {**parameters, "use_sim_time": True}
        with NodeProcess("ngo_estimator", "ngo_node", simulated, ("-r", "__ns:=/simulated")) as process:
            optimizer = Optimizer(process, weights, probe, "/simulated")
            paths = probe.collect(PathMessage, "/simulated/ngo/path")
            probe.spin_until(lambda: clock.get_subscription_count() == 1, "a subscription of the clock")
            for clock_s in (0, 100, 100, 3):
                clock.publish(Clock(clock=to_time(clock_s * 10**9)))
                drive = optimizer.drive()
                pose = optimizer.pose_after(*drive.steps(1, 12))
                assert_pose_is(pose, optimizer.expected(drive.steps(1, 12)))
                probe.spin_until(lambda: paths and to_ns(paths[-1].header.stamp) == drive.stamp_ns(12), "the path")  # noqa: B023
                optimizer.wait_for_value("frames", "13".__eq__)
            newest = optimizer.diagnostics.arrays(optimizer.name)[-1]
            assert to_ns(newest.header.stamp) == drive.stamp_ns(12)
            process.send(signal.SIGINT)
            assert process.wait() == 0, process.log


def test_nothing_is_left_of_a_burst_of_rubbish(optimizer: Optimizer) -> None:
    """Empty messages, as a publisher of another program may send: dropped with one line, not one each."""
    optimizer.drive()
    lines = len(optimizer.process.lines)
    optimizer.publish(*(RelativePose() for _ in range(500)))
    drive = optimizer.drive()
    optimizer.pose_after(*drive.steps(1, 2))
    assert len(optimizer.poses) == 2
    assert len(optimizer.process.lines) <= lines + 3, optimizer.process.log
