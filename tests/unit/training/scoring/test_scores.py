"""The metrics of the tables: those of single trajectories, computed for many at once."""

import dataclasses

import numpy as np
import pytest

from training.data.worlds import WORLDS, world_named
from training.scoring.metrics import path_length_m, trajectory_error
from training.scoring.scores import METRICS, scores


def walks(rng: np.random.Generator) -> np.ndarray:
    return np.cumsum(rng.normal(0.0, 0.1, (4, 30, 3)), axis=1)


def with_origin(poses: np.ndarray) -> np.ndarray:
    return np.concatenate((np.zeros((1, 3)), poses))


def test_many_trajectories_score_as_single_ones() -> None:
    rng = np.random.default_rng(0)
    truth = walks(rng)
    estimate = truth + walks(rng)
    world = dataclasses.replace(world_named("maze2d"), block_m=0.5)
    found = scores(estimate, truth, world)
    for k in range(len(truth)):
        single = trajectory_error(with_origin(estimate[k]), with_origin(truth[k]))
        length = path_length_m(with_origin(truth[k]))
        assert found["position_rmse"][k] == pytest.approx(single.position_rmse_m / 0.5)
        assert found["position_percent"][k] == pytest.approx(100.0 * single.position_rmse_m / length)
        assert found["final_percent"][k] == pytest.approx(single.final_percent)
        assert found["heading_rmse_deg"][k] == pytest.approx(single.heading_rmse_deg)


def test_the_metrics_of_the_3d_world() -> None:
    truth = np.zeros((1, 2, 3))
    truth[0, :, 0] = [2.0, 8.0]
    estimate = truth.copy()
    estimate[0, :, 1] = [0.3, 0.4]
    estimate[0, :, 2] = [0.0, -np.radians(8.0)]
    found = scores(estimate, truth, world_named("maze3d"))
    assert found["translation_percent"] == pytest.approx([5.0])
    assert found["rotation_deg_per_m"] == pytest.approx([1.0])
    assert found["position_rmse_m"] == pytest.approx([np.sqrt(0.25 / 3.0)])


def test_segment_errors_of_the_3d_world() -> None:
    """A scale of 1.1 and a turn of 0.1 deg a metre along a straight line, over segments of the lengths that fit."""
    along = np.arange(0.5, 12.5, 0.5)
    truth = np.stack((along, np.zeros_like(along), np.zeros_like(along)), axis=-1)[None]
    estimate = truth * 1.1
    estimate[..., 2] = np.radians(0.1) * along
    found = scores(estimate, truth, world_named("maze3d"))
    # The first frame beyond a length is half a metre farther on; segments start at 0 and 5 m (of 5 m), 0 m (of 10 m).
    ends = {5.0: 5.5, 10.0: 10.5}
    turns = [0.1 * ends[5.0] / 5.0] * 2 + [0.1 * ends[10.0] / 10.0]
    assert found["segment_rotation_deg_per_m"] == pytest.approx([np.mean(turns)])
    moved = [
        _shifted(1.1 * ends[m], np.radians(0.1 * start), ends[m]) / m for start, m in ((0, 5.0), (5, 5.0), (0, 10.0))
    ]
    assert found["segment_translation_percent"] == pytest.approx([100.0 * np.mean(moved)])


def _shifted(length: float, turn: float, true_length: float) -> float:
    """How far a motion ahead is off that is seen from a pose that is turned."""
    return float(np.hypot(length * np.cos(turn) - true_length, length * np.sin(turn)))


def test_whole_turns_are_no_error() -> None:
    truth = walks(np.random.default_rng(1))
    estimate = truth + np.array([0.0, 0.0, 2.0 * np.pi])
    assert scores(estimate, truth, world_named("maze2d"))["heading_rmse_deg"] == pytest.approx(np.zeros(4), abs=1e-9)


def test_every_world_has_metrics() -> None:
    assert set(METRICS) == set(WORLDS)
