"""Steps of a lidar's local estimator along known ways, without the estimator."""

from collections.abc import Callable, Iterator

import numpy as np

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import between, compose
from tests.unit.ngo_estimator.ray_casting import walls

STEP_NS = 100_000_000
STEP_COVARIANCE = np.diag((0.01, 0.01, 0.004)) ** 2
NOTHING = np.zeros(0, np.float32)
KEY_M = 0.29
# Two rooms and a way round between them: no two places look alike.
HOUSE = walls(
    ((-2.0, -2.0), (12.0, -2.0), (12.0, 8.0), (-2.0, 8.0)),
    ((2.0, 2.0), (8.0, 2.0), (8.0, 4.0), (5.0, 4.0), (5.0, 3.2), (2.0, 3.2)),
    ((9.5, 6.0), (10.5, 6.5), (10.0, 7.2)),
    ((-1.0, 5.5), (0.5, 5.0), (0.0, 6.5)),
    ((4.0, -1.5), (4.6, -1.5), (4.6, -1.0), (4.0, -1.0)),
)


def loop_way(rounds: float, step_m: float = 0.15) -> np.ndarray:
    """Poses ``(n, 3)`` round the house's block, from the origin on, with turns on the spot."""
    corners = ((0.0, 0.0), (10.0, 0.0), (10.0, 5.0), (0.0, 5.0))
    poses = [np.zeros(3)]
    side, gone, total = 0, 0.0, rounds * 30.0
    while gone < total:
        start, end = np.array(corners[side % 4]), np.array(corners[(side + 1) % 4])
        length, heading = float(np.linalg.norm(end - start)), side * np.pi / 2.0
        for k in range(1, round(length / step_m) + 1):
            x, y = start + (end - start) * k * step_m / length
            poses.append(np.array((x, y, heading)))
            gone += step_m
            if gone >= total:
                break
        poses += [np.array((*end, heading + turn)) for turn in np.radians((30.0, 60.0))]
        side += 1
    return np.array(poses)


def drifted(poses: np.ndarray, drift: tuple[float, float, float]) -> np.ndarray:
    """The same way, with an error in each step (m, m, rad), in proportion to its length."""
    result = [poses[0]]
    for a, b in zip(poses[:-1], poses[1:], strict=True):
        step = between(a, b)
        result.append(compose(result[-1], step + np.array(drift) * np.hypot(step[0], step[1])))
    return np.array(result)


def lidar_steps(
    odometry: np.ndarray,
    scan: Callable[[int, int], KeyScan],
    *,
    begin_ns: int = 10**12,
    covariance: np.ndarray = STEP_COVARIANCE,
    key_m: float = KEY_M,
) -> Iterator[RelativeStep]:
    """A step for each pose ``(n, 3)`` of the odometry after the first; ``scan`` makes that of a frame and a stamp."""
    key, key_ns = odometry[0], begin_ns
    for k in range(1, len(odometry)):
        stamp_ns, key_step = begin_ns + k * STEP_NS, None
        since = between(key, odometry[k])
        if np.hypot(since[0], since[1]) >= key_m or abs(since[2]) > 0.25:
            key_step = KeyScanStep(scan(k, stamp_ns), key_ns, since, covariance)
            key, key_ns = odometry[k], stamp_ns
        yield RelativeStep(
            stamp_ns,
            stamp_ns - STEP_NS,
            between(odometry[k - 1], odometry[k]),
            covariance,
            begin_ns,
            between(odometry[0], odometry[k]),
            NOTHING,
            NOTHING,
            key=key_step,
            origin_scan=scan(0, begin_ns) if k == 1 else None,
        )
