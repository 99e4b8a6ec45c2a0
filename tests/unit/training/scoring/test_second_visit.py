import math

import numpy as np
import pytest

from ngo_estimator.geometry.planar_motion import all_between, compose
from training.scoring.second_visit import second_visit

WALLS = np.random.default_rng(0).uniform(-60.0, 60.0, (4000, 2))


def ring() -> np.ndarray:
    """Poses along a circle of 40 m radius, and 25 m of it once more."""
    angle = np.arange(0.0, 2.0 * math.pi + 25.0 / 40.0, 0.01)
    return np.stack((40.0 * np.sin(angle), 40.0 - 40.0 * np.cos(angle), angle), axis=-1)


def seen(poses: np.ndarray) -> list[np.ndarray]:
    """What lies within 20 m of each pose, in its frame."""
    points = np.pad(WALLS + (0.0, 40.0), ((0, 0), (0, 1)))
    frames = (all_between(pose[None], points)[:, :2] for pose in poses)
    return [near[np.hypot(*near.T) < 20.0] for near in frames]


@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (3.0, -4.0, 0.0), (-8.0, 0.5, math.radians(7.0))])
def test_a_second_visit_lies_where_it_was_put(motion: tuple[float, float, float]) -> None:
    poses = ring()
    last = slice(len(poses) - 51, None)  # poses are 0.4 m apart
    moved, middle = poses.copy(), np.array((*poses[last, :2].mean(axis=0), 0.0))
    moved[last] = [compose(middle, compose(np.array(motion), pose - middle)) for pose in poses[last]]
    found = second_visit(seen(poses), moved)
    assert found.metres == pytest.approx(math.hypot(*motion[:2]), abs=0.1)
    assert found.degrees == pytest.approx(math.degrees(motion[2]), abs=0.2)
    assert found.share > 0.9
    assert found.share_before > 0.9 if not any(motion) else found.share_before < 0.5
