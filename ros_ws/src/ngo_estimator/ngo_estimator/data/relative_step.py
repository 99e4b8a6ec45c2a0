"""One step of the local odometry, as the online trajectory takes it, and what makes one unusable."""

import math
from dataclasses import dataclass, field

import numpy as np

from ngo_estimator.geometry.key_scan import KeyScan

RESTART_AFTER_NS = 1_000_000_000
"""A stamp this far in the past means that the source restarted; anything less is a late frame."""

LARGEST_VALUE = 1e4
"""Largest size of a coordinate (m, rad), feature or code: beyond it the optimizer's float32 has no room to compute."""

LARGEST_ODOMETRY = 1e9  # Largest size of a coordinate (m, rad) of the pose in ``odom``, which enters in float64 only.

LARGEST_SCAN = 20_000
"""Most points, and most rays, of a key scan: it bounds the time and memory that a message may cost."""

UNFAMILIAR = 1.0  # Unlikeness beyond which a frame is unlike what the networks learned from.


class RejectedStep(ValueError):
    """A relative pose that cannot be used; the trajectory is as it was before."""


class DuplicateStep(RejectedStep):
    """A step to the frame that is the newest already."""


class LateStep(RejectedStep):
    """A step to a frame that is a little older than the newest one."""


@dataclass(frozen=True, eq=False)
class KeyScanStep:
    """The key scan that a step ends at, and where it was taken.

    ``from_key_stamp_ns`` is the stamp of the key scan before it. The pose ``relative_xyyaw`` (3,) is seen from there,
    with its ``covariance`` (3, 3) by registration, by which steps and loops are weighed against each other. ``factors``
    (3,) on its deviations (x, y, yaw) are for the covariance that is published.
    """

    scan: KeyScan
    from_key_stamp_ns: int
    relative_xyyaw: np.ndarray
    covariance: np.ndarray
    factors: np.ndarray = field(default_factory=lambda: np.ones(3))


@dataclass(frozen=True)
class RelativeStep:
    """Motion between two frames, as the local odometry has it.

    ``relative_xyyaw`` (3,) is the newer frame in the older one, ``covariance`` (3, 3) its covariance (x, y, yaw),
    ``odom_xyyaw`` (3,) the newer frame in ``odom``, whose origin is the frame at ``origin_stamp_ns`` (m, rad).
    ``motion_feature`` and ``place_code`` (of the newer frame) are float32 vectors. ``from_place_code`` is that of the
    older one. Only the first step after a start has it: later ones would repeat it. ``key`` is there if the step ends
    at a key scan of a lidar. ``origin_scan``, the lidar's first scan, is in the first step after a start.
    ``robot_odom_xyyaw`` (3,) is the newer frame in the robot's own ``odom``, where the robot has one: not a number
    where it is not known at this stamp.
    ``unlikeness`` of the newer frame: over 1 it is unlike what the networks learned from, 0 where nobody knows.
    The scan of an ``unsure`` step does not say where it was taken: only in the front end, messages do not carry it.
    With ``segment`` no scan measured the motion: the covariance says how little is known, and only loops tie the frames
    behind it to those before.
    """

    stamp_ns: int
    from_stamp_ns: int
    relative_xyyaw: np.ndarray
    covariance: np.ndarray
    origin_stamp_ns: int
    odom_xyyaw: np.ndarray
    motion_feature: np.ndarray
    place_code: np.ndarray
    from_place_code: np.ndarray | None = field(default=None, kw_only=True)
    key: KeyScanStep | None = field(default=None, kw_only=True)
    origin_scan: KeyScan | None = field(default=None, kw_only=True)
    robot_odom_xyyaw: np.ndarray | None = field(default=None, kw_only=True)
    unlikeness: float = field(default=0.0, kw_only=True)
    unsure: bool = field(default=False, kw_only=True)
    segment: bool = field(default=False, kw_only=True)

    @property
    def tf_odom_xyyaw(self) -> np.ndarray:
        """Pose (3,) of the newer frame in the frame ``odom`` on TF: the robot's own where it has one."""
        return self.robot_odom_xyyaw if self.robot_odom_xyyaw is not None and self.tf_odom_known else self.odom_xyyaw

    @property
    def tf_odom_known(self) -> bool:
        """Whether ``map`` -> ``odom`` follows from this step."""
        return self.robot_odom_xyyaw is None or not all(map(math.isnan, self.robot_odom_xyyaw))


def check_step(step: RelativeStep, motion_feature_size: int, code_length: int | None) -> None:
    """Raise ``RejectedStep`` if a step cannot be used, whatever came before it.

    Args:
        motion_feature_size, code_length: lengths that are expected; None if place codes are not used.
    """
    vectors = {
        "relative_xyyaw": (step.relative_xyyaw, (3,)),
        "odom_xyyaw": (step.odom_xyyaw, (3,)),
        "motion_feature": (step.motion_feature, (motion_feature_size,)),
    }
    if code_length is not None:
        vectors["place_code"] = (step.place_code, (code_length,))
        if step.from_place_code is not None:
            vectors["from_place_code"] = (step.from_place_code, (code_length,))
    for name, (value, shape) in vectors.items():
        _check_values(name, value, shape, LARGEST_ODOMETRY if name == "odom_xyyaw" else LARGEST_VALUE)
    _check_covariance("covariance", step.covariance)
    if not 0.0 <= step.unlikeness < np.inf:
        raise RejectedStep(f"unlikeness is {step.unlikeness}; expected a finite number of at least 0")
    if step.from_stamp_ns >= step.stamp_ns:
        raise RejectedStep(f"step goes from {step.from_stamp_ns} ns to {step.stamp_ns} ns; expected a later end")
    if step.robot_odom_xyyaw is not None and step.tf_odom_known:
        # The wheels' largest pose, carried on to the scan.
        _check_values("robot_odom_xyyaw", step.robot_odom_xyyaw, (3,), LARGEST_ODOMETRY + LARGEST_VALUE)
    if step.key is not None:
        _check_scan("key scan", step.key.scan, step.stamp_ns)
        _check_values("relative_xyyaw of the key scan", step.key.relative_xyyaw, (3,), LARGEST_VALUE)
        _check_covariance("covariance of the key scan", step.key.covariance)
    if step.origin_scan is not None:
        _check_scan("origin scan", step.origin_scan, step.from_stamp_ns)


def _check_values(name: str, value: np.ndarray, shape: tuple[int, ...], limit: float) -> None:
    if value.shape != shape:
        raise RejectedStep(f"{name} is of shape {value.shape}; expected {shape}")
    values = value.ravel().tolist()  # few, for which this is faster than an array
    if not all(map(math.isfinite, values)):
        raise RejectedStep(f"{name} has values that are not finite")
    if (largest := max(map(abs, values), default=0.0)) > limit:
        raise RejectedStep(f"{name} has values as large as {largest:g}; expected at most {limit:g}")


def _check_covariance(name: str, covariance: np.ndarray) -> None:
    _check_values(name, covariance, (3, 3), np.inf)
    variances = np.diagonal(covariance).tolist()
    if min(variances) <= 0.0:
        raise RejectedStep(f"{name} has the variances {variances}; expected positive ones")


def _check_scan(name: str, scan: KeyScan, stamp_ns: int) -> None:
    if scan.stamp_ns != stamp_ns:
        raise RejectedStep(f"{name} is of {scan.stamp_ns} ns; expected {stamp_ns} ns, that of its frame")
    if max(len(scan.points), len(scan.angles)) > LARGEST_SCAN:
        raise RejectedStep(
            f"{name} has {len(scan.points)} points and {len(scan.angles)} rays; expected at most {LARGEST_SCAN} of each"
        )
    for part, limit in (("points", LARGEST_VALUE), ("normals", 1.001), ("angles", 100.0), ("sensor_xyyaw", 1e4)):
        largest = np.abs(getattr(scan, part)).max(initial=0.0)
        if largest > limit:
            raise RejectedStep(f"{name} has {part} as large as {largest:g}; expected at most {limit:g}")
