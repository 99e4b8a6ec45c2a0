"""Floor plans are connected, the same for the same seed, and made of known walls where the polygons are known."""

import dataclasses
import itertools

import numpy as np
import pytest

from ngo_sim.convex_shapes import contains, rectangle, union_walls
from ngo_sim.corridors import LAYOUTS, Corridor
from ngo_sim.floor_plans import FloorPlan, FloorPlanConfig, draw_floor_plan
from ngo_sim.routes import RouteMap

SMALL = 0.6


def length_m(segments: np.ndarray) -> float:
    return float(np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1]).sum())


def test_the_walls_of_two_crossing_corridors_leave_the_crossing_open() -> None:
    first, second = rectangle((0, 0), 0.0, 10.0, 2.0), rectangle((0, 0), np.pi / 2, 10.0, 2.0)
    walls, glass = union_walls([first, second], [(), ()])
    # Each outline of 24 m loses 2 m on both of its long sides.
    assert length_m(walls) == pytest.approx(2 * (24.0 - 4.0), abs=1e-5)
    middles = (walls[:, :2] + walls[:, 2:]) / 2
    assert not contains(first, middles, 1e-3).any() and not contains(second, middles, 1e-3).any()
    assert not glass.any()


def test_a_polygon_inside_another_has_no_walls_and_glass_stays_with_its_edge() -> None:
    outer, inner = rectangle((0, 0), 0.3, 10.0, 6.0), rectangle((0, 0), 0.7, 1.0, 1.0)
    walls, glass = union_walls([outer, inner], [(2,), (0,)])
    np.testing.assert_allclose(walls, np.concatenate((outer, np.roll(outer, -1, axis=0)), axis=1), atol=1e-12)
    assert glass.tolist() == [False, False, True, False]


def test_a_bent_corridor_keeps_its_width_at_the_bend() -> None:
    quads = Corridor(np.array(((0.0, 0.0), (10.0, 0.0), (10.0, 8.0))), 2.0).quads()
    walls, _ = union_walls(quads, [()] * len(quads))
    # Outer sides 11 + 9, inner sides 9 + 7, two ends of 2; the seams of 1 mm add less than 1 cm.
    assert length_m(walls) == pytest.approx(20.0 + 16.0 + 4.0, abs=0.02)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_every_goal_can_be_reached_from_every_other(layout: str, seed: int) -> None:
    plan = draw_floor_plan(seed, FloorPlanConfig(layout=layout, scale=SMALL))
    routes = RouteMap(plan, 0.25)
    assert len(plan.goals_m) > 5
    assert len(routes.goals_m) == len(plan.goals_m)
    path = routes.path(plan.goals_m[0], plan.goals_m[-1])
    np.testing.assert_allclose(path[[0, -1]], plan.goals_m[[0, -1]], atol=0.15)
    assert np.hypot(*np.diff(path, axis=0).T).max() < 0.1


def test_the_same_seed_gives_the_same_building_and_another_seed_another() -> None:
    first, again, other = (draw_floor_plan(seed, FloorPlanConfig(scale=SMALL)) for seed in (3, 3, 4))
    for field in dataclasses.fields(FloorPlan):
        if isinstance(value := getattr(first, field.name), np.ndarray):
            np.testing.assert_array_equal(value, getattr(again, field.name))
    assert first.segments_m.shape != other.segments_m.shape


def test_a_building_has_walls_at_more_than_right_angles_doors_and_furniture() -> None:
    plan = draw_floor_plan(1, FloorPlanConfig(layout="ring", scale=SMALL, glass=0.3))
    delta = plan.segments_m[:, 2:] - plan.segments_m[:, :2]
    long = np.hypot(*delta.T) > 1.5
    angles = np.degrees(np.arctan2(delta[long, 1], delta[long, 0])) % 90.0
    counts, _ = np.histogram(angles, bins=30, range=(0.0, 90.0))
    assert (counts > 0).sum() >= 4, "directions of walls, a right angle counting as none"
    assert plan.glass.any() and len(plan.circles_m) > 50
    assert 0 < plan.doors.passable.sum() < len(plan.doors.passable)
    assert np.isfinite(plan.segments_m).all() and plan.segments_m.min() > 0.0


def test_doors_open_and_close_between_visits_and_passable_ones_stay_open() -> None:
    doors = draw_floor_plan(1, FloorPlanConfig(layout="wings", scale=SMALL)).doors
    leaves = doors.leaves(np.array((0.0, 0.5, 2000.0)))
    assert leaves.shape == (3, len(doors.turn), 4)
    assert np.abs(leaves[0] - leaves[1]).max(axis=1).mean() < 0.1, "hardly any moves within half a second"
    assert (np.abs(leaves[0] - leaves[2]).max(axis=1) > 0.05).any()
    np.testing.assert_allclose(np.hypot(*np.moveaxis(leaves[..., 2:] - leaves[..., :2], -1, 0))[0], doors.widths_m)
    assert np.degrees(doors.angles_rad[doors.passable]).min() > 85
    assert (doors.angles_rad[~doors.passable] == 0.0).any()


def test_one_piece_of_furniture_in_twenty_is_moved_each_time_and_walls_stay() -> None:
    plans = [draw_floor_plan(3, FloorPlanConfig(scale=SMALL, furniture_moves=moves)) for moves in (0, 1, 2)]
    for before, after in itertools.pairwise(plans):
        moved = (before.circles_m != after.circles_m).any(axis=1)
        assert 0.0 < moved.mean() < 0.15
        np.testing.assert_array_equal(before.circles_m[:, 2], after.circles_m[:, 2])
        assert 0.0 < (before.segments_m != after.segments_m).any(axis=1).mean() < 0.1
        assert len(RouteMap(after, 0.25).goals_m) == len(after.goals_m), "every goal can still be reached"


def test_aliased_rooms_repeat_and_others_do_not() -> None:
    def repeated(aliased: bool) -> int:
        """The most circles of furniture that share one radius to the last digit."""
        plan = draw_floor_plan(5, FloorPlanConfig(layout="ladder", scale=SMALL, aliased=aliased))
        radii = plan.circles_m[:, 2]
        _, counts = np.unique(radii[(radii != 0.03) & (radii > 0.0)], return_counts=True)
        return int(counts.max(initial=0))

    assert repeated(True) > 3 * repeated(False)
