"""What is drawn and scored after a training: the online estimate, and cells of maps."""

import math

import numpy as np
import pytest

from ngo_estimator.mapping.occupancy_grid import OccupancyMap
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_sim.mazes import Maze
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head, trajectory_inputs
from training.scoring.map_errors import intersections, true_map
from training.scoring.online_estimate import online_poses

NAMES = ("relative", "log_std", "motion", "codes")


def test_an_online_pose_is_the_last_one_of_what_came_before_it() -> None:
    optimizer, pair_head = small_optimizer(trained=True), small_pair_head()
    inputs = [values[0] for values in trajectory_inputs(1, 60, seed=3)]
    core = OnlineTrajectory(optimizer, pair_head, 64)
    features = {name: values.numpy() for name, values in zip(NAMES, inputs, strict=True)}
    features["origin_code"] = np.zeros((1, 12))
    online = online_poses(core, features)
    assert online.shape == (61, 3) and online[0].tolist() == [0.0, 0.0, 0.0]
    for steps in (16, 32, 45, 60):
        offline = optimize_offline(optimizer, pair_head, *(values[:steps] for values in inputs)).poses[0]
        np.testing.assert_allclose(online[steps, :2], offline[-1, :2], atol=2e-4)
    whole = optimize_offline(optimizer, pair_head, *inputs).poses[0].numpy()
    assert np.abs(online[1:, :2] - whole[:, :2]).max() > 0.05
    # What comes later changes nothing.
    shorter = online_poses(core, {name: values[:30] for name, values in features.items()})
    np.testing.assert_allclose(shorter, online[:31], atol=1e-9)


ROOM = Maze(np.array([[1, 1, 1, 1, 1], [1, 0, 0, 0, 1], [1, 1, 1, 0, 1], [1, 0, 0, 0, 1], [1, 1, 1, 1, 1]], bool))
ALL_ROUND = np.linspace(-math.pi, math.pi, 2000, endpoint=False)


def a_map(rows: list[list[int]], origin: tuple[float, float] = (-0.5, -0.5)) -> OccupancyMap:
    return OccupancyMap(np.array(rows, np.int8), 1.0, np.array(origin))


def test_cells_count_where_they_are() -> None:
    """The same cells one column to the right: of four free cells two are common, of two occupied ones none."""
    true, found = a_map([[0, 0, 0, 100]]), a_map([[0, 0, 0, 100]], origin=(0.5, -0.5))
    free, occupied = intersections(found, true)
    assert (free, occupied) == (2 / 4, 0.0)


def test_the_true_map_is_what_can_be_seen_in_the_frame_of_the_first_pose() -> None:
    """From the middle of the upper corridor, turned by 90 degrees, the lower one behind the wall is not seen."""
    first = np.array([1.5, 1.5, math.pi / 2.0])
    true = true_map(ROOM, first[None], ALL_ROUND, 0.1)
    rows, columns = np.nonzero(true.values == 0)
    ahead = true.origin_xy[0] + 0.1 * (columns + 0.5)
    left = true.origin_xy[1] + 0.1 * (rows + 0.5)
    assert np.abs(ahead).max() < 1.6, "the corridor is 1 m wide, and opens at its other end"
    assert left.min() == pytest.approx(-2.4) and left.max() == pytest.approx(0.4)
    rows, columns = np.nonzero(true.values == 100)
    walls = true.origin_xy + 0.1 * (np.column_stack((columns, rows)) + 0.5)
    beside = walls[np.abs(walls[:, 1]) < 0.3]
    assert np.abs(np.abs(beside[:, 0]) - 0.5).max() < 0.06
