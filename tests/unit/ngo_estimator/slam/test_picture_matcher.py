"""A camera's pose in a saved map: claimed where key pictures agree on it, and not where two places look alike."""

from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.data.state_arrays import StateError
from ngo_estimator.geometry import se2
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.picture_trajectory import PictureTrajectory
from ngo_estimator.slam.saved_state import read_state, write_state
from tests.unit.ngo_estimator.loops.test_place_loop_finder import seen

ORIGIN = MapOrigin(np.zeros(3))
COVARIANCE, NOTHING = np.diag((1e-4, 1e-4, 1e-5)), np.zeros(0, np.float32)
ALONG = np.arange(20) * 0.7
WAY = np.stack((ALONG, np.zeros(20), 0.05 * np.sin(ALONG)), axis=1)


def corridor(seed: int, roughness: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Points ``(n, 3)`` on the walls of a corridor, and what they look like: rough ones are alike, and not the same."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((0.0, 1.5, 0.0), (24.0, 2.5, 3.0), (700, 3))
    points[::2, 1] *= -1.0
    looks = rng.standard_normal((len(points), 32)) + roughness * rng.standard_normal((len(points), 32))
    return points, (looks / np.linalg.norm(looks, axis=1, keepdims=True)).astype(np.float32)


PLACE, COPY, ELSEWHERE = corridor(0), corridor(0, 0.3), corridor(1)


def steps(drives: list[np.ndarray], *shown: tuple[np.ndarray, np.ndarray]) -> Iterator[RelativeStep]:
    """Steps of a robot that drives in several corridors, 100 m from each other."""
    codes = [seen(pose, *of, 0.0).packed() for drive, of in zip(drives, shown, strict=True) for pose in drive]
    poses = np.concatenate([drive + (0.0, 100.0 * k, 0.0) for k, drive in enumerate(drives)])
    for k, relative in enumerate(se2.between(poses[:-1], poses[1:])):
        odometry = se2.between(poses[0], poses[k + 1])
        yield RelativeStep(
            k + 1, k, relative, COVARIANCE, 0, odometry, NOTHING, codes[k + 1], from_place_code=None if k else codes[0]
        )


def mapped(drives: list[np.ndarray], *shown: tuple[np.ndarray, np.ndarray]) -> PictureTrajectory:
    core = PictureTrajectory()
    for step in steps(drives, *shown):
        core.update(step)
    return core


@pytest.mark.parametrize(
    ("in_map", "driven", "first"),
    [((PLACE,), PLACE, 9), ((PLACE, COPY), PLACE, None), ((PLACE,), ELSEWHERE, None)],
)
def test_a_pose_is_claimed_in_the_only_place_that_looks_like_it(
    in_map: tuple[tuple[np.ndarray, np.ndarray], ...], driven: tuple[np.ndarray, np.ndarray], first: int | None
) -> None:
    localisation = mapped([WAY] * len(in_map), *in_map).localisation(ORIGIN)
    again = WAY + (0.1, 0.15, 0.0)
    poses = [localisation.update(step).found.pose_xyyaw for step in steps([again], driven)]
    claimed = [k for k, pose in enumerate(poses) if pose is not None]
    assert (claimed[0] if claimed else None) == first
    for k in claimed:
        assert np.abs(poses[k] - again[k + 1]).max() < 0.1


def test_a_map_of_few_key_pictures_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^the map has 11 key pictures; expected 12 or more, with features$"):
        mapped([WAY[:11]], PLACE).localisation(ORIGIN)


def test_a_state_whose_key_pictures_have_another_layout_is_refused_by_its_name(tmp_path: Path) -> None:
    core = PictureTrajectory()
    write_state(tmp_path, {**core.identity, "key_picture_layout": 1}, {})
    with pytest.raises(StateError, match="was saved with key_picture_layout 1; here it is 2"):
        read_state(tmp_path, core.identity)


def test_a_state_from_before_a_setting_was_there_is_refused_by_its_name(tmp_path: Path) -> None:
    core, older = PictureTrajectory(), deepcopy(PictureTrajectory().identity)
    del older["camera"]["loops"]["likelier"]
    write_state(tmp_path, older, {})
    with pytest.raises(StateError, match=r"another version: the setting camera.loops.likelier is new here$"):
        read_state(tmp_path, core.identity)
