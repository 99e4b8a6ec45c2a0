"""Floor plans, drawn and from files."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.convex_shapes import contains, rectangle, union_walls
from ngo_sim.corridors import LAYOUTS, Corridor
from ngo_sim.floor_plans import FloorPlan, FloorPlanConfig, draw_floor_plan
from ngo_sim.lidar import ScannerConfig
from ngo_sim.plan_files import read_floor_plan
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


EXACT = ScannerConfig(rays=4, field_of_view_deg=360.0, noise_m=0.0, noise_per_m=0.0, dropout=0.0)


def write_plan(folder: Path, origin: str = "[-3.0, 5.0, 0.0]", **changes: str) -> Path:
    """Two rooms of 6 m x 4 m inside, joined by a door of 1 m; walls and the ground outside are black."""
    image = np.zeros((50, 150), np.uint8)
    image[5:45, 5:65] = image[5:45, 75:135] = 254
    image[20:30, 65:75] = 254
    Image.fromarray(image).save(folder / "plan.png")
    facts = {"image": "plan.png", "resolution": "0.1", "origin": origin, "negate": "0", "occupied_thresh": "0.65"}
    facts |= {"free_thresh": "0.25"} | changes
    path = folder / "plan.yaml"
    path.write_text("\n".join(f"{key}: {value}" for key, value in facts.items()))
    return path


def test_walls_stand_around_what_is_free_and_the_origin_is_that_of_the_file(tmp_path: Path) -> None:
    plan = read_floor_plan(write_plan(tmp_path), 0)
    low, high = plan.segments_m.reshape(-1, 2).min(axis=0), plan.segments_m.reshape(-1, 2).max(axis=0)
    np.testing.assert_allclose(high - low, (13.0, 4.0))
    np.testing.assert_allclose(plan.in_file(np.array((*low, 0.1))), (-3.0 + 0.5, 5.0 + 0.5, 0.1), atol=1e-9)
    lengths = np.abs(plan.segments_m[:, 2:] - plan.segments_m[:, :2]).sum()
    assert lengths == pytest.approx(2 * (2 * 6.0 + 2 * 4.0) - 2 * 1.0 + 2 * 1.0), (
        "two rooms, less the door, and its sides"
    )


def test_the_origin_may_be_turned(tmp_path: Path) -> None:
    plan = read_floor_plan(write_plan(tmp_path, origin="[1.0, 2.0, 1.5707963267948966]"), 0)
    low = plan.segments_m.reshape(-1, 2).min(axis=0)
    np.testing.assert_allclose(plan.in_file(np.array((*low, 0.0)))[:2], (1.0 - 0.5, 2.0 + 0.5), atol=1e-9)


def test_a_robot_drives_through_both_rooms_and_sees_exact_ranges(tmp_path: Path) -> None:
    path = write_plan(tmp_path)
    config = FloorPlanConfig(plan=str(path), people=0)
    assert RouteMap(read_floor_plan(path, 0), 0.22).area.any()
    world = Building2d(config, EXACT, driver=BuildingDriverConfig(driver="wander", stand=0.0))
    drive = world.record(2, 80.0)
    x = drive.true_poses_xyyaw[:, 0]
    assert x.min() < 7.0 and x.max() > 8.0, "it was in both rooms"
    pose, ranges = drive.true_poses_xyyaw[0], drive.ranges_m[0]
    low = drive.plan.segments_m.reshape(-1, 2).min(axis=0)
    ends = pose[:2] + ranges[:, None] * np.stack(
        (np.cos(pose[2] + EXACT.base_angles_rad()), np.sin(pose[2] + EXACT.base_angles_rad())), axis=-1
    )
    on_grid = np.abs((ends - low) / 0.1 - np.rint((ends - low) / 0.1)).min(axis=1)
    np.testing.assert_allclose(on_grid, 0.0, atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"mode": "scale"}, "expected trinary"),
        ({"resolution": "-1"}, "resolution"),
        ({"image": "plan.yaml"}, "an image"),
    ],
)
def test_what_is_no_map_is_said(tmp_path: Path, changes: dict[str, str], complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        read_floor_plan(write_plan(tmp_path, **changes), 0)
