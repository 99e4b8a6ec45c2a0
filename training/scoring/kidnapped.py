"""Kidnapped starts: a robot wakes up somewhere in a mapped maze, and says where it is, or that it does not know."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from ngo_estimator.geometry import se2

FRAMES = 60  # Frames of a start.

IN_TIME = 50  # Frames within which a success counts.

MOST_M, MOST_DEG = 0.5, 5.0  # Errors up to which a pose is right.

NUMBERS = ("success", "false_claims", "frames", "heading_rmse_deg", "wrong_later", "lost")  # What is said of a start.

_LEAST_MAPPED = 0.9  # share of the frames in time that lie where the map has frames

Features = dict[str, np.ndarray]


@dataclass(frozen=True)
class KnownMap:
    """A maze's map: corrected ``poses`` and true ``truth`` ``(frames, 3)`` of its frames, and their ``codes``.

    ``place_m`` is the distance of two frames that show one place.
    """

    poses: np.ndarray
    truth: np.ndarray
    codes: np.ndarray
    place_m: float


Row = Callable[[int], list[np.ndarray | None]]
"""From a start, the number of a frame, to the pose that is claimed after each of ``FRAMES`` steps."""


class MapErrors:
    """Errors of poses in a map, which has errors of its own: they are measured where the robot truly is.

    A pose is compared with the frames of the map that are truly within a place of the robot: where they lie in the map
    says where the robot does. They need not agree, and neither with the truth as seen from the map's first frame; the
    smallest error counts.
    """

    def __init__(self, known: KnownMap, truth: np.ndarray) -> None:
        self._known, self._truth = known, torch.from_numpy(truth)
        self._distance = np.linalg.norm(truth[:, None, :2] - known.truth[None, :, :2], axis=-1)

    def of(self, frame: int, pose: np.ndarray) -> tuple[float, float]:
        """Errors (m, degrees) of a pose ``(3,)`` of a frame of the second drive."""
        known, distance = self._known, self._distance[frame]
        near = np.append(0, np.flatnonzero(distance <= max(known.place_m, distance.min())))
        mapped, true = (torch.from_numpy(poses[near]) for poses in (known.poses, known.truth))
        expected = se2.compose(mapped, se2.between(true, self._truth[frame])).numpy()
        metres = np.hypot(expected[:, 0] - pose[0], expected[:, 1] - pose[1])
        degrees = np.degrees(np.abs((expected[:, 2] - pose[2] + math.pi) % (2.0 * math.pi) - math.pi))
        best = int(np.maximum(metres / MOST_M, degrees / MOST_DEG).argmin())
        return float(metres[best]), float(degrees[best])

    def mapped(self, start: int) -> bool:
        """Whether the frames in time after a start lie within two places of frames of the map, nearly all of them."""
        near = self._distance[start : start + IN_TIME + 1].min(axis=1) <= 2.0 * self._known.place_m
        return bool(near.mean() >= _LEAST_MAPPED)


def starts(errors: MapErrors, frames: int, count: int) -> tuple[list[int], list[int]]:
    """``count`` starts in mapped parts of a drive of so many frames, and up to a fifth as many in other parts."""
    candidates = np.arange(0, frames - FRAMES - 1, 4).tolist()
    mapped = [start for start in candidates if errors.mapped(start)]
    others = [start for start in candidates if not errors.mapped(start)]
    return _spread(mapped, count), _spread(others, count // 5)


def scored(errors: MapErrors, start: int, claims: list[np.ndarray | None]) -> dict[str, float]:
    """Numbers of one start, from the claimed pose after each step; NaN where there is none.

    ``success``: the first claimed pose is right, and in time. ``false_claims``: it is wrong, however late. ``frames``:
    steps up to a success. ``heading_rmse_deg``: of all claimed poses from a success on. ``wrong_later``: share of these
    that are wrong. ``lost``: share of the steps after a success without a pose.
    """
    found = [(k, *errors.of(start + 1 + k, pose)) for k, pose in enumerate(claims) if pose is not None]
    right = [metres <= MOST_M and degrees <= MOST_DEG for _, metres, degrees in found]
    success = bool(found) and right[0] and found[0][0] < IN_TIME
    result = dict.fromkeys(NUMBERS, math.nan)
    result |= {"success": float(success), "false_claims": float(bool(found) and not right[0])}
    if success:
        headings = np.array([degrees for _, _, degrees in found])
        after = len(claims) - found[0][0]
        result |= {
            "frames": found[0][0] + 1.0,
            "heading_rmse_deg": float(np.sqrt(np.square(headings).mean())),
            "wrong_later": 1.0 - float(np.mean(right)),
            "lost": 1.0 - len(found) / after,
        }
    return result


def _spread(values: list[int], count: int) -> list[int]:
    chosen = np.linspace(0, len(values) - 1, min(count, len(values))).round().astype(np.int64)
    return [values[k] for k in chosen]
