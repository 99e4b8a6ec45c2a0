"""Simulated robots that are driven by `cmd_vel` over DDS."""

import pytest
from geometry_msgs.msg import PointStamped, Twist, Vector3
from nav_msgs.msg import Odometry

from .processes import NodeProcess, Probe

pytestmark = pytest.mark.processes


@pytest.mark.parametrize(
    ("executable", "parameters"),
    [("maze2d", {"rows": 3, "cols": 3}), ("building2d", {"scale": 0.3, "layout": "ring", "rays": 36})],
)
def test_it_drives_as_told_collides_and_stops_when_nobody_speaks(
    probe: Probe, executable: str, parameters: dict[str, object]
) -> None:
    truth, collisions = probe.collect(Odometry, "ground_truth"), probe.collect(PointStamped, "collision")
    command = probe.node.create_publisher(Twist, "cmd_vel", 10)
    with NodeProcess("ngo_sim", executable, {**parameters, "driver": "cmd_vel", "rate": 50.0}) as node:
        probe.spin_until(lambda: len(truth) > 3, "frames")
        assert truth[-1].twist.twist.linear.x == 0.0, "it stands until it is told to drive"

        def driven() -> bool:
            command.publish(Twist(linear=Vector3(x=0.6)))
            return bool(collisions)

        probe.spin_until(driven, "a collision")
        assert max(message.twist.twist.linear.x for message in truth) > 0.05
        seen = len(truth)
        # A timeout of 0.5 s of simulated time is five frames.
        probe.spin_until(lambda: len(truth) > seen + 30, "frames after the last command")
        assert truth[-1].twist.twist.linear.x == pytest.approx(0.0, abs=1e-6)
        assert collisions[0].header.frame_id == truth[0].header.frame_id
        assert node.running


def test_a_plan_that_is_not_there_is_one_line_and_exit_code_2() -> None:
    with NodeProcess("ngo_sim", "building2d", {"plan": "/nowhere/plan.yaml"}) as node:
        assert node.wait() == 2
        assert any("/nowhere/plan.yaml" in line for line in node.lines), node.log
