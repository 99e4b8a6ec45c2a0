"""How far a camera went over a floor, where walls beside it have corners, too."""

import numpy as np
import pytest

from ngo_estimator.geometry.floor_way import floor_way
from ngo_estimator.geometry.planar_views import turn_matrices

HEIGHT_M, YAW, WAY = 0.6, 0.1, np.array((0.25, 0.05))


def seen(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays to points ``(n, 3)`` before and after a motion."""
    after = (points - (*WAY, 0.0)) @ turn_matrices(np.array((YAW,)))[0]
    first, second = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (points, after))
    return first, second


@pytest.mark.parametrize("backwards", [False, True])
def test_the_floor_tells_the_way_and_its_sign_beside_as_many_corners_of_walls(backwards: bool) -> None:
    rng = np.random.default_rng(1)
    floor = np.column_stack((rng.uniform(1.0, 3.0, 40), rng.uniform(-1.0, 1.0, 40), np.full(40, -HEIGHT_M)))
    wall = np.column_stack((rng.uniform(1.0, 4.0, 40), np.full(40, 1.2), rng.uniform(-0.5, -0.1, 40)))
    axis = WAY / np.linalg.norm(WAY) * (-1.0 if backwards else 1.0)

    def found(points: np.ndarray) -> float | None:
        return floor_way(*seen(points), np.full(len(points), 1e-3), HEIGHT_M, YAW, axis, 12, 0.4)

    assert found(np.concatenate((floor, wall))) == pytest.approx(WAY @ axis, rel=1e-2)
    assert found(floor[:8]) is None
    assert found(wall * (1.0, 1.0, -1.0)) is None
