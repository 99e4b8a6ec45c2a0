"""When a robot goes back before it explores on, and where to."""

import numpy as np

from ngo_explorer.exploration import Exploration
from ngo_explorer.known_map import KnownMap
from ngo_explorer.planner import cost_field
from ngo_explorer.revisits import Revisits
from ngo_explorer.settings import ExplorerConfig

from .drawn_maps import RESOLUTION_M

CORRIDOR = np.pad(np.zeros((18, 298), np.int8), 1, constant_values=100)
"""A corridor of 30 m by 2 m."""


def known() -> KnownMap:
    found = KnownMap(0.2, 0.6)
    found.update(CORRIDOR, RESOLUTION_M, np.zeros(2))
    return found


def driven(limit_m: float) -> Revisits:
    """Ten metres along the corridor, on which the variance grows by 1 cm^2 a metre."""
    revisits = Revisits(limit_m)
    for x in range(11):
        revisits.note(np.array((2.0 + x, 1.0)), 0.01 * np.sqrt(x))
    return revisits


def place(revisits: Revisits, goal_x: float, deviation_m: float) -> np.ndarray | None:
    here = known()
    field = cost_field(here, np.array((12.0, 1.0)), 0.3)
    return revisits.place(here, field, np.array((goal_x, 1.0)), abs(goal_x - 12.0), deviation_m, 0.3)


def test_it_goes_on_while_the_prediction_keeps_the_limit() -> None:
    assert place(driven(0.05), 20.0, 0.0316) is None, "10 + 8 of 25 cm^2"


def test_it_goes_back_just_as_far_as_the_limit_asks() -> None:
    # 10 + 8 cm^2 at the goal are too much. From x = 2 + n it would be n + (18 - n) = 18 again: only a place that it has
    # come to know better helps.
    revisits = driven(0.04)
    assert place(revisits, 20.0, 0.0316) is None
    revisits.note(np.array((7.0, 1.0)), 0.01)
    revisits.note(np.array((12.0, 1.0)), 0.0316)
    np.testing.assert_array_equal(place(revisits, 20.0, 0.0316), (7.0, 1.0))


def test_a_robot_that_does_not_know_its_deviation_explores_as_ever() -> None:
    truth = CORRIDOR.copy()
    truth[1:-1, 200:] = -1
    goals = []
    for accurate in (False, True):
        exploration = Exploration(ExplorerConfig(radius_m=0.2), accurate=accurate)
        exploration.known.update(truth, RESOLUTION_M, np.zeros(2))
        goal = exploration.decide(np.array((12.0, 1.0, 0.0)), 0.0)
        assert goal is not None
        goals.append(goal.pose_xyyaw)
    np.testing.assert_array_equal(*goals)


def test_it_goes_back_once_before_each_frontier_and_by_new_paths() -> None:
    truth = CORRIDOR.copy()
    truth[1:-1, 280:] = truth[1:-1, :30] = -1
    exploration = Exploration(ExplorerConfig(radius_m=0.2, accurate_m=0.055), accurate=True)
    exploration.known.update(truth, RESOLUTION_M, np.zeros(2))
    went = []
    for now_s, (x, deviation_m) in enumerate(((4.0, 0.0), (16.0, 0.0), (19.0, 0.054), (12.0, 0.054), (19.0, 0.054))):
        exploration.deviation_m, robot = deviation_m, np.array((x, 1.0, 0.0))
        goal = exploration.decide(robot, 10.0 * now_s)
        assert goal is not None
        went.append(goal.candidate is None)
        if went[-1]:
            assert not exploration.due(robot, 10.0 * now_s + 1.9) and exploration.due(robot, 10.0 * now_s + 2.0)
            anew = exploration.decide(robot + (0.0, 0.5, 0.0), 10.0 * now_s + 2.0)
            assert anew is not None and anew.candidate is None and anew.path[0, 1] > 1.4
        exploration.arrived()
    assert went == [False, False, True, True, False]
