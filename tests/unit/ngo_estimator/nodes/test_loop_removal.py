"""A loop of several robots is named so that one alone can be meant."""

from typing import Any

import numpy as np
from ngo_msgs.srv import RemoveLoop
from rclpy.logging import get_logger

from ngo_estimator.nodes.loop_removal import remove_loops
from ngo_estimator.nodes.messages import to_time
from ngo_estimator.slam.fleet import Fleet
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from ngo_estimator.trajectory.g2o import PlanarGraph
from tests.unit.ngo_estimator.slam.test_fleet import drive, robots


def answer(fleet: Fleet, saved: PlanarGraph | None, **fields: Any) -> RemoveLoop.Response:
    request, response = RemoveLoop.Request(**fields), RemoveLoop.Response()
    written = None if saved is None else (saved.stamps_ns, saved.ranks)
    done = remove_loops(fleet.core, written, request, response, get_logger("test"))
    assert done == response.success
    return response


def test_a_stamp_that_two_robots_have_and_a_stretch_over_both_are_refused() -> None:
    fleet, steps = Fleet(ScanTrajectory(), ["red", "blue"]), robots()["red"][:3]
    for robot in fleet.robots:  # with the same stamps
        drive(fleet, robot, steps)
    stamp, ids = to_time(steps[1].stamp_ns), {"first_id": 0, "second_id": 7}
    assert "expected save_graph before" in answer(fleet, None, **ids).message
    saved = fleet.planar_graph()
    message = answer(fleet, saved, first=stamp, second_id=0).message
    assert message == "2 poses have the stamp 2.000000000; expected an id, as save_graph has it"
    assert "expected a single one" in answer(fleet, saved, what=RemoveLoop.Request.STRETCH, **ids).message
    assert "no loop joins these poses" in answer(fleet, saved, **ids).message
    assert "there is no vertex 8; expected 0 to 7" in answer(fleet, saved, first_id=8, second_id=0).message
    fleet.reset()
    drive(fleet, "blue", robots()["blue"][:1])
    assert "the pose of vertex 0 is gone" in answer(fleet, saved, **ids).message


def test_ids_of_a_saved_graph_name_its_poses_when_another_robot_has_driven_on() -> None:
    fleet, steps = Fleet(ScanTrajectory(), ["red", "blue"]), robots()["red"]
    for robot in fleet.robots:  # with the same stamps
        drive(fleet, robot, steps[:50])
    drive(fleet, "red", steps[50:52])

    def loops(graph: PlanarGraph | None) -> set[tuple[int, ...]]:
        assert graph is not None and graph.ranks is not None
        names = np.stack((graph.ranks, graph.stamps_ns), axis=1)[graph.edges[graph.is_loop]]
        return set(map(tuple, names.reshape(-1, 4).tolist()))

    saved = fleet.planar_graph()
    assert saved is not None
    first, second = saved.edges[saved.is_loop][0].tolist()
    drive(fleet, "blue", steps[50:52])
    now = fleet.planar_graph()
    assert now is not None and saved.ranks is not None and now.ranks is not None
    gone = tuple(int(of[name]) for name in (first, second) for of in (saved.ranks, saved.stamps_ns))
    assert gone in loops(now) and now.ranks[first] != saved.ranks[first]
    assert answer(fleet, saved, first_id=first, second_id=second).success
    assert loops(now) - loops(fleet.planar_graph()) == {gone}
