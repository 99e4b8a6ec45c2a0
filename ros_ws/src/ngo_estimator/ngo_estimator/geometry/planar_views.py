"""Two pictures of a camera that a robot carries over a plane: the motion between them from rays that meet.

Rays are unit vectors in the axes of the robot's base frame when each picture was taken. The robot moves by
``pose`` (x, y, yaw): where its base is the second time, seen from the first. The camera sits at ``centre`` ``(3,)`` in
the base frame. Between the pictures it moves by ``b = (x, y, 0) + R(yaw) centre - centre``, which lies in the plane.
Rays ``u`` and ``v`` of one point satisfy ``u . (b x R v) = 0``: the epipolar constraint with the essential matrix of a
planar motion (Ortin and Montiel, Indoor robot motion based on monocular images, 2001).
"""

import numpy as np

from ngo_estimator.geometry.se2 import wrap

Array = np.ndarray

_PARALLEL = 1e-12


def turn_matrices(yaw: Array) -> Array:
    """Rotations ``(n, 3, 3)`` about the vertical by angles ``(n,)``."""
    cos, sin, matrices = np.cos(yaw), np.sin(yaw), np.zeros((len(yaw), 3, 3))
    matrices[:, 0, 0] = matrices[:, 1, 1] = cos
    matrices[:, 1, 0], matrices[:, 0, 1], matrices[:, 2, 2] = sin, -sin, 1.0
    return matrices


def constraint_terms(first: Array, second: Array) -> Array:
    """Coefficients ``(n, 2, 3)``: times (cos yaw, sin yaw, 1) they give ``(n_x, n_y)`` with ``n . (b_x, b_y) = 0``."""
    (x1, y1, z1), (x2, y2, z2) = first.T, second.T
    terms = np.zeros((len(first), 2, 3))
    # R v x u, of which the plane's part counts.
    terms[:, 0] = np.stack((y2 * z1, x2 * z1, -z2 * y1), axis=1)
    terms[:, 1] = np.stack((-x2 * z1, y2 * z1, z2 * x1), axis=1)
    return terms


def minimal_motions(first: Array, second: Array) -> tuple[Array, Array]:
    """The planar motions for which two pairs of rays meet, for many such samples at once.

    The determinant of both constraints is a quadratic in (cos yaw, sin yaw), hence a quartic in tan(yaw / 2).

    Args:
        first, second: rays ``(n, 2, 3)`` of two points.

    Returns:
        Which sample each solution is of ``(m,)``, and solutions ``(m, 2)``: the yaw, and the direction of ``b`` up to
        its sign (rad).
    """
    count = len(first)
    terms = constraint_terms(first.reshape(-1, 3), second.reshape(-1, 3)).reshape(count, 2, 2, 3)
    # det = p^T Q p with p = (c, s, 1).
    q = terms[:, 0, 0, :, None] * terms[:, 1, 1, None, :] - terms[:, 0, 1, :, None] * terms[:, 1, 0, None, :]
    cc, ss, one = q[:, 0, 0], q[:, 1, 1], q[:, 2, 2]
    cs, c1, s1 = q[:, 0, 1] + q[:, 1, 0], q[:, 0, 2] + q[:, 2, 0], q[:, 1, 2] + q[:, 2, 1]
    # With c = (1 - t^2) / (1 + t^2), s = 2 t / (1 + t^2), times (1 + t^2)^2: from t^4 down.
    quartic = np.stack(
        (cc - c1 + one, 2.0 * (s1 - cs), 2.0 * (one - cc) + 4.0 * ss, 2.0 * (cs + s1), cc + c1 + one), axis=1
    )
    roots, sample = _real_roots(quartic)
    yaw = 2.0 * np.arctan(roots)
    powers = np.stack((np.cos(yaw), np.sin(yaw), np.ones(len(yaw))), axis=1)
    normals = np.einsum("mkij,mj->mki", terms[sample], powers)
    longest = np.linalg.norm(normals, axis=2).argmax(1)
    normal = normals[np.arange(len(yaw)), longest]
    return sample, np.stack((yaw, np.arctan2(-normal[:, 0], normal[:, 1])), axis=1)


def _real_roots(quartic: Array) -> tuple[Array, np.ndarray]:
    """Real roots of polynomials ``(n, 5)``, from the highest power down, and whose each is."""
    scale = np.maximum(np.abs(quartic).max(axis=1, keepdims=True), 1e-30)
    quartic = quartic / scale
    leading = np.where(np.abs(quartic[:, :1]) < _PARALLEL, _PARALLEL, quartic[:, :1])
    companion = np.zeros((len(quartic), 4, 4))
    companion[:, 0] = -quartic[:, 1:] / leading
    companion[:, 1, 0] = companion[:, 2, 1] = companion[:, 3, 2] = 1.0
    roots = np.linalg.eigvals(companion)
    sample, which = np.nonzero(np.abs(roots.imag) < 1e-6 * (1.0 + np.abs(roots.real)))
    return roots.real[sample, which], sample


def epipolar_errors(first: Array, second: Array, yaw: Array, direction: Array) -> Array:
    """How far rays ``(n, 3)`` miss each other under ``m`` motions: angles ``(m, n)``, by Sampson's distance."""
    turned = np.einsum("mij,nj->mni", turn_matrices(yaw), second)
    bx, by = np.cos(direction)[:, None], np.sin(direction)[:, None]

    def across(x: Array, y: Array, z: Array) -> tuple[Array, Array, Array]:
        return by * z, -bx * z, bx * y - by * x

    of_second = across(turned[..., 0], turned[..., 1], turned[..., 2])
    of_first = across(*first.T)
    off = sum(part * axis for part, axis in zip(of_second, first.T, strict=True))
    slope = sum(part**2 for part in of_second) + sum(part**2 for part in of_first)
    errors: Array = np.abs(off) / np.sqrt(np.maximum(slope, _PARALLEL))
    return errors


def ransac(
    first: Array,
    second: Array,
    tolerance_rad: Array | float,
    samples: int,
    near: tuple[float, float] = (0.0, np.pi),
    seed: int = 0,
) -> tuple[Array, Array] | None:
    """The motion (yaw, direction of ``b``) ``(2,)`` on which most pairs of rays ``(n, 3)`` agree.

    Args:
        tolerance_rad: how far the rays of a pair that agrees may miss each other, of all or of each ``(n,)``.
        near: the yaw that is expected, and how far from it the motion's may be (rad).

    Returns:
        The motion, its direction up to the sign, and which pairs agree ``(n,)``; None of fewer than three pairs, or
        where no motion is near.
    """
    count = len(first)
    if count < 3:
        return None
    rng = np.random.default_rng(seed)
    drawn = rng.integers(count, size=(samples, 2))
    drawn = drawn[drawn[:, 0] != drawn[:, 1]]
    motions = minimal_motions(first[drawn], second[drawn])[1]
    motions = motions[np.abs(wrap(motions[:, 0] - near[0])) <= near[1]]
    if len(motions) == 0:
        return None
    errors = epipolar_errors(first, second, motions[:, 0], motions[:, 1])
    # A cost that counts how well pairs agree, not only how many (MSAC).
    best = int(np.minimum((errors / tolerance_rad) ** 2, 1.0).sum(1).argmin())
    return motions[best], errors[best] < tolerance_rad
