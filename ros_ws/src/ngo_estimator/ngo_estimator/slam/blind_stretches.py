"""Corrections across stretches of unfamiliar frames: what is left of them where nobody knows the motion.

Not in the paper. Behind such a stretch a pose is as far off as the motion within it. A correction from before, smaller
than that, says nothing any more: the odometry alone may be nearer to the truth. So the correction is shrunk towards the
odometry by the positive-part rule of James and Stein, 1 - 1 / d^2, where d is its size in deviations of that motion. A
correction of many deviations stays, and so does each pose that a believed loop ties to those before the stretch.
"""

from __future__ import annotations

import numpy as np

from ngo_estimator.geometry import se2
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.ngo.loop_gates import odometry_variances

_LEAST_VARIANCE = 1e-12


def shrunk_corrections(
    nodes: np.ndarray, odometry: np.ndarray, variance: np.ndarray, loops: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Corrected poses ``(n, 3)`` whose corrections across blind steps are worth what is known of them.

    What lies behind a stretch moves with its end.

    Args:
        nodes: corrected poses ``(n, 3)`` in the map; odometry: the same by odometry alone, from the same origin.
        variance: of the unfamiliar motion between them ``(n - 1, 3)``, along the axes of the earlier pose; 0 where all
            is familiar.
        loops: nodes that each loop joins ``(m, 2)``, the earlier one first; weights: belief in each ``(m,)``.
    """
    cut = _untied(variance, loops[weights > BELIEVED])
    if not cut.any():
        return nodes
    poses = nodes.copy()
    first = int(cut.argmax())
    ends = np.arange(first + 1, len(nodes))
    from_first = np.stack((np.full_like(ends, first), ends), axis=-1)
    unknown = odometry_variances(from_first, odometry, np.where(cut[:, None], variance, 0.0))
    changes = np.flatnonzero(np.diff(cut[first:].astype(np.int64))) + first + 1
    bounds = [first, *changes.tolist(), len(nodes) - 1]
    for start, end in zip(bounds[:-1], bounds[1:], strict=True):
        stretch = slice(start + 1, end + 1)
        moved = se2.compose(poses[start], se2.between(nodes[start], nodes[stretch]))
        if cut[start]:
            own = _shrunk(moved - odometry[stretch], unknown[start - first : end - first])
            moved = odometry[stretch] + own
        poses[stretch] = moved
    return poses


def _untied(variance: np.ndarray, loops: np.ndarray) -> np.ndarray:
    """Which steps ``(n - 1,)`` are blind, with no loop from before them to behind them."""
    ties = np.zeros(len(variance) + 1, np.int64)
    np.add.at(ties, loops[:, 0], 1)
    np.add.at(ties, loops[:, 1], -1)
    untied: np.ndarray = (variance > 0.0).any(axis=1) & (ties.cumsum()[:-1] <= 0)
    return untied


def _shrunk(correction: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Differences of poses ``(n, 3)``, shrunk by the rule for motions of a variance ``(n, 3)``."""
    correction = se2.wrapped(correction)
    squared = np.square(correction) / np.maximum(variance, _LEAST_VARIANCE)
    share = np.clip(1.0 - 1.0 / np.maximum(squared.sum(axis=1), 1.0), 0.0, 1.0)
    shrunk: np.ndarray = correction * share[:, None]
    return shrunk


def summed_variances(variance: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Sums ``(n - 1, 3)`` of the variances of blocks ``(blocks, 3)`` between each of the nodes ``at`` ``(n,)``."""
    sums = np.concatenate((np.zeros((1, 3)), variance.cumsum(axis=0)))
    between: np.ndarray = np.diff(sums[at], axis=0)
    return between
