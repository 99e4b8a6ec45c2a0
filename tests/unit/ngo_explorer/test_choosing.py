"""Frontiers and paths of maps drawn by hand."""

import numpy as np
import pytest

from ngo_explorer.frontiers import Candidate, Frontier, FrontierFinder, gains_m2
from ngo_explorer.known_map import KnownMap
from ngo_explorer.planner import cost_field, line_is_free, plan_path
from ngo_explorer.rules import Situation, make_rule
from ngo_explorer.settings import ExplorerConfig

from .drawn_maps import drawn

NEED_M = 0.3
ROOM = (
    "??????????????",
    "?######?#####?",
    "?#....#?#...#?",
    "?#....#?#...#?",
    "?#..........#?",
    "?#....#?#...#?",
    "?###.##?#####?",
    "????.?????????",
)


def known_of(values: np.ndarray) -> KnownMap:
    known = KnownMap(0.2, 0.6)
    known.update(values, 0.1, np.zeros(2))
    return known


def test_the_frontiers_of_a_room_are_its_open_door_and_its_open_passage() -> None:
    known = known_of(drawn(*ROOM, cells=10))
    found = FrontierFinder(0.3, 10.0).find(known)
    # Below the room the corridor ends in the unknown, below and at both sides; the passage has no wall at two sides.
    assert len(found) == 3
    corridor = min(found, key=lambda frontier: frontier.point_xy[1])
    assert corridor.size_m == pytest.approx(2 * 1.0 + 1.0 - 0.2, abs=0.25)
    assert sorted(frontier.size_m for frontier in found)[:2] == pytest.approx([1.0, 1.0], abs=0.11)


def test_a_long_frontier_is_cut_into_connected_pieces() -> None:
    values = np.full((60, 60), -1, np.int8)
    values[10:20, 5:55] = 0
    pieces = FrontierFinder(0.3, 1.0).find(known_of(values))
    assert max(piece.size_m for piece in pieces) <= 1.0 + 1e-9
    assert sum(piece.size_m for piece in pieces) == pytest.approx(0.1 * (2 * 50 + 2 * 10 - 4), abs=0.6)


def test_a_frontier_across_the_grid_is_as_long_as_it_is() -> None:
    """A diagonal of 19 cells is 1.4 times as long as 19 cells in a row."""
    values = np.full((40, 40), -1, np.int8)
    for k in range(20):
        values[10 + k, : 11 + k] = 0
    values[:11, :] = values[30:, :] = values[:, 0] = 100
    known = known_of(values)
    (diagonal,) = FrontierFinder(0.0, 10.0).find(known)
    (counted,) = FrontierFinder(0.0, 10.0, by_cells=True).find(known)
    assert counted.size_m == pytest.approx(1.9) and diagonal.size_m == pytest.approx(2.0**0.5 * 1.8 + 0.1)


def test_gain_is_the_unknown_area_that_rays_reach() -> None:
    values = np.zeros((101, 101), np.int8)
    values[:, 51:] = -1
    half_circle = gains_m2(known_of(values), np.array(((5.05, 5.05),)), np.array((4.0,)))[0]
    assert half_circle == pytest.approx(0.5 * np.pi * 4.0**2, rel=0.05)
    values[:, 51] = 100
    assert gains_m2(known_of(values), np.array(((4.05, 5.05),)), np.array((3.0,)))[0] == 0.0, "a wall hides it"


def test_a_path_leads_through_the_door_and_keeps_its_clearance() -> None:
    known = known_of(drawn(*ROOM, cells=10))
    start, goal = np.array((2.5, 4.5)), np.array((11.5, 4.5))
    field = cost_field(known, start, NEED_M)
    path = plan_path(known, field, start, goal, NEED_M)
    assert path is not None
    np.testing.assert_allclose(path[[0, -1]], (start, goal), atol=0.06)
    cells = np.array([known.cell(point) for point in path])
    assert (known.clearance_m[cells[:, 0], cells[:, 1]] >= NEED_M).all()
    length = np.hypot(*np.diff(path, axis=0).T).sum()
    straight = 9.0
    assert straight <= length < 1.15 * straight + 1.5, "the door is nearly on the line"


def test_no_path_leads_through_a_gap_that_is_too_narrow() -> None:
    narrow = drawn("#########", "#...#...#", "#.......#", "#...#...#", "#########", cells=5)
    start, goal = np.array((1.0, 1.25)), np.array((3.5, 1.25))
    wide = known_of(narrow)
    assert plan_path(wide, cost_field(wide, start, 0.2), start, goal, 0.2) is not None
    assert plan_path(wide, cost_field(wide, start, 0.35), start, goal, 0.35) is None
    assert not line_is_free(wide, start, goal, 0.35)


def test_a_robot_in_a_gap_that_is_a_cell_too_narrow_may_leave_on_both_sides() -> None:
    halves = np.zeros((41, 25), np.int8)
    halves[[0, -1]] = halves[:, [0, -1]] = halves[21] = 100
    halves[21, 10:15] = 0
    known, need_m = KnownMap(0.1, 0.6), 0.32
    known.update(halves, 0.1, np.zeros(2))
    above, gap = np.array((1.25, 3.05)), np.array((1.25, 2.25))
    for start, ways in ((above, 1), (gap, 2)):
        field = cost_field(known, start, need_m)
        goals = (np.array((1.25, 3.55)), np.array((1.25, 0.75)))
        assert [plan_path(known, field, start, goal, need_m) is not None for goal in goals].count(True) == ways


def test_a_path_goes_round_a_gap_that_is_a_little_too_narrow() -> None:
    walls = np.zeros((81, 121), np.int8)
    walls[[0, -1]] = walls[:, [0, -1]] = walls[40] = 100
    walls[40, 20:31] = walls[40, 90:110] = 0  # of 0.55 m, with cells wide enough close by on both sides; and of 1 m
    known, need_m, start, goal = KnownMap(0.22, 0.6), 0.305, np.array((1.275, 1.0)), np.array((1.275, 3.0))
    known.update(walls, 0.05, np.zeros(2))
    field = cost_field(known, start, need_m)
    path = plan_path(known, field, start, goal, need_m)
    assert path is not None and path[:, 0].max() > 4.5
    row, column = (value // known.block for value in known.cell(goal))
    assert field[row, column] * known.block * known.resolution_m / 10.0 > 6.0, "as far as the way round"


def test_a_robot_that_seems_to_stand_in_a_wall_is_on_one_side_of_it() -> None:
    known = known_of(drawn("#" * 22, *[f"#{'.' * 9}##{'.' * 9}#"] * 20, "#" * 22))
    field = cost_field(known, np.array((1.1, 1.1)), NEED_M)
    assert sorted(((field[:, :5] >= 0).any(), (field[:, 6:] >= 0).any())) == [False, True]


def test_by_gain_over_distance_a_near_nook_comes_before_a_large_room_only_if_it_shows_more_a_metre() -> None:
    def chosen(nook_m2: float) -> int:
        at = np.zeros((1, 2))
        edges = [Candidate(Frontier(at, at[0], 1.0), at[0], *way_gain) for way_gain in ((1.0, nook_m2), (6.0, 20.0))]
        return make_rule(ExplorerConfig(), np.random.default_rng(0))(Situation(at[0], edges, -1, at))

    assert (chosen(3.0), chosen(4.0)) == (1, 0)
