from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ngo_sim.building2d import Building2d
from ngo_sim.building_drivers import BuildingDriverConfig
from ngo_sim.floor_plans import FloorPlanConfig
from ngo_sim.lidar import ScannerConfig
from ngo_sim.plan_files import read_floor_plan
from ngo_sim.routes import RouteMap

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
