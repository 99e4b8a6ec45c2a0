"""Planar rigid motions ``[x, y, yaw]`` (m, m, rad; REP-103) of single poses, compiled; ``se2`` has those of many.

Poses have the shape ``(3,)`` where nothing else is said. ``compose(a, b)`` is ``a @ b``; the yaw of every result lies
in ``(-pi, pi]``.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def wrap(angle: float) -> float:
    """An angle (rad) mapped into ``(-pi, pi]``."""
    return angle - 2.0 * math.pi * math.ceil((angle - math.pi) / (2.0 * math.pi))


@njit(cache=True)
def compose(a: Array, b: Array) -> Array:
    """The pose that applies ``b`` in the frame of ``a``."""
    cos, sin = math.cos(a[2]), math.sin(a[2])
    return np.array((a[0] + cos * b[0] - sin * b[1], a[1] + sin * b[0] + cos * b[1], wrap(a[2] + b[2])))


@njit(cache=True)
def between(a: Array, b: Array) -> Array:
    """Pose ``b`` seen from pose ``a``: ``compose(a, between(a, b))`` is ``b``."""
    cos, sin = math.cos(a[2]), math.sin(a[2])
    x, y = b[0] - a[0], b[1] - a[1]
    return np.array((cos * x + sin * y, -sin * x + cos * y, wrap(b[2] - a[2])))


@njit(cache=True)
def arc_velocity(motion: Array, elapsed_s: float) -> Array:
    """The constant velocity ``(3,)`` (m/s, m/s, rad/s) along the robot's axes of a motion ``(3,)`` along an arc.

    The arc's chord is turned by half of its turn; that it is shorter is left out.
    """
    along = compose(np.array((0.0, 0.0, -0.5 * motion[2])), motion)
    return np.array((along[0], along[1], motion[2])) / elapsed_s


@njit(cache=True)
def arc_motion(velocity: Array, elapsed_s: float) -> Array:
    """The motion ``(3,)`` of a constant velocity ``(3,)``: the inverse of ``arc_velocity``."""
    motion = velocity * elapsed_s
    chord = compose(np.array((0.0, 0.0, 0.5 * motion[2])), motion)
    return np.array((chord[0], chord[1], motion[2]))


@njit(cache=True)
def all_between(a: Array, b: Array) -> Array:
    """``between`` of poses ``(n, 3)``, row by row; either may be a single one ``(1, 3)`` for all rows of the other."""
    result = np.empty((len(b) if len(a) == 1 else len(a), 3))
    for k in range(len(result)):
        i, j = 0 if len(a) == 1 else k, 0 if len(b) == 1 else k
        cos, sin = math.cos(a[i, 2]), math.sin(a[i, 2])
        x, y = b[j, 0] - a[i, 0], b[j, 1] - a[i, 1]
        result[k, 0], result[k, 1], result[k, 2] = cos * x + sin * y, -sin * x + cos * y, wrap(b[j, 2] - a[i, 2])
    return result


@njit(cache=True)
def chained(relative: Array) -> Array:
    """Poses ``(n + 1, 3)``, the origin in front, of relative ones ``(n, 3)``, each seen from the one before."""
    poses = np.zeros((len(relative) + 1, 3))
    x, y, yaw = 0.0, 0.0, 0.0
    for k in range(len(relative)):
        cos, sin = math.cos(yaw), math.sin(yaw)
        x += cos * relative[k, 0] - sin * relative[k, 1]
        y += sin * relative[k, 0] + cos * relative[k, 1]
        yaw = wrap(yaw + relative[k, 2])
        poses[k + 1, 0], poses[k + 1, 1], poses[k + 1, 2] = x, y, yaw
    return poses


@njit(cache=True)
def rotated(yaw: float, xy: Array) -> Array:
    """Vectors ``(n, 2)`` turned by ``yaw``."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    result = np.empty_like(xy)
    for i in range(len(xy)):
        x, y = xy[i, 0], xy[i, 1]
        result[i, 0], result[i, 1] = cos * x - sin * y, sin * x + cos * y
    return result


@njit(cache=True)
def transformed(pose: Array, points: Array) -> Array:
    """Points ``(n, 2)`` in the frame of ``pose`` as points of the frame that the pose is given in."""
    result = rotated(pose[2], points)
    for i in range(len(points)):
        result[i, 0] += pose[0]
        result[i, 1] += pose[1]
    return result


@njit(cache=True)
def turned_covariance(yaw: float, covariance: Array) -> Array:
    """A covariance ``(3, 3)`` of ``[x, y, yaw]`` whose axes of x and y are turned by ``yaw``."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    return turn @ covariance @ turn.T


@njit(cache=True)
def propagated(covariance: Array, pose: Array, relative: Array, relative_covariance: Array) -> Array:
    """``planar_covariance.propagate`` of a single pose.

    Args:
        covariance: ``(3, 3)`` of the pose before a step.
        pose: ``(3,)`` after it.
        relative: the step ``(3,)``, with its covariance ``(3, 3)``.
    """
    yaw = pose[2] - relative[2]
    cos, sin = math.cos(yaw), math.sin(yaw)
    lever = np.eye(3)
    lever[0, 2] = -(sin * relative[0] + cos * relative[1])
    lever[1, 2] = cos * relative[0] - sin * relative[1]
    return lever @ covariance @ lever.T + turned_covariance(yaw, relative_covariance)


@njit(cache=True)
def inverted(matrix: Array) -> Array:
    """``np.linalg.inv`` of a matrix ``(3, 3)``, to the last bit, in a third of the time."""
    return np.ascontiguousarray(np.linalg.solve(matrix, np.eye(3)))


@njit(cache=True)
def squared_deviations(pose: Array, mean: Array, information: Array) -> float:
    """Squared distance of a pose from a mean with an information matrix ``(3, 3)``, in deviations."""
    away = pose - mean
    away[2] = wrap(away[2])
    return float(away @ information @ away)


@njit(cache=True)
def frames_between_nodes(nodes: Array, odometry: Array, at: Array, joins: Array) -> Array:
    """Poses ``(frames, 3)`` of all frames, some of which are nodes; those behind the last follow it.

    What nodes moved against each other is spread evenly over the frames between, or is all in the step that joins.

    Args:
        nodes: corrected poses ``(nodes, 3)``.
        odometry: poses ``(frames, 3)`` by odometry.
        at: the frames that are nodes ``(nodes,)``, ascending from 0.
        joins: frames ``(n,)``, ascending, to which a step leads that another odometry made.
    """
    poses = np.empty_like(odometry)
    poses[0] = nodes[0]
    joined, last_node = 0, len(nodes) - 1
    for b in range(last_node + 1):
        first = at[b]
        last = at[b + 1] if b < last_node else len(odometry) - 1
        x0, y0, yaw0 = odometry[first]
        cos0, sin0 = math.cos(yaw0), math.sin(yaw0)
        x, y, yaw = nodes[b]
        cos, sin = math.cos(yaw), math.sin(yaw)
        moved = np.zeros(3)
        if b < last_node:
            moved = between(nodes[b], nodes[b + 1]) - between(odometry[first], odometry[last])
            moved[2] = wrap(moved[2])
        join = 0
        while joined < len(joins) and joins[joined] <= last:
            join = joins[joined]
            joined += 1
        for k in range(first + 1, last + 1):
            part = (k - first) / (last - first)
            if join > 0:
                part = 1.0 if k >= join else 0.0
            to_x, to_y = odometry[k, 0] - x0, odometry[k, 1] - y0
            in_x = cos0 * to_x + sin0 * to_y + part * moved[0]
            in_y = -sin0 * to_x + cos0 * to_y + part * moved[1]
            poses[k, 0], poses[k, 1] = x + cos * in_x - sin * in_y, y + sin * in_x + cos * in_y
            poses[k, 2] = wrap(yaw + wrap(odometry[k, 2] - yaw0) + part * moved[2])
    return poses
