"""How far a trajectory is from the truth, in the field's terms: ATE, RPE, and the segment errors of KITTI.

ATE and RPE after Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems" (2012), with the conventions of
evo; segment errors after Geiger et al., "Are we ready for autonomous driving? The KITTI vision benchmark suite" (2012).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from ngo_estimator.trajectory.files import SpatialPoses

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_KITTI_STEP = 10  # frames from the start of a segment to that of the next
_ALL_PAIRS_TOLERANCE = 0.1  # of the distance asked for, as in evo

Alignment = Literal["none", "first", "best"]
ALIGNMENTS: tuple[Alignment, ...] = ("first", "best", "none")
"""``first``: the first pose is the truth's; ``best``: the motion of least squares; ``none``: as the files are."""


@dataclass(frozen=True)
class Summary:
    """Statistics of some errors, as evo gives them."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: np.ndarray) -> "Summary":
        """The statistics of ``errors`` ``(n,)``."""
        rmse = np.sqrt(np.mean(errors**2))
        values = rmse, errors.mean(), np.median(errors), errors.std(), errors.min(), errors.max()
        return cls(*(float(value) for value in values))


@dataclass(frozen=True)
class PoseErrors:
    """``translation_m`` and ``rotation_deg`` ``(n,)``, both absolute values."""

    translation_m: np.ndarray
    rotation_deg: np.ndarray


@dataclass(frozen=True)
class RelativeDelta:
    """Between which poses relative errors are taken: ``size`` frames or metres apart.

    Pairs follow each other, the end of one being the start of the next; with ``all_pairs`` every pose starts one.
    Metres are counted along the estimate, as evo does.
    """

    size: float = 1.0
    unit: Literal["frames", "metres"] = "frames"
    all_pairs: bool = False

    def __post_init__(self) -> None:
        if not self.size > 0.0 or (self.unit == "frames" and self.size != int(self.size)):
            expected = "a whole number of at least 1" if self.unit == "frames" else "more than 0"
            raise ValueError(f"delta is {self.size:g} {self.unit}; expected {expected}")


@dataclass(frozen=True)
class SegmentErrors:
    """Mean errors over all segments, and how many of each length there are ``{length_m: segments}``."""

    translation_percent: float
    rotation_deg_per_m: float
    segments: dict[float, int]


def associate(
    estimate: SpatialPoses, truth: SpatialPoses, tolerance_s: float = 0.01
) -> tuple[SpatialPoses, SpatialPoses]:
    """The poses of both that belong together: each of the shorter one, with the nearest in time of the other.

    Raises:
        ValueError: no two poses lie within ``tolerance_s``.
    """
    few, many = (estimate, truth) if len(estimate) <= len(truth) else (truth, estimate)
    after = np.searchsorted(many.stamps_ns, few.stamps_ns).clip(1, max(len(many) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(many) - 1)
    later = np.abs(many.stamps_ns[after] - few.stamps_ns) < np.abs(few.stamps_ns - many.stamps_ns[before])
    nearest = np.where(later, after, before)
    apart_ns = np.abs(many.stamps_ns[nearest] - few.stamps_ns)
    near = apart_ns <= round(tolerance_s * 1e9)
    if not near.any():
        raise ValueError(
            f"no pose of the estimate ({_span(estimate)}) lies within {tolerance_s:g} s of one of the truth "
            f"({_span(truth)}); the nearest are {apart_ns.min() / 1e9:.3f} s apart; expected stamps of one clock"
        )
    chosen_few, chosen_many = take(few, np.flatnonzero(near)), take(many, nearest[near])
    return (chosen_few, chosen_many) if few is estimate else (chosen_many, chosen_few)


def take(poses: SpatialPoses, indices: np.ndarray) -> SpatialPoses:
    """The poses at ``indices``."""
    return SpatialPoses(poses.stamps_ns[indices], poses.positions_xyz[indices], poses.quaternions_xyzw[indices])


def aligned(estimate: SpatialPoses, truth: SpatialPoses, how: Alignment) -> SpatialPoses:
    """The estimate, moved as a whole toward the truth, pose by pose the same number.

    Raises:
        ValueError: ``best`` of positions that all lie on one line, about which they could turn.
    """
    if how == "none":
        return estimate
    if how == "first":
        turn = Rotation.from_quat(truth.quaternions_xyzw[0]) * Rotation.from_quat(estimate.quaternions_xyzw[0]).inv()
        shift = truth.positions_xyz[0] - turn.apply(estimate.positions_xyz[0])
    else:
        turn, shift = _least_squares_motion(estimate.positions_xyz, truth.positions_xyz)
    return SpatialPoses(
        estimate.stamps_ns,
        turn.apply(estimate.positions_xyz) + shift,
        (turn * Rotation.from_quat(estimate.quaternions_xyzw)).as_quat(),
    )


def absolute_errors(estimate: SpatialPoses, truth: SpatialPoses) -> PoseErrors:
    """Pose by pose, without any alignment: the ATE is their root mean square."""
    turn = Rotation.from_quat(truth.quaternions_xyzw).inv() * Rotation.from_quat(estimate.quaternions_xyzw)
    shift = estimate.positions_xyz - truth.positions_xyz
    return PoseErrors(np.linalg.norm(shift, axis=1), np.degrees(turn.magnitude()))


def relative_errors(estimate: SpatialPoses, truth: SpatialPoses, delta: RelativeDelta) -> PoseErrors:
    """Errors of the motion between poses that lie ``delta`` apart: the RPE is their root mean square.

    Raises:
        ValueError: the trajectory has no such poses.
    """
    pairs = _pairs(estimate, delta)
    if len(pairs) == 0:
        length = f"{len(estimate)} poses over {path_length_m(estimate):.1f} m"
        raise ValueError(f"the estimate has {length}; expected some that are {delta.size:g} {delta.unit} apart")
    return _errors_of_motion(estimate, truth, pairs[:, 0], pairs[:, 1])


def segment_errors(
    estimate: SpatialPoses, truth: SpatialPoses, lengths_m: Sequence[float] = KITTI_LENGTHS_M
) -> SegmentErrors:
    """The segment errors of the KITTI odometry benchmark.

    From every tenth frame a segment of each length begins, which ends at the first frame that is farther along the true
    path; its error is divided by its length. Lengths that the path is too short for have no segments.

    Raises:
        ValueError: the path is too short for all of them.
    """
    if not lengths_m or min(lengths_m) <= 0.0:
        raise ValueError(f"lengths are {list(lengths_m)}; expected some above 0 m")
    along_m = _distances(truth)
    starts = np.arange(0, len(truth), _KITTI_STEP)
    translation, rotation, counts = [], [], {}
    for length_m in lengths_m:
        ends = np.searchsorted(along_m, along_m[starts] + length_m, side="right")
        inside = ends < len(truth)
        counts[float(length_m)] = int(inside.sum())
        errors = _errors_of_motion(estimate, truth, starts[inside], ends[inside])
        translation.append(errors.translation_m / length_m)
        rotation.append(errors.rotation_deg / length_m)
    if not any(counts.values()):
        raise ValueError(
            f"the true path is {along_m[-1]:.1f} m long: too short for segments of {_listed(lengths_m)} m; "
            "give lengths that fit into it"
        )
    return SegmentErrors(
        100.0 * float(np.concatenate(translation).mean()), float(np.concatenate(rotation).mean()), counts
    )


def path_length_m(poses: SpatialPoses) -> float:
    """Length of the path through the poses."""
    return float(_distances(poses)[-1])


def _distances(poses: SpatialPoses) -> np.ndarray:
    steps = np.linalg.norm(np.diff(poses.positions_xyz, axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def _pairs(poses: SpatialPoses, delta: RelativeDelta) -> np.ndarray:
    """Indices ``(pairs, 2)`` of poses that lie ``delta`` apart."""
    count = len(poses)
    if delta.unit == "frames":
        size = int(delta.size)
        starts = np.arange(0, max(count - size, 0), 1 if delta.all_pairs else size)
        return np.column_stack((starts, starts + size))
    along_m = _distances(poses)
    if not delta.all_pairs:
        ends = [0]
        while (found := _first_beyond(along_m, ends[-1], delta.size)) < count:
            ends.append(found)
        return np.column_stack((ends[:-1], ends[1:]))
    earliest = np.minimum(np.arange(count) + 1, count - 1)
    after = np.searchsorted(along_m, along_m + delta.size).clip(1, count - 1)
    # Where the robot stood still, the first of the poses at one place.
    before = np.maximum(np.searchsorted(along_m, along_m[after - 1]), earliest)
    gaps = np.abs(along_m[[before, after]] - along_m - delta.size)
    ends_at = np.where(gaps[0] <= gaps[1], before, after)
    near = (gaps.min(axis=0) <= _ALL_PAIRS_TOLERANCE * delta.size) & (ends_at > np.arange(count))
    return np.column_stack((np.flatnonzero(near), ends_at[near]))


def _first_beyond(along_m: np.ndarray, start: int, size_m: float) -> int:
    """The first pose after ``start`` at least ``size_m`` farther along."""
    return start + 1 + int(np.searchsorted(along_m[start + 1 :] - along_m[start], size_m))


def _errors_of_motion(estimate: SpatialPoses, truth: SpatialPoses, starts: np.ndarray, ends: np.ndarray) -> PoseErrors:
    """Errors of the motions from ``starts`` to ``ends``, indices of the poses."""
    shift, turn = _motion(estimate, starts, ends)
    true_shift, true_turn = _motion(truth, starts, ends)
    # Seen from the truth's end or from its start, the lengths of the errors are the same.
    return PoseErrors(
        np.linalg.norm(shift - true_shift, axis=1),
        np.degrees((true_turn.inv() * turn).magnitude()) if len(starts) else np.zeros(0),
    )


def _motion(poses: SpatialPoses, starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, Rotation]:
    rotations = Rotation.from_quat(poses.quaternions_xyzw)
    back = rotations[starts].inv()
    return back.apply(poses.positions_xyz[ends] - poses.positions_xyz[starts]), back * rotations[ends]


def _least_squares_motion(points: np.ndarray, onto: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """Rotation and shift that bring ``points`` nearest to ``onto`` (Kabsch, 1976; Umeyama, 1991, without scale)."""
    centre, onto_centre = points.mean(axis=0), onto.mean(axis=0)
    left, sizes, right = np.linalg.svd((onto - onto_centre).T @ (points - centre) / len(points))
    if np.count_nonzero(sizes > np.finfo(float).eps) < 2:
        raise ValueError("the positions lie on one line: no alignment is the best; use 'first' or 'none'")
    mirrored = np.linalg.det(left) * np.linalg.det(right) < 0.0
    turn = left @ np.diag([1.0, 1.0, -1.0 if mirrored else 1.0]) @ right
    return Rotation.from_matrix(turn), onto_centre - turn @ centre


def _span(poses: SpatialPoses) -> str:
    return f"{poses.stamps_ns[0] / 1e9:.3f} to {poses.stamps_ns[-1] / 1e9:.3f} s"


def _listed(lengths_m: Sequence[float]) -> str:
    return ", ".join(f"{length:g}" for length in lengths_m)
