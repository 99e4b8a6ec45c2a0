"""The local estimator of a 2D lidar: a mixture of hypotheses, a search over all of them, registration, segments.

Each scan is searched in the last key scans, under the mixture as its prior. The two best modes are registered; the
second widens the covariance. A scan that fits nowhere follows the likeliest hypothesis, and after a while begins a new
segment with an empty submap: what is not known bends nothing.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.motion_mixture import MotionMixture
from ngo_estimator.frontend.lidar.rolling_submap import RollingSubmap
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.mode_search import Mixture, SearchWindow, two_modes
from ngo_estimator.geometry.planar_motion import (
    Array,
    between,
    compose,
    inverted,
    propagated,
    squared_deviations,
    transformed,
    turned_covariance,
    wrap,
)
from ngo_estimator.geometry.scan_matching import IcpConfig, Registration, icp

_FAR = 9.0
"""Squared deviations beyond which a prior counts less."""

_BROAD = 0.15
"""Deviation (m, rad) of the prior under which a mode is registered first."""

_FEWEST = 12
"""Points without which a scan does not contradict what was seen."""


@dataclass(frozen=True, eq=False)
class ScanEstimate:
    """Where a scan was taken.

    ``step`` ``(3,)`` is its pose seen from the last scan, with ``step_covariance``; ``pose`` ``(3,)`` that in ``odom``;
    ``since_key`` ``(3,)`` that seen from the last key scan, with ``since_key_covariance``. ``score`` is how well it
    fits, 0 to 1. ``unsure`` scans fitted nowhere. With ``segment`` nothing ties the scan to those before. Of a key scan
    ``walls`` ``(n,)`` tells which points are on walls.
    """

    step: Array
    step_covariance: Array
    pose: Array
    since_key: Array
    since_key_covariance: Array
    is_key: bool
    score: float
    unsure: bool
    segment: bool
    walls: NDArray[np.bool_] | None = None


@dataclass(frozen=True, eq=False)
class _Mode:
    pose: Array
    covariance: Array
    variance: Array  # of the walls alone: position, heading
    score: float
    total: float
    fitted: int


class MixtureOdometry:
    """Takes scans one by one, and estimates each as it comes; bounded memory."""

    def __init__(self, config: MixtureConfig) -> None:
        self.config = config
        self.mixture = MotionMixture(config)
        self._submap = RollingSubmap(config.submap_scans, config.cells)
        self._pose, self._covariance = np.zeros(3), np.zeros((3, 3))
        self._key = np.zeros(3)
        self._reckoned = np.zeros(2)  # way and turn since a scan fitted
        self._usual = 0.0
        last = config.icp
        self._last_steps = replace(
            last, annealing_steps=1, first_kernel_m=last.last_kernel_m, first_gate_m=last.last_gate_m
        )

    def begin(self, scan: KeyScan) -> None:
        """Take the first scan, which is a key scan at the origin."""
        self._submap.add(scan, self._pose)

    def update(
        self, scan: KeyScan, by_wheels: Array | None, counted: Array | None, gap: float, silent: bool
    ) -> ScanEstimate:
        """Estimate where a scan was taken.

        Args:
            scan: newer than the last one.
            by_wheels: motion ``(3,)`` since then by the calibrated wheels; None where they were silent.
            counted: the same as the wheels counted it.
            gap: time since then in usual periods.
            silent: neither scans nor wheels told anything for so long that the robot may be anywhere.
        """
        self.mixture.foretell(by_wheels, counted, gap)
        points = _on_lines(scan, self.config.search_points)
        found = None if silent else self._found(scan, points)
        lost = found is None
        if found is None:
            (pose, covariance), score = self._foretold(), 0.0
        else:
            pose, covariance, score = found.pose, found.covariance, found.score
        step = between(self._pose, pose)
        self._reckoned = self._reckoned + (math.hypot(step[0], step[1]), abs(step[2])) if lost else np.zeros(2)
        segment = silent or bool((self._reckoned > (self.config.lost_m, self.config.lost_rad)).any())
        if found is not None:
            self.mixture.learn(step, found.variance)
            rate = min(0.1, math.hypot(step[0], step[1]) + abs(step[2])) if self._usual else 1.0
            self._usual += rate * (score - self._usual)
        return self._accepted(scan, pose, covariance, score, lost, segment, silent)

    def _accepted(
        self, scan: KeyScan, pose: Array, covariance: Array, score: float, lost: bool, segment: bool, silent: bool
    ) -> ScanEstimate:
        config = self.config
        if segment:
            covariance = covariance * config.doubted**2
            if silent:
                covariance = covariance + np.diag((config.open_m**2, config.open_m**2, config.open_rad**2))
            self._submap.clear()
            self._reckoned = np.zeros(2)
        step, since_key = between(self._pose, pose), between(self._key, pose)
        both = covariance + self._covariance
        key_way, key_turn = math.hypot(since_key[0], since_key[1]), abs(since_key[2])
        far = max(key_way / config.key_m, key_turn / math.radians(config.key_deg))
        is_key = segment or (not lost and (far >= 1.0 or (far > 0.3 and score < config.new_share * self._usual)))
        estimate = ScanEstimate(
            step,
            turned_covariance(-self._pose[2], both),
            pose,
            since_key,
            turned_covariance(-self._key[2], covariance),
            is_key,
            score,
            lost,
            segment,
        )
        self._pose, self._covariance = pose, covariance
        if is_key:
            self._key, self._covariance = pose, np.zeros((3, 3))
            self._submap.add(scan, pose)
            estimate = replace(estimate, walls=self._submap.walls(transformed(pose, scan.points)))
        return estimate

    def _foretold(self) -> tuple[Array, Array]:
        """Pose and covariance by the likeliest hypothesis."""
        heaviest = self.mixture.heaviest
        step = self.mixture.steps[heaviest]
        pose = compose(self._pose, step)
        return pose, propagated(self._covariance, pose, step, self.mixture.step_covariance(heaviest))

    def _found(self, scan: KeyScan, points: Array) -> _Mode | None:
        """The best mode, with the doubt that the second one leaves; None where the scan fits nowhere."""
        config = self.config
        if not len(points):
            return None
        prior = self.mixture.prior(self._pose, self._covariance, (config.least_m, config.least_rad))
        # A score is a mean: of few points it says less.
        weight = config.prior_weight * config.search_points / min(len(points), config.search_points)
        for wide in (False, True):
            modes = two_modes(
                self._submap.field, points, self._window(prior, wide), prior, weight,
                (config.apart_m, math.radians(config.apart_deg)), config.margin * weight,
            )  # fmt: skip
            fits = sorted(
                (self._fit(scan, points, pose, prior, weight) for pose, _ in modes), key=lambda fit: -fit.total
            )
            # Few points contradict nothing: the prior decides.
            if fits and (fits[0].score >= config.lost_share * self._usual or len(points) < _FEWEST):
                return _doubted(fits, weight)
        return None

    def _window(self, prior: Mixture, wide: bool) -> SearchWindow:
        config = self.config
        centre = prior.means[int(prior.log_weights.argmax())].copy()
        most_m, most_rad = config.most_window_m, math.radians(config.most_window_deg)
        if wide:
            return SearchWindow(centre, most_m, most_rad, math.radians(config.heading_step_deg))
        off = prior.means - centre
        turn = np.abs((off[:, 2] + math.pi) % (2.0 * math.pi) - math.pi)
        reach = 2.0 * prior.deviations[:-1] if len(prior.means) > 1 else prior.deviations
        metres = float((np.abs(off[:-1, :2]).max(axis=1) + reach[:, 0]).max())
        radians = float((turn[:-1] + reach[:, 1]).max())
        return SearchWindow(
            centre,
            min(max(metres, config.least_window_m), most_m),
            min(max(radians, math.radians(config.least_window_deg)), most_rad),
            math.radians(config.heading_step_deg),
        )

    def _fit(self, scan: KeyScan, points: Array, pose: Array, prior: Mixture, weight: float) -> _Mode:
        """A mode, registered under the hypothesis that is likeliest there."""
        broad_mean = prior.means[int(prior.logs(pose).argmax())]
        broad = np.diag(np.full(3, _BROAD**-2))
        far = _FAR / max(squared_deviations(pose, broad_mean, broad), 1e-9)
        near = self._icp(scan, pose, broad_mean, broad * min(1.0, far), self.config.icp)
        walls = inverted(near.information + np.diag((1.0, 1.0, 1.0)))
        sharp = self.mixture.prior(self._pose, self._covariance + walls, (0.0, 0.0))
        likeliest = self.mixture.likeliest(near.pose, sharp)
        step = self.mixture.steps[likeliest]
        mean = compose(self._pose, step)
        covariance = propagated(self._covariance, mean, step, self.mixture.step_covariance(likeliest))
        squared = squared_deviations(near.pose, mean, inverted(covariance + walls))
        information = inverted(covariance) * min(1.0, _FAR / max(squared, 1e-9))
        found = self._icp(scan, near.pose, mean, information, self._last_steps)
        score = self._submap.field.score(points, found.pose)
        total = score + weight * float(prior.logs(found.pose).max())
        variance = np.array((0.5 * (walls[0, 0] + walls[1, 1]), walls[2, 2]))
        return _Mode(found.pose, found.covariance, variance, score, total, found.fitted)

    def _icp(self, scan: KeyScan, start: Array, mean: Array, information: Array, config: IcpConfig) -> Registration:
        return icp(self._submap.lines, scan.points, scan.normals, start, (mean, information), config)


def _on_lines(scan: KeyScan, most: int) -> Array:
    points = scan.points[(scan.normals != 0.0).any(axis=1)]
    if len(points) < 2 * _FEWEST:
        points = scan.points
    return points[:: max(1, math.ceil(len(points) / most))]


def _doubted(fits: list[_Mode], weight: float) -> _Mode:
    """The best mode with the covariance of all: a total is ``weight`` times a log likelihood."""
    best = fits[0]
    covariance = best.covariance
    for other in fits[1:]:
        share = 1.0 / (1.0 + math.exp(min((best.total - other.total) / weight, 50.0)))
        away = other.pose - best.pose
        away[2] = wrap(away[2])
        covariance = covariance + share * np.outer(away, away)
    return _Mode(best.pose, covariance, best.variance, best.score, best.total, best.fitted)
