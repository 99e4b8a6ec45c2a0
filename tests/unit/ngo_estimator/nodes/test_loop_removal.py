"""A loop of several robots is named so that one alone can be meant."""

from typing import Any

from ngo_msgs.srv import RemoveLoop
from rclpy.logging import get_logger

from ngo_estimator.nodes.loop_removal import remove_loops
from ngo_estimator.nodes.messages import to_time
from ngo_estimator.slam.fleet import Fleet
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from tests.unit.ngo_estimator.slam.test_fleet import drive, robots


def test_a_stamp_that_two_robots_have_and_a_stretch_over_both_are_refused() -> None:
    fleet, steps = Fleet(ScanTrajectory(), ["red", "blue"]), robots()["red"][:3]
    for robot in fleet.robots:  # with the same stamps
        drive(fleet, robot, steps)

    def said(**fields: Any) -> str:
        response = RemoveLoop.Response()
        assert not remove_loops(fleet.core, RemoveLoop.Request(**fields), response, get_logger("test"))
        return str(response.message)

    stamp, ids = to_time(steps[1].stamp_ns), {"first_id": 0, "second_id": 7}
    assert said(first=stamp, second_id=0) == "2 poses have the stamp 2.000000000; expected an id, as save_graph has it"
    assert "expected a single one" in said(what=RemoveLoop.Request.STRETCH, **ids)
    assert "no loop joins these poses" in said(**ids)
