"""Whole explorations of maps drawn by hand, by a robot that sees without errors."""

import math

import numpy as np
import pytest

from ngo_explorer.exploration import Exploration
from ngo_explorer.known_map import KnownMap
from ngo_explorer.path_follower import ARRIVED, DRIVING, STUCK, PathFollower
from ngo_explorer.pilot import DONE, RETURNING, Pilot
from ngo_explorer.settings import RULES, DriveConfig, ExplorerConfig

from .drawn_maps import RESOLUTION_M, drawn, explore, seen_from

ROOMS = drawn(
    "#############",
    "#....#......#",
    "#....#.####.#",
    "#......#..#.#",
    "#....#.##.#.#",
    "######.#..#.#",
    "#......#..#.#",
    "#############",
    cells=10,
)
"""Two joined rooms; the chamber in the middle is closed all around."""

START = (2.5, 4.5)


def reachable() -> np.ndarray:
    free = ROOMS == 0
    free[10:50, 80:100] = False
    return free


def test_it_ends_when_all_that_can_be_reached_is_known_and_touches_nothing() -> None:
    exploration, known, way = explore(ROOMS, START)
    assert (known[reachable()] == 0).mean() > 0.99
    assert not exploration.unreachable
    cells = np.floor(np.array(way)[:, 1::-1] / RESOLUTION_M).astype(int)
    assert (exploration.known.clearance_m[cells[:, 0], cells[:, 1]] >= 0.2).all()


@pytest.mark.parametrize("rule", RULES[1:])
def test_every_rule_comes_to_an_end(rule: str) -> None:
    small = ROOMS[10:, :70].copy()
    small[:, 69] = small[0] = 100
    _, known, _ = explore(small, (2.5, 3.5), ExplorerConfig(rule=rule, radius_m=0.2))
    assert (known[small == 0] == 0).mean() > 0.95


def test_nothing_outside_of_the_boundary_is_explored() -> None:
    boundary = np.array(((0.0, 0.0), (5.5, 0.0), (5.5, 8.0), (0.0, 8.0)))
    exploration, _, way = explore(ROOMS, START, boundary=boundary)
    assert np.array(way)[:, 0].max() < 6.5
    assert 16.0 < exploration.area_m2 < 5.6 * 8.0


def test_a_room_behind_a_gap_too_narrow_is_named_with_the_reason() -> None:
    narrow = drawn("#########", "#...#...#", "#...#...#", "#.......#", "#...###.#", "#...#...#", "#########", cells=4)
    exploration, _, _ = explore(narrow, (1.0, 1.4), ExplorerConfig(radius_m=0.2, frontier_m=0.2, reach_m=1.0))
    assert exploration.unreachable
    assert all(left.point_xy[0] > 1.6 and left.reason for left in exploration.unreachable)
    assert not exploration.candidates and exploration.unreachable == exploration.left()
    ended, _, _ = explore(narrow, (1.0, 1.4), ExplorerConfig(radius_m=0.2, frontier_m=2.0, reach_m=1.0))
    assert {left.reason for left in ended.left()} == {"it is shorter than frontier_m"}, "named too"


def test_the_far_end_of_a_room_that_it_cannot_enter_is_looked_at_through_its_door() -> None:
    wall, door, free = "#" * 17, "#" * 8 + "." + "#" * 8, "#" + "." * 15 + "#"
    truth = drawn(wall, free, free, door, *[free] * 11, wall, cells=5)
    exploration, known = Exploration(ExplorerConfig(radius_m=0.25)), np.full_like(truth, -1)
    for x in np.arange(3.5, 4.0, 0.1):
        seen_from(truth, known, x, 7.0)
    exploration.known.update(known, RESOLUTION_M, np.zeros(2))
    assert exploration.decide(np.array((1.0, 7.0, 0.0)), 0.0) is not None
    deep = [found for found in exploration.candidates if found.frontier.point_xy[1] < 3.0]
    assert deep and all(found.viewpoint_xy[1] > 6.3 and found.gain_m2 > 1.0 for found in deep)


def looking(config: ExplorerConfig) -> tuple[Exploration, np.ndarray, np.ndarray]:
    exploration, known, robot = Exploration(config), np.full_like(ROOMS, -1), np.array((*START, 0.0))
    seen_from(ROOMS, known, *START)
    exploration.known.update(known, RESOLUTION_M, np.zeros(2))
    return exploration, known, robot


def test_a_goal_that_failed_is_put_aside_and_tried_again_when_the_map_there_changes() -> None:
    exploration, known, robot = looking(ExplorerConfig(radius_m=0.2))
    goal = exploration.decide(robot, 0.0)
    assert goal is not None and goal.candidate is not None
    place = goal.candidate.frontier.point_xy
    exploration.failed("the way was blocked")
    exploration.decide(robot, 1.0)
    assert exploration.another_chance() and not exploration.another_chance(), "what failed once is tried before the end"
    exploration.goal = goal
    exploration.failed("the way was blocked")
    exploration.decide(robot, 1.5)
    assert not exploration.another_chance()
    assert "the way was blocked" in [left.reason for left in exploration.unreachable]
    row, column = (place[::-1] / RESOLUTION_M).astype(int)
    known[row - 8 : row + 8, column - 8 : column + 8] = np.where(
        known[row - 8 : row + 8, column - 8 : column + 8] == -1, 0, known[row - 8 : row + 8, column - 8 : column + 8]
    )
    known[row, column + 3] = -1
    exploration.known.update(known, RESOLUTION_M, np.zeros(2))
    exploration.decide(robot, 2.0)
    assert "the way was blocked" not in [left.reason for left in exploration.unreachable]


def test_explore_lite_never_tries_again() -> None:
    exploration, known, robot = looking(ExplorerConfig(rule="explore_lite", radius_m=0.2))
    assert exploration.decide(robot, 0.0) is not None
    exploration.failed("blacklisted")
    known[known == -1] = ROOMS[known == -1]
    known[:3] = -1
    exploration.decide(robot, 1.0)
    assert "blacklisted" in [left.reason for left in exploration.unreachable]


def test_a_goal_without_progress_is_put_aside() -> None:
    exploration, _, robot = looking(ExplorerConfig(radius_m=0.2, progress_s=5.0, replan_s=100.0))
    exploration.decide(robot, 0.0)
    assert not exploration.due(robot, 0.1) and not exploration.due(robot, 4.0)
    assert exploration.due(robot, 5.1)
    exploration.decide(robot, 5.1)
    assert any("no progress" in left.reason for left in exploration.unreachable)


def test_a_robot_that_is_carried_away_decides_anew() -> None:
    exploration, _, robot = looking(ExplorerConfig(radius_m=0.2, replan_s=100.0))
    exploration.decide(robot, 0.0)
    assert not exploration.due(robot, 0.1)
    assert exploration.due(robot + (0.0, 2.0, 0.0), 0.2)


RING = drawn("#########", "#.......#", "#.#####.#", "#.......#", "#########", cells=10)
HOME = np.array((7.5, 1.5, 0.0))


class Nobody:
    """A driver that does nothing: the goals are for somebody who does not come."""

    state = DRIVING

    def follow(self, path: np.ndarray, yaw: float, new: bool) -> None:
        self.state = DRIVING if len(path) > 2 else ARRIVED

    def stop(self) -> None:
        self.state = ARRIVED


@pytest.mark.parametrize(("closed", "drives"), [(1, True), (2, True), (0, False)])
def test_the_way_home_is_planned_anew_and_a_robot_that_does_not_get_there_says_so(closed: int, drives: bool) -> None:
    exploration, robot, truth = Exploration(ExplorerConfig(radius_m=0.2)), np.array((1.5, 1.5, 0.0)), RING.copy()
    driver = PathFollower(DriveConfig(), exploration.config) if drives else Nobody()
    pilot, begun_s = Pilot(exploration, driver, 0.5, HOME), math.inf
    for step in range(1500):
        exploration.known.update(truth, RESOLUTION_M, np.zeros(2))
        pilot.step(robot, 0.1 * step)
        if pilot.state == DONE:
            break
        begun_s = min(begun_s, 0.1 * step) if pilot.state == RETURNING else begun_s
        if robot[0] > 3.0:
            truth[10:20, 50] = 100 if closed else 0  # on the way, and on the way around
            truth[30:40, 50] = 100 if closed == 2 else 0
        if isinstance(driver, PathFollower):
            speed, turn_rate = driver.step(exploration.known, robot, 0.1 * step)
            robot = robot + 0.1 * np.array((speed * math.cos(robot[2]), speed * math.sin(robot[2]), turn_rate))
    assert pilot.state == DONE
    home = float(np.hypot(*(robot - HOME)[:2])) < 0.3
    assert home == (closed == 1 and drives)
    assert [left.reason for left in exploration.left()] == ([] if home else ["the robot did not get back to the start"])
    assert home or 0.1 * step - begun_s < 30.0


@pytest.mark.parametrize("opens_s", [100.0, math.inf])
def test_a_robot_behind_which_a_door_shuts_waits_for_it_but_not_for_ever(opens_s: float) -> None:
    wall, ends, corridor = "#" * 24, f"#.{'#' * 20}.#", f"#{'.' * 22}#"
    rooms = drawn(wall, f"#...{'#' * 18}.#", ends, corridor, wall, cells=10)
    times_s = []

    def door(truth: np.ndarray, now_s: float, robot: np.ndarray) -> None:
        times_s.append(now_s)
        if robot[0] > 21.3 or now_s > opens_s:
            truth[10:20, 190] = 0 if now_s > opens_s else 100

    config = ExplorerConfig(rule="nearest", radius_m=0.2, wait_s=150.0)
    exploration, known, way = explore(rooms, (18.0, 1.5), config, change=door)
    if opens_s < math.inf:
        assert way[-1][0] < 3.0 and not exploration.unreachable and (known[rooms == 0] == 0).mean() > 0.95
    else:
        assert {left.reason for left in exploration.unreachable} == {"the way there has shut"}
        assert 150.0 < times_s[-1] < 300.0 and 19.2 < way[-1][0] < 20.5, "it waits before the door"


CORRIDORS = drawn("#" * 24, f"?{'.' * 22}#", "#" * 24, f"#{'.' * 22}#", "#" * 24, cells=10)
"""Two that nothing joins. The upper one goes on where nothing is known."""


def at(x: float, y: float = 3.5) -> np.ndarray:
    return np.array((x, y, 0.0))


def driven(boundary: np.ndarray | None = None) -> Exploration:
    exploration = Exploration(ExplorerConfig(radius_m=0.2, wait_s=120.0), boundary)
    exploration.known.update(CORRIDORS, RESOLUTION_M, np.zeros(2))
    for x in np.arange(2.5, 20.0, 0.1):
        exploration.due(at(x), 0.0)
    return exploration


def shut(exploration: Exploration, door: bool) -> None:
    values = CORRIDORS.copy()
    values[30:40, 150] = 100 if door else 0
    exploration.known.update(values, RESOLUTION_M, np.zeros(2))


def test_a_door_that_flaps_is_not_waited_for_for_ever_and_a_pause_is_no_wait() -> None:
    exploration = driven()
    pilot, left_s, now_s = Pilot(exploration, Nobody(), 0.5, None), [], 0.0
    while pilot.state != DONE and now_s < 3000.0:
        shut(exploration, now_s % 50.0 >= 10.0)
        pilot.step(at(20.0), now_s)
        left_s.append(pilot.wait_left_s)
        now_s += 0.5
        if len(left_s) == 100:
            pilot.halted()
            now_s += 500.0
    waited = [left for left in left_s if left is not None]
    assert waited[0] == 120.0 and np.diff(waited).min() > -1.0 and 120.0 < 0.5 * len(left_s) < 600.0
    assert pilot.state == DONE and "the way there has shut" in [left.reason for left in exploration.left()]


@pytest.mark.parametrize("opens_s", [60.0, math.inf])
def test_a_door_that_shuts_on_the_way_home_is_waited_for(opens_s: float) -> None:
    exploration = driven(np.array(((2.0, 0.0), (22.0, 0.0), (22.0, 5.0), (2.0, 5.0))))
    pilot, states = Pilot(exploration, Nobody(), 0.5, at(2.5)), []
    for step in range(1000):
        shut(exploration, RETURNING in states and 0.5 * step < opens_s)
        pilot.step(at(20.0), 0.5 * step)
        states.append(pilot.state)
        if pilot.state == DONE or (0.5 * step > opens_s and pilot.state == RETURNING):
            break
    assert 60.0 < 0.5 * step < 260.0
    if opens_s < math.inf:
        assert pilot.state == RETURNING and exploration.goal is not None and exploration.goal.path[-1][0] < 3.0
    else:
        assert [left.reason for left in exploration.left()] == ["no path leads back to the start"]


def test_a_way_that_lies_behind_a_wall_since_the_map_has_jumped_is_no_door() -> None:
    exploration = driven()
    pilot = Pilot(exploration, Nobody(), 0.5, at(2.5))
    for step in range(100):
        pilot.step(at(20.0, 1.5), 0.5 * step)
        assert pilot.wait_left_s is None
    assert pilot.state == DONE


def test_the_same_map_and_seed_give_the_same_goals() -> None:
    small = ROOMS[10:, :70].copy()
    small[:, 69] = small[0] = 100
    ways = [np.array(explore(small, (2.5, 3.5))[2]) for _ in range(2)]
    np.testing.assert_array_equal(*ways)


def test_a_robot_that_does_not_move_backs_up_and_is_stuck_at_last() -> None:
    exploration, _, robot = looking(ExplorerConfig(radius_m=0.2))
    goal = exploration.decide(robot, 0.0)
    assert goal is not None
    follower = PathFollower(DriveConfig(stuck_s=1.0), exploration.config)
    follower.follow(goal.path, 0.0)
    robot[2] = math.atan2(*(goal.path[5] - goal.path[0])[::-1])
    speeds = []
    for step in range(400):
        speeds.append(follower.step(exploration.known, robot, 0.1 * step)[0])
        if follower.state == STUCK:
            break
    assert follower.state == STUCK and min(speeds) < 0.0 < max(speeds)
    follower.stop()
    assert follower.state == ARRIVED and follower.step(exploration.known, robot, 99.0)[0] == 0.0


def test_poses_that_come_late_change_nothing_where_the_robot_moves_as_it_is_told() -> None:
    exploration, _, start = looking(ExplorerConfig(radius_m=0.2))
    goal = exploration.decide(start, 0.0)
    assert goal is not None
    ways = []
    for late in (0, 3):
        follower, way = PathFollower(DriveConfig(), exploration.config), [start] * (late + 1)
        follower.follow(goal.path, 0.0)
        for step in range(60):
            speed, turn_rate = follower.step(exploration.known, way[-1 - late], 0.1 * step, 0.1 * late)
            arc = np.array((speed * np.sinc(0.05 * turn_rate / math.pi), 0.0, turn_rate))
            heading = way[-1][2] + 0.05 * turn_rate
            way.append(way[-1] + 0.1 * arc[[0, 0, 2]] * (math.cos(heading), math.sin(heading), 1.0))
        ways.append(np.array(way[late:]))
    assert np.hypot(*(ways[0][-1] - start)[:2]) > 1.0
    np.testing.assert_allclose(*ways, atol=1e-9)


def test_a_pane_that_the_map_does_not_show_is_not_touched_and_the_end_is_reached() -> None:
    glass = ROOMS.copy()
    glass[40:50, 62] = 100  # a pane across the passage to the right, that rays of the map pass through
    exploration, known, way = explore(ROOMS, START, glass=glass)
    cells = np.argwhere((glass == 100) & (ROOMS == 0))
    gaps = np.hypot(*((cells[:, ::-1] + 0.5) * RESOLUTION_M - np.array(way)[:, None, :2]).transpose(2, 0, 1)).min(
        axis=1
    )
    assert gaps.min() > 0.2
    assert np.array(way)[:, 0].max() < 6.2 and (known[40:50, 60:70] == 0).all()
    assert exploration.left(), "what lies behind it is named"


@pytest.mark.parametrize(("away_m", "drives"), [(0.1, True), (0.25, False), (0.9, True)])
def test_what_the_scan_shows_stops_it_unless_it_is_far_or_the_robot_itself(away_m: float, drives: bool) -> None:
    exploration, _, robot = looking(ExplorerConfig(radius_m=0.2))
    goal = exploration.decide(robot, 0.0)
    assert goal is not None
    robot[2] = math.atan2(*(goal.path[5] - goal.path[0])[::-1])
    follower = PathFollower(DriveConfig(), exploration.config)
    follower.follow(goal.path, 0.0)
    for step in range(30):
        if step < 5:
            follower.look(np.array(((away_m, -0.02), (away_m, 0.02))), 0.1 * step)
        speed, _ = follower.step(exploration.known, robot, 0.1 * step)
        if drives and speed > 0.1:
            break
    assert (speed > 0.1) == drives, "a scanner that falls silent leaves what it saw"


@pytest.mark.parametrize("speed_mps", [0.9, 2.5])
def test_what_only_the_scan_shows_is_far_enough_to_stop_at_any_speed(speed_mps: float) -> None:
    known, x, speed = KnownMap(0.2, 0.6), 2.0, 0.0
    known.update(np.pad(np.zeros((18, 298), np.int8), 1, constant_values=100), RESOLUTION_M, np.zeros(2))
    config = DriveConfig(speed_mps=speed_mps, acceleration_mps2=0.5)
    follower = PathFollower(config, ExplorerConfig(radius_m=0.2))
    follower.follow(np.column_stack((np.arange(2.0, 28.0, 0.1), np.full(260, 1.0))), 0.0)
    fastest = farthest = 0.0
    for step in range(600):
        follower.look(np.column_stack((np.full(11, 20.0 - x), np.linspace(-0.5, 0.5, 11))), 0.05 * step)
        wanted, _ = follower.step(known, np.array((x, 1.0, 0.0)), 0.05 * step)
        fastest, speed = max(fastest, wanted), max(wanted, speed - 0.025)  # the base brakes as it can
        x += 0.05 * speed
        farthest = max(farthest, x)
    assert fastest == pytest.approx(speed_mps) and 19.0 < farthest < 19.8


def test_a_robot_that_was_halted_begins_slowly() -> None:
    known = KnownMap(0.2, 0.6)
    known.update(np.pad(np.zeros((18, 98), np.int8), 1, constant_values=100), RESOLUTION_M, np.zeros(2))
    follower, path = (
        PathFollower(DriveConfig(), ExplorerConfig(radius_m=0.2)),
        np.array(((2.0, 1.0), (2.7, 1.0), (9.0, 1.0))),
    )
    speeds = []
    for step in range(40):
        if step % 20 == 0:
            follower.stop()
            follower.follow(path, 0.0)
        speeds.append(follower.step(known, np.array((2.0, 1.0, 0.0)), 0.1 * step + (step >= 20) * 60.0)[0])
    assert speeds[19] > 0.4 and speeds[20] <= 0.05 and speeds[21] <= 0.1
