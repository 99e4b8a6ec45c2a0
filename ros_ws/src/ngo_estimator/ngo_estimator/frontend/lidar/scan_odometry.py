"""The local estimator of a 2D lidar without learning: prior, search where the prior is poor, registration.

Each scan is registered to the last key scans, so that scans between two keys add no drift. The wheels' motion since the
last key scan is the prior, by its covariance: where the walls leave a direction open, the wheels decide it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from ngo_estimator.frontend.lidar.local_submap import LocalSubmap
from ngo_estimator.frontend.lidar.motion_prior import MotionPrior, MotionPriorConfig, Prediction
from ngo_estimator.frontend.lidar.step_evidence import step_evidence
from ngo_estimator.frontend.lidar.swept_scan import Registered, SweptScan, likelier
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry
from ngo_estimator.frontend.lidar.wide_search import WideSearchConfig, wide_place
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.likelihood_field import SearchConfig, search
from ngo_estimator.geometry.planar_motion import (
    Array,
    between,
    fused_covariance,
    squared_deviations,
    turned_covariance,
    wrap,
)
from ngo_estimator.geometry.scan_matching import IcpConfig, Registration, icp
from ngo_estimator.networks.step_scaling import STEP_EVIDENCE, StepScaling

_RARE = 4.0
"""Wheels that slipped, or swept otherwise than they say, are ``exp`` of this times as rare as wheels that did not."""

_SWEEP_DEVIATIONS = 1.0
"""By so many deviations must another motion of the sweep move the pose to be tried."""


@dataclass(frozen=True)
class ScanOdometryConfig:
    """How scans become odometry.

    A scan is a key scan ``key_distance_m`` or ``key_turn_deg`` from the last one, unless another was taken within
    ``known_m`` of it and turned alike. Where no wheels lead, one is that may be as far away by its deviation, if it
    shows something new: less than ``known_share`` of its points lie on lines. The last ``submap_scans`` of these
    are what the next scan is registered to. A search precedes the registration where the prediction may be
    ``poor_m`` or ``poor_deg`` wrong (one deviation); its window is ``search_deviations`` wide to each side, at most
    ``largest_window_m`` and ``largest_window_deg``. Where fewer than ``good_share`` of the points lie on lines, or
    where no wheels lead and the prediction may be ``wide_m`` wrong, a ``wide`` search follows. Where no wheels lead it
    also does where fewer than ``sure_share`` lie on lines though the prediction is not poor; what it finds must then
    have ``better_share`` more. Where fewer than ``least_share`` do, or ``least_points``, the prediction stands. A
    registration of less than ``good_share`` that is ``farthest_deviations`` from the prediction is no better than it.
    Where no wheels lead, one of less than ``sure_share`` after a search is as likely as the prediction.
    """

    key_distance_m: float = 0.3
    key_turn_deg: float = 15.0
    known_m: float = 0.3
    known_share: float = 0.95
    submap_scans: int = 30
    poor_m: float = 0.1
    poor_deg: float = 5.0
    search_deviations: float = 2.0
    good_share: float = 0.5
    sure_share: float = 0.7
    better_share: float = 0.2
    wide_m: float = 0.5
    largest_window_m: float = 1.0
    largest_window_deg: float = 30.0
    least_share: float = 0.2
    least_points: int = 15
    farthest_deviations: float = 3.5
    open_share: float = 0.01
    icp: IcpConfig = field(default_factory=IcpConfig)
    search: SearchConfig = field(default_factory=SearchConfig)
    wide: WideSearchConfig = field(default_factory=WideSearchConfig)
    prior: MotionPriorConfig = field(default_factory=MotionPriorConfig)

    def __post_init__(self) -> None:
        positive = (
            self.key_distance_m, self.key_turn_deg, self.known_m, self.poor_m, self.poor_deg, self.search_deviations,
            self.wide_m, self.farthest_deviations, self.largest_window_m, self.largest_window_deg,
        )  # fmt: skip
        if not all(0.0 < value < math.inf for value in positive):
            raise ValueError(f"the distances, angles and deviations are {positive}; expected positive numbers")
        if self.submap_scans < 1 or self.least_points < 3:
            raise ValueError(
                f"submap_scans, least_points are {self.submap_scans}, {self.least_points}; expected at least 1 and 3"
            )
        shares = (self.least_share, self.good_share, self.sure_share)
        others = (self.known_share, self.better_share)
        if not (0.0 < shares[0] <= shares[1] <= shares[2] <= 1.0 and all(0.0 < share <= 1.0 for share in others)):
            raise ValueError(
                f"least_share, good_share, sure_share are {shares} and known_share, better_share are {others}; "
                "expected 0 < least_share <= good_share <= sure_share <= 1, and the others over 0 to 1"
            )


@dataclass(frozen=True, eq=False)
class ScanEstimate:
    """Where a scan was taken.

    Attributes:
        stamp_ns: stamp of the scan.
        step: pose ``(3,)`` seen from that of the last scan (m, m, rad), and ``step_covariance`` ``(3, 3)`` of its
            components.
        pose: pose ``(3,)`` in the odometry's frame, in which the first scan has the identity.
        since_key: pose ``(3,)`` seen from that of the last key scan before this one, and ``since_key_covariance``
            ``(3, 3)`` of its components.
        is_key: this scan became a key scan.
        share: share of the scan's points that lie on lines of the last key scans.
        searched: a search over a window preceded the registration.
        unsure: the scan does not say where it was taken: the prediction stands for it, or a second place is as likely.
        evidence: ``(12,)``, columns as named in ``STEP_EVIDENCE``; zeros for the first scan.
        factors: ``(3,)`` on the deviations (x, y, yaw), by the trained network; ones without it. They are in
            ``step_covariance`` and not in ``since_key_covariance``.
        swept: the scan that was registered, with the sweep's motion that was removed.
        sweep_doubt: covariance ``(3, 3)`` of the pose, along the robot's axes and in none of the others, where another
            motion of the sweep may be right.
    """

    stamp_ns: int
    step: Array
    step_covariance: Array
    pose: Array
    since_key: Array
    since_key_covariance: Array
    is_key: bool
    share: float
    searched: bool
    unsure: bool
    evidence: Array
    factors: Array
    swept: SweptScan
    sweep_doubt: Array


class ScanOdometry:
    """Takes scans one by one, and estimates each as it comes; bounded memory."""

    def __init__(self, config: ScanOdometryConfig | None = None, scaling: StepScaling | None = None) -> None:
        self.config = config or ScanOdometryConfig()
        self._scaling = scaling
        self._submap = LocalSubmap(self.config.submap_scans, self.config.search)
        self._prior = MotionPrior(self.config.prior)
        self._pose = np.zeros(3)
        self._covariance = np.zeros((3, 3))
        self._key = np.zeros(3)
        self._passed = np.zeros(3)  # of the last key scan, or of a later scan that would be one in an unknown place
        self._stamp_ns: int | None = None
        self._middle = (0, 0.0)  # of the last scan's sweep

    def update(
        self,
        swept: SweptScan,
        wheels: WheelOdometry | None = None,
        again: Callable[[Array], SweptScan] | None = None,
        stands: bool = False,
    ) -> ScanEstimate:
        """Estimate where a scan was taken.

        Args:
            swept: newer than the last one.
            wheels: the wheels' poses so far, where the robot has wheels. Turns and poses that the scans measure are
                given to it, from which it learns its lag and how the scanner is mounted.
            again: gives the scan without a sweep of another velocity ``(3,)``.
            stands: the ranges look as if the robot stands.

        Raises:
            ValueError: the scan is not newer than the last one.
        """
        scan = swept.scan
        if self._stamp_ns is None:
            self._middle = swept.middle
            return self._begin(swept, wheels)
        if scan.stamp_ns <= self._stamp_ns:
            raise ValueError(f"the scan's stamp is {scan.stamp_ns}; expected one after {self._stamp_ns}")
        last_ns = self._stamp_ns
        prediction = self._prior.predict(scan.stamp_ns, self._pose, self._covariance, wheels, stands)
        found, doubt, searched = self._register(scan, prediction)
        slip_doubt = np.zeros((3, 3))
        if wheels is not None and prediction.measured:
            prediction, (swept, found), slip_doubt = self._without_slip(swept, prediction, found, wheels, again)
        sweep_doubt = np.zeros((3, 3))
        if again is not None:
            (swept, found), sweep_doubt = self._swept_again(swept, prediction, found, again)
        unsure = self._is_unsure(found, prediction)
        pose, covariance = prediction.mean, prediction.covariance
        if not unsure:
            pose, covariance = found.pose, self._covariance_of(found, prediction, searched)
        covariance = covariance + slip_doubt
        if doubt is not None and not unsure:
            covariance, unsure = covariance + doubt, True
        estimate = self._accept(swept, wheels, prediction, pose, covariance, found, searched, unsure, sweep_doubt)
        if wheels is not None and not unsure and found.share >= self.config.good_share:
            (before_ns, before), (after_ns, after) = self._middle, swept.middle
            turn = float(estimate.step[2]) + after - before
            wheels.observe_turn(last_ns + before_ns, scan.stamp_ns + after_ns, turn)
        if wheels is not None:
            wheels.observe_pose(scan.stamp_ns, None if unsure else estimate.pose)
        self._middle = swept.middle
        return estimate

    def _without_slip(
        self,
        swept: SweptScan,
        prediction: Prediction,
        found: Registration,
        wheels: WheelOdometry,
        again: Callable[[Array], SweptScan] | None,
    ) -> tuple[Prediction, Registered, Array]:
        """The prediction, the scan and its registration, by the velocity where the walls say that the wheels slipped;
        and the covariance ``(3, 3)`` by which the other may be right.

        Wheels that slip during a sweep bend the scan. Where it fits nowhere, the velocity removes its motion, too.
        """
        by_velocity = self._prior.without_slip(swept.scan.stamp_ns, self._pose, self._covariance, wheels, prediction)
        if by_velocity is None:
            return prediction, (swept, found), np.zeros((3, 3))
        other, velocity = by_velocity
        starts, prior = list(other.starts), (other.mean, other.information)
        unbent, fit = swept, self._best(swept.scan, starts, prior, 0.0)
        if fit.share < self.config.good_share and again is not None:
            unbent = again(velocity)
            fit = self._best(unbent.scan, starts, prior, 0.0)
        if fit.share < self.config.good_share:
            return prediction, (swept, found), np.zeros((3, 3))
        stands, rare = found, 0.0 if self._prior.slips else _RARE  # a slip that was told goes on as likely as not
        if self._is_unsure(found, prediction):
            stands = replace(found, pose=prediction.mean)
            if found.share >= self.config.good_share:
                rare = 0.0  # so far from the wheels that these are as rare
        (_, likely), doubt = likelier(self._submap.lines, self.config.icp, (swept, stands), (unbent, fit), rare)
        self._prior.judge(slips=likely is fit)
        if likely is stands:
            if prediction.step_covariance is not None:
                prediction = replace(prediction, step_covariance=prediction.step_covariance + doubt)
            return prediction, (swept, found), doubt
        return other, (unbent, fit), doubt

    def _swept_again(
        self, swept: SweptScan, prediction: Prediction, found: Registration, again: Callable[[Array], SweptScan]
    ) -> tuple[Registered, Array]:
        """The scan and its registration, by the sweep of the velocity that was found if that fits the walls better; and
        the covariance ``(3, 3)`` by which the other sweep may be right."""
        assert self._stamp_ns is not None
        elapsed_s = (swept.scan.stamp_ns - self._stamp_ns) * 1e-9
        velocity = swept.velocity(between(self._pose, found.pose), elapsed_s)
        off = swept.off(velocity)
        if off @ np.linalg.solve(turned_covariance(-self._pose[2], found.covariance), off) < _SWEEP_DEVIATIONS**2:
            return (swept, found), np.zeros((3, 3))
        other = again(velocity)
        prior = (prediction.mean, prediction.information)
        open_share = 0.0 if prediction.by_wheels else self.config.open_share
        better = self._best(other.scan, [found.pose, *prediction.starts], prior, open_share)
        if self._is_unsure(better, prediction):
            return (swept, found), np.zeros((3, 3))
        rare = _RARE if prediction.measured else 0.0
        return likelier(self._submap.lines, self.config.icp, (swept, found), (other, better), rare)

    def _begin(self, swept: SweptScan, wheels: WheelOdometry | None) -> ScanEstimate:
        scan = swept.scan
        self._submap.add(scan, self._pose)
        self._stamp_ns = scan.stamp_ns
        self._prior.begin(scan.stamp_ns, self._pose, wheels)
        if wheels is not None:
            wheels.observe_pose(scan.stamp_ns, self._pose)
        zero, none = np.zeros(3), np.zeros((3, 3))
        nothing = np.zeros(len(STEP_EVIDENCE))
        return ScanEstimate(
            scan.stamp_ns, zero, none, zero, zero, none, True, 1.0, False, False, nothing, np.ones(3), swept, none
        )  # fmt: skip

    def _register(self, scan: KeyScan, prediction: Prediction) -> tuple[Registration, Array | None, bool]:
        """The best registration, the covariance of its doubt where there is any, and whether a search was needed."""
        config = self.config
        deviation = np.sqrt(prediction.covariance.diagonal())
        deviation_m = float(max(deviation[0], deviation[1]))
        poor = deviation_m > config.poor_m or deviation[2] > math.radians(config.poor_deg)
        prior = (prediction.mean, prediction.information)
        starts = list(prediction.starts)
        open_share = 0.0 if prediction.by_wheels else config.open_share
        on_lines = scan.points[(scan.normals != 0.0).any(axis=1)]
        if poor:
            window = (
                min(config.search_deviations * deviation_m, config.largest_window_m),
                min(config.search_deviations * float(deviation[2]), math.radians(config.largest_window_deg)),
            )
            starts.append(search(self._submap.field, on_lines, starts[0], prior, window)[0])
        best = self._best(scan, starts, prior, open_share)
        lost = best.share < config.good_share or (not prediction.by_wheels and deviation_m > config.wide_m)
        unlike = not prediction.by_wheels and best.share < config.sure_share and deviation_m <= config.poor_m
        if not (lost or unlike) or len(on_lines) < config.least_points:
            return best, None, poor
        place = wide_place(
            config.wide, self._submap.grid(config.wide.search), on_lines, prior, deviation_m, best.pose
        )  # fmt: skip
        if place is None:
            return best, None, lost or poor
        if place.better:
            if not prediction.moved:
                # Nothing measured this motion, and it led to no fit.
                prior = (place.pose, np.diag((1.0, 1.0, 1.0)))
            again = self._best(scan, [place.pose], prior, open_share)
            more = 0.0 if lost else config.better_share
            if again.share > best.share + more and not self._is_unsure(again, prediction):
                best, lost = again, True
        return best, None if prediction.measured or not lost else place.doubt, lost or poor

    def _covariance_of(self, found: Registration, prediction: Prediction, searched: bool) -> Array:
        """The registration's covariance; that of two places where it may as well be the predicted one."""
        if prediction.by_wheels or not searched or found.share >= self.config.sure_share:
            return found.covariance
        away = found.pose - prediction.mean
        away[2] = wrap(away[2])
        return 0.5 * (found.covariance + prediction.covariance + np.outer(away, away))

    def _best(self, scan: KeyScan, starts: list[Array], prior: tuple[Array, Array], open_share: float) -> Registration:
        """The registration, among those from all starts, that fits most points."""
        best = self._icp(scan, starts[0], prior, open_share)
        for start in starts[1:]:
            other = self._icp(scan, start, prior, open_share)
            if other.share > best.share + 0.02:
                best = other
        return best

    def _icp(self, scan: KeyScan, start: Array, prior: tuple[Array, Array], open_share: float) -> Registration:
        mean, information = prior
        found = icp(self._submap.lines, scan.points, scan.normals, start, prior, self.config.icp, open_share)
        far = squared_deviations(found.pose, mean, information)
        if found.share >= self.config.good_share and far > 9.0:
            # Scans that fit, far from the prior: wheels that slipped or froze must not pull.
            found = icp(
                self._submap.lines, scan.points, scan.normals, found.pose, (mean, information * 9.0 / far),
                self.config.icp, open_share,
            )  # fmt: skip
        return found

    def _is_unsure(self, found: Registration, prediction: Prediction) -> bool:
        config = self.config
        if found.share < config.least_share or found.fitted < config.least_points:
            return True
        far = squared_deviations(found.pose, prediction.mean, prediction.information) > config.farthest_deviations**2
        return far and found.share < (config.sure_share if prediction.measured else config.good_share)

    def _accept(
        self,
        swept: SweptScan,
        wheels: WheelOdometry | None,
        prediction: Prediction,
        pose: Array,
        covariance: Array,
        found: Registration,
        searched: bool,
        unsure: bool,
        sweep_doubt: Array,
    ) -> ScanEstimate:
        assert self._stamp_ns is not None
        scan = swept.scan
        step, since_key = between(self._pose, pose), between(self._key, pose)
        both = covariance + self._covariance
        if prediction.step_covariance is not None:
            # Both poses share the errors of the submap, and of the prior where the walls say nothing.
            both = fused_covariance(both, prediction.step_covariance)
        distance_m, turn_rad = self.config.key_distance_m, math.radians(self.config.key_turn_deg)
        passed = between(self._passed, pose)
        passes = math.hypot(passed[0], passed[1]) >= distance_m or abs(passed[2]) >= turn_rad
        if not (prediction.by_wheels or prediction.standing) and found.share < self.config.known_share:
            # It may have come as far along a corridor, where only the next key scan holds what comes into view.
            passes = passes or math.sqrt(max(covariance[0, 0], covariance[1, 1])) >= distance_m
        # Where the robot may be elsewhere, nobody knows what it would see.
        certain = float(max(covariance[0, 0], covariance[1, 1])) < self.config.poor_m**2
        is_key = passes and not (certain and self._submap.knows(scan, pose, self.config.known_m, turn_rad))
        evidence = step_evidence(since_key, found, prediction, searched, unsure)
        factors = np.ones(3) if self._scaling is None else self._scaling.factors(evidence)
        turned = turned_covariance(-self._pose[2], both)
        shared = self._prior.accept(scan.stamp_ns, pose, covariance, step, turned, passes, is_key, unsure)
        estimate = ScanEstimate(
            scan.stamp_ns,
            step,
            turned * np.outer(factors, factors),
            pose,
            since_key,
            turned_covariance(-self._key[2], covariance + shared),
            is_key,
            found.share,
            searched,
            unsure,
            evidence,
            factors,
            swept,
            turned_covariance(-pose[2], sweep_doubt),
        )
        self._pose, self._covariance, self._stamp_ns = pose, covariance, scan.stamp_ns
        if passes:
            self._passed = pose
        if is_key:
            self._key, self._covariance = pose, np.zeros((3, 3))
            self._submap.add(scan, pose)
        return estimate
