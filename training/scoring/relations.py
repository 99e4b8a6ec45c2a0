"""Errors over relative poses, the metric of the Freiburg SLAM benchmark.

After Kuemmerle et al., "On measuring the accuracy of SLAM algorithms" (Autonomous Robots 27, 2009), equation 1 with the
translational and the rotational error apart: people found where a robot was at one stamp, seen from where it was at
another, and an estimate is wrong by how far it differs there. Nothing is aligned, and an error at one place spoils the
relations there and no others. Burgard et al., "A comparison of SLAM algorithms based on a graph of relations" (IROS
2009), give results of three methods on the same relations.
"""

from dataclasses import dataclass

import numpy as np

from training.data.lidar_drives import Relations

FAR_S = 30.0  # Relations that span more than this tell of loops, shorter ones of odometry.

_INSIDE_S = 0.01  # by which a relation may begin before the estimate, or end after it


@dataclass(frozen=True)
class RelationErrors:
    """Errors of an estimate at the relations within it: ``translation_m``, ``rotation_deg`` ``(n,)``, none negative.

    ``spans_s`` ``(n,)`` is the time from a relation's first stamp to its second, ``left_out`` counts the relations
    beyond the estimate's ends.
    """

    translation_m: np.ndarray
    rotation_deg: np.ndarray
    spans_s: np.ndarray
    left_out: int

    @property
    def far(self) -> np.ndarray:
        """Which relations span more than ``FAR_S``, bool ``(n,)``."""
        return np.asarray(self.spans_s > FAR_S)


def relation_errors(relations: Relations, stamps_s: np.ndarray, poses_xyyaw: np.ndarray) -> RelationErrors:
    """Errors of poses ``(m, 3)`` at increasing ``stamps_s`` ``(m,)``, interpolated at the relations' stamps.

    Raises:
        ValueError: shapes disagree, stamps do not increase, or no relation lies within the estimate.
    """
    stamps_s, poses_xyyaw = np.asarray(stamps_s, dtype=np.float64), np.asarray(poses_xyyaw, dtype=np.float64)
    if stamps_s.ndim != 1 or poses_xyyaw.shape != (len(stamps_s), 3) or len(stamps_s) < 2:
        raise ValueError(
            f"stamps, poses are {stamps_s.shape}, {poses_xyyaw.shape}; expected (m,), (m, 3) of two or more"
        )
    if not (np.diff(stamps_s) > 0.0).all():
        raise ValueError("the estimate's stamps do not increase; expected each after the one before")
    asked = relations.stamps_s
    inside = (asked.min(axis=1) >= stamps_s[0] - _INSIDE_S) & (asked.max(axis=1) <= stamps_s[-1] + _INSIDE_S)
    if not inside.any():
        raise ValueError(
            f"none of {len(asked)} relations lies within the estimate's {stamps_s[0]} s to {stamps_s[-1]} s"
        )
    start, end = (interpolated(stamps_s, poses_xyyaw, asked[inside, column]) for column in (0, 1))
    cosine, sine = np.cos(start[:, 2]), np.sin(start[:, 2])
    x, y = end[:, 0] - start[:, 0], end[:, 1] - start[:, 1]
    wanted = relations.relative_xyyaw[inside]
    translation = np.hypot(cosine * x + sine * y - wanted[:, 0], cosine * y - sine * x - wanted[:, 1])
    turn = np.remainder(end[:, 2] - start[:, 2] - wanted[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    spans = np.abs(asked[inside, 1] - asked[inside, 0])
    return RelationErrors(translation, np.degrees(np.abs(turn)), spans, int((~inside).sum()))


def interpolated(stamps_s: np.ndarray, poses_xyyaw: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """Poses ``(n, 3)`` at ``at_s`` ``(n,)``, linear between neighbours; headings go the short way, on past pi."""
    columns = (poses_xyyaw[:, 0], poses_xyyaw[:, 1], np.unwrap(poses_xyyaw[:, 2]))
    return np.stack([np.interp(at_s, stamps_s, column) for column in columns], axis=-1)
