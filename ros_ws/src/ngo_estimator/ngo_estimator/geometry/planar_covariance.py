"""Covariances of planar poses (x, y, yaw; m, m, rad), and the 6x6 form in which ROS messages carry them."""

import numpy as np

_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])  # x, y and yaw among x, y, z, roll, pitch, yaw
_VARIANCES = (1e-10, 1e4)  # farther apart, rounding would make some negative


def propagate(
    covariance: np.ndarray,
    pose_xyyaw: np.ndarray,
    relative_xyyaw: np.ndarray,
    relative_covariance: np.ndarray,
) -> np.ndarray:
    """Covariance ``(..., 3, 3)`` of poses after one more step, to first order.

    Args:
        covariance: ``(..., 3, 3)`` of the poses before the step, in the frame that the poses are given in.
        pose_xyyaw: ``(..., 3)`` the poses after the step.
        relative_xyyaw: ``(..., 3)`` the step, seen from the pose before it.
        relative_covariance: ``(..., 3, 3)`` of the step, in the frame of the pose before it.
    """
    yaw_before = pose_xyyaw[..., 2] - relative_xyyaw[..., 2]
    cos, sin = np.cos(yaw_before), np.sin(yaw_before)
    rotation, lever = np.zeros((2, *np.shape(yaw_before), 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = cos
    rotation[..., 0, 1], rotation[..., 1, 0], rotation[..., 2, 2] = -sin, sin, 1.0
    lever[..., [0, 1, 2], [0, 1, 2]] = 1.0
    lever[..., 0, 2] = -(sin * relative_xyyaw[..., 0] + cos * relative_xyyaw[..., 1])
    lever[..., 1, 2] = cos * relative_xyyaw[..., 0] - sin * relative_xyyaw[..., 1]
    return np.asarray(lever @ covariance @ lever.mT + rotation @ relative_covariance @ rotation.mT)


def bounded(covariance: np.ndarray) -> np.ndarray:
    """The symmetric covariance ``(3, 3)`` whose variances, along all axes, are between as good as exact and unknown."""
    symmetric = 0.5 * covariance + 0.5 * covariance.T
    # Most are within the limits, which the trace and the determinant tell without eigenvalues.
    if _is_within(symmetric):
        return symmetric
    values, vectors = np.linalg.eigh(symmetric)
    result: np.ndarray = (vectors * np.clip(values, *_VARIANCES)) @ vectors.T
    return result


def _is_within(symmetric: np.ndarray) -> bool:
    """Whether a symmetric matrix ``(3, 3)`` surely has eigenvalues within the limits."""
    (a, b, c), (_, d, e), (_, _, f) = symmetric.tolist()
    minor, trace = a * d - b * b, a + d + f
    determinant = f * minor - a * e * e - d * c * c + 2.0 * b * c * e
    # The least eigenvalue is over the determinant by the square of half the trace. Rounding is far below the rest.
    return a > 0.0 and minor > 0.0 and trace < _VARIANCES[1] and determinant > 2.0 * _VARIANCES[0] * trace * trace


def to_spatial(covariance: np.ndarray) -> np.ndarray:
    """Row-major ``(36,)`` covariance of x, y, z, roll, pitch, yaw; z, roll and pitch are exactly 0."""
    spatial = np.zeros((6, 6))
    spatial[_PLANAR] = covariance
    return spatial.ravel()


def to_planar(spatial: np.ndarray) -> np.ndarray:
    """The covariance ``(3, 3)`` of x, y and yaw in a row-major one ``(36,)`` of x, y, z, roll, pitch, yaw."""
    return np.asarray(spatial.reshape(6, 6)[_PLANAR])


def position_std(covariance: np.ndarray) -> float:
    """Standard deviation (m) of the position in its most uncertain direction, of a covariance ``(3, 3)``."""
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance[:2, :2])[-1])))
