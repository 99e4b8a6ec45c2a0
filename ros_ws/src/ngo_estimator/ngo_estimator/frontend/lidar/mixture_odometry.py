"""The local estimator of a 2D lidar: a mixture of hypotheses, a search over all of them, registration, segments.

Each scan is registered to the last key scans under each hypothesis, from where that has it, and searched there under
the mixture as its prior. What the search finds must fit better by more than a score's noise. Other modes widen the
covariance. Where walls leave a direction open, the likeliest hypothesis is followed. A scan that fits nowhere is dead
reckoned, and after a while begins a new segment with an empty submap: what is not known bends nothing.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.frontend.lidar.motion_mixture import ANY, MotionMixture
from ngo_estimator.frontend.lidar.rolling_submap import RollingSubmap
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.mode_search import Mixture, two_modes
from ngo_estimator.geometry.planar_motion import (
    Array,
    between,
    inverted,
    squared_deviations,
    transformed,
    turned_covariance,
    wrap,
)
from ngo_estimator.geometry.scan_matching import IcpConfig, Registration, icp
from ngo_estimator.geometry.score_profile import held_along

_FAR = 9.0
"""Squared deviations beyond which a prior counts less."""

_BROAD = 0.5
"""Deviation of the prior under which a mode of the search is registered, as a part of that of anything."""

_UNKNOWN = np.eye(3)
"""Information without which the walls may leave a direction open."""

_OPEN_SHARE = 1e-6
"""Mean squared slope of the lines below which a direction is open; what normals agree on counts, however little."""

_LEAST_WEIGHT = 0.1
"""Of the prior, where each scan fits: the walls of simulators are perfect, and what follows is not."""

LIKELY, ANYWHERE, EVERYWHERE = range(3)
"""Windows of the search: what hypotheses say, anything too, and as far as it is looked."""

_FIRST_USUAL = 0.9
"""Score that is expected of the first match."""

_FEWEST = 12
"""Points without which a scan does not contradict what was seen."""

_LEAST = np.diag((1e-8, 1e-8, 1e-9))
"""The smallest covariance of a step."""


@dataclass(frozen=True, eq=False)
class _Mode:
    found: Registration
    hypothesis: int
    score: float
    total: float

    @property
    def pose(self) -> Array:
        return self.found.pose

    @property
    def walls(self) -> Array:
        """Covariance by the walls alone."""
        return inverted(self.found.information + _UNKNOWN)


class MixtureOdometry:
    """Takes scans one by one, and estimates each as it comes; bounded memory."""

    def __init__(self, config: MixtureConfig) -> None:
        self.config = config
        self.mixture = MotionMixture(config)
        self._submap = RollingSubmap(config.submap_scans, config.cells)
        self._pose, self._covariance = np.zeros(3), np.zeros((3, 3))
        self._key = np.zeros(3)
        self._reckoned = np.zeros(2)  # way and turn since a scan fitted
        self._usual = 0.0  # score, once a scan was matched
        self._doubt = self._doubted_key = np.zeros((3, 3))  # that other modes leave: of this scan, of a last key scan
        self._same = config.cells.cell_m, math.radians(config.heading_step_deg)  # poses closer than this are one
        last = config.icp
        self._last_steps = replace(
            last, annealing_steps=1, first_kernel_m=last.last_kernel_m, first_gate_m=last.last_gate_m
        )

    def begin(self, scan: KeyScan) -> None:
        """Take the first scan, which is a key scan at the origin."""
        self._submap.add(scan, self._pose)
        self._origin: KeyScan | None = scan
        self._origin_ns = self._last_ns = self._key_ns = scan.stamp_ns

    def update(
        self,
        scan: KeyScan,
        by_wheels: Array | None,
        counted: Array | None,
        gap: float,
        silent: bool,
        again: Callable[[Array], KeyScan | None] | None = None,
    ) -> RelativeStep:
        """The step to a scan.

        Args:
            scan: newer than the last one.
            by_wheels: motion ``(3,)`` since then by the calibrated wheels; None where they were silent.
            counted: the same as the wheels counted it.
            gap: time since then in usual periods.
            silent: neither scans nor wheels told anything for so long that the robot may be anywhere.
            again: gives the scan without the sweep of another motion ``(3,)`` since then; None where that is much the
                same.
        """
        self.mixture.foretell(float(self._pose[2]), by_wheels, counted, gap)
        found = None if silent else self._found(scan)
        if found is not None and again is not None:
            scan, found = self._swept_again(scan, found, again)
        config, before = self.config, self._pose
        if found is None:
            pose, covariance = self.mixture.foretold(before, self._covariance)
            self.mixture.take(self.mixture.heaviest, before, pose, covariance, None)
            segment = silent or self._is_gone(pose, covariance)
            if segment:  # further away than it was looked for
                metres = 2.0 * config.most_window_m
                covariance = covariance + np.diag((metres**2, metres**2, math.pi**2))
                self._submap.clear()
                self._reckoned, self._doubt = np.zeros(2), np.zeros((3, 3))
            return self._accepted(scan, pose, covariance, True, segment)
        step, walls = between(before, found.pose), turned_covariance(-before[2], found.walls)
        covariance = found.found.covariance
        self.mixture.learn(step, walls)
        self.mixture.take(found.hypothesis, before, found.pose, covariance, walls)
        self._reckoned = np.zeros(2)
        rate = min(0.1, math.hypot(step[0], step[1]) + abs(step[2])) if self._usual else 1.0
        self._usual += rate * (found.score - self._usual)
        return self._accepted(scan, found.pose, covariance)

    def _is_gone(self, pose: Array, covariance: Array) -> bool:
        """Whether too much was dead reckoned to go on: by its way and turn, or by the deviation of where it led."""
        step = between(self._pose, pose)
        self._reckoned = self._reckoned + (math.hypot(step[0], step[1]), abs(step[2]))
        deviations = np.sqrt((0.5 * (covariance[0, 0] + covariance[1, 1]), covariance[2, 2]))
        return bool((np.maximum(self._reckoned, deviations) > self.config.lost).any())

    def _swept_again(
        self, scan: KeyScan, found: _Mode, again: Callable[[Array], KeyScan | None]
    ) -> tuple[KeyScan, _Mode]:
        """The scan without the motion that its match tells, registered again, where that fits as well."""
        other = again(between(self._pose, found.pose))
        if other is None:
            return scan, found
        few = _on_lines(other, self.config.search_points)
        if not len(few.points):
            return scan, found
        refound = self._sharpened(other, few, self._fit(few, ANY, found.pose, self._weight(few.points)))
        refound = _widened(refound, self._doubt)
        return (other, refound) if refound.score >= found.score else (scan, found)

    def _accepted(
        self, scan: KeyScan, pose: Array, covariance: Array, unsure: bool = False, segment: bool = False
    ) -> RelativeStep:
        """The step to a scan of a pose ``(3,)`` and its ``covariance``."""
        config, last, key = self.config, self._pose, None
        step_covariance = turned_covariance(-last[2], covariance + self._covariance) + _LEAST
        self._pose, self._covariance, since_key = pose, covariance, between(self._key, pose)
        key_way, key_turn = math.hypot(since_key[0], since_key[1]), abs(since_key[2])
        far = max(key_way / config.key_m, key_turn / math.radians(config.key_deg))
        self._doubted_key = np.zeros((3, 3))
        if segment or (not unsure and far >= 1.0):
            shared = turned_covariance(-self._key[2], covariance + self.mixture.filter.shared()) + _LEAST
            self._submap.add(scan, pose)
            walls = self._submap.walls(transformed(pose, scan.points))
            seen = replace(scan, points=scan.points[walls], normals=scan.normals[walls])
            key = KeyScanStep(seen, self._key_ns, since_key, shared)
            self._key, self._key_ns, self._doubted_key = pose, scan.stamp_ns, self._doubt
            self._covariance = np.zeros((3, 3))
            self.mixture.filter.begin_at_key()
        nothing = np.zeros(0, np.float32)
        step = RelativeStep(
            stamp_ns=scan.stamp_ns,
            from_stamp_ns=self._last_ns,
            relative_xyyaw=between(last, pose),
            covariance=step_covariance,
            origin_stamp_ns=self._origin_ns,
            odom_xyyaw=pose,
            motion_feature=nothing,
            place_code=nothing,
            unsure=unsure,
            key=key,
            origin_scan=self._origin,
            segment=segment,
        )
        self._last_ns, self._origin = scan.stamp_ns, None
        return step

    def _prior(self, walls: Array | None, wide: bool = False) -> Mixture:
        """The prior of where the place is chosen, as ``walls`` ``(3, 3)`` would measure it; ``wide`` where no place
        that it has likely fits.

        A key scan is where the next ones count from, but its place among those before it is as doubtful as it was.
        """
        least = self.config.least, self.config.least
        prior = self.mixture.prior(self._pose, self._covariance + self._doubted_key, walls, least)
        if not wide:
            return prior
        return prior.widened(0.5 * self.config.most_window_m, 0.5 * math.pi, not self.mixture.trusts_wheels)

    def _weight(self, points: Array) -> float:
        """Weight of a log likelihood against a score, which is a mean: of few points it says less, but neighbouring
        points share their errors. Where scans usually fit well, a point that does not says more."""
        config = self.config
        misfit = 1.0 - self._usual if self._usual else 1.0
        sure = min(max(misfit / config.usual_misfit, _LEAST_WEIGHT), 1.0)
        return config.prior_weight * sure * self._fewer(points)

    def _fewer(self, points: Array) -> float:
        """How much less few points say than as many as are searched with."""
        most = self.config.search_points
        return math.sqrt(most / min(len(points), most))

    def _found(self, scan: KeyScan) -> _Mode | None:
        """The best mode, with the doubt that others leave; None where the scan fits nowhere.

        Modes are those near the means of the hypotheses, and the two best of the search where these are others.
        """
        config = self.config
        few, step_rad = _on_lines(scan, config.search_points), math.radians(config.heading_step_deg)
        points = few.points
        if not len(points):
            return None
        weight, starts = self._weight(points), self._starts()
        for reach in (LIKELY, ANYWHERE, EVERYWHERE):
            wide = reach == EVERYWHERE
            if reach != ANYWHERE:  # there only the window of the search is another one
                prior, begun = self._prior(None, wide), [self._fit(few, k, None, weight, wide) for k in starts]
            fits = begun.copy()
            for pose, _ in two_modes(
                self._submap.field, points, *self._window(prior, reach), step_rad, prior, weight,
                (config.apart_m, math.radians(config.apart_deg)), config.margin * weight,
            ):  # fmt: skip
                if not any(self._is_same(pose, other.pose) for other in fits):
                    fit = self._fit(few, ANY, pose, weight, wide)
                    fits.append(replace(fit, total=fit.total - config.noise * weight))
            fits.sort(key=lambda fit: -fit.total)
            best = fits[0]
            enough = reach != LIKELY or self.mixture.trusts_wheels
            if best.score >= config.new_share * self._expected_score or (enough and self._fits(points, best.pose)):
                return self._doubted([self._sharpened(scan, few, best), *fits[1:]], weight)
        return None

    @property
    def _expected_score(self) -> float:
        return self._usual or _FIRST_USUAL

    def _fits(self, points: Array, pose: Array) -> bool:
        """Whether those of the points that lie where something was seen fit; few contradict nothing."""
        least = self.config.lost_share * self._expected_score
        known = self._submap.field.scores(points, pose[None], least)[0]
        return len(points) < _FEWEST or bool(known > least + 1e-6)  # rounding

    def _doubted(self, fits: list[_Mode], weight: float) -> _Mode:
        """The first mode with the covariance of all: a score is ``weight`` times a log likelihood."""
        self._doubt = np.zeros((3, 3))
        modes: list[_Mode] = []
        for fit in fits:
            if not any(self._is_same(fit.pose, mode.pose) for mode in modes):
                modes.append(fit)
        if len(modes) == 1:
            return modes[0]
        logs = np.array([mode.score / weight + self._prior(mode.walls).logs(mode.pose).max() for mode in modes])
        likelihoods = np.exp(np.minimum(logs - logs[0], 0.0))
        for mode, share in zip(modes[1:], likelihoods[1:] / likelihoods.sum(), strict=True):
            away = mode.pose - modes[0].pose
            away[2] = wrap(away[2])
            self._doubt = self._doubt + share * np.outer(away, away)
        return _widened(modes[0], self._doubt)

    def _is_same(self, a: Array, b: Array) -> bool:
        return bool(_near(a, b, *self._same))

    def _starts(self) -> list[int]:
        """The hypotheses but anything, without those that say no more than one before."""
        mixture = self.mixture
        usable, deviations = np.array(mixture.usable[:-1], dtype=int), mixture.deviations
        distinct: list[int] = usable[_distinct(mixture.steps[usable], deviations[usable], *self._same)].tolist()
        return distinct

    def _window(self, prior: Mixture, reach: int) -> tuple[Array, tuple[float, float]]:
        """The middle ``(3,)`` of the search, and how far it goes to each side (m, rad)."""
        config, most = self.config, (self.config.most_window_m, math.pi)
        centre = prior.means[int(prior.log_weights.argmax())].copy()
        if reach == EVERYWHERE:
            return centre, most
        last = len(prior.means) - (reach == LIKELY)
        metres, radians = _reach(prior.means[:last], prior.deviations[:last], centre)
        least = 1.5 * config.apart_m, 1.5 * math.radians(config.apart_deg)  # or no second mode is seen
        return centre, (min(max(metres, least[0]), most[0]), min(max(radians, least[1]), most[1]))

    def _fit(self, few: KeyScan, hypothesis: int, start: Array | None, weight: float, wide: bool = False) -> _Mode:
        """A mode, registered under a hypothesis from where that has it, or from ``start`` ``(3,)``."""
        mean, covariance = self.mixture.expected(hypothesis, self._pose, self._covariance)
        if start is None:
            start, information = mean, inverted(covariance)
        else:
            metres, radians = _BROAD * self.mixture.deviations[ANY]
            broad = np.diag((metres**-2, metres**-2, radians**-2))
            information = broad * min(1.0, _FAR / max(squared_deviations(start, mean, broad), 1e-9))
        found = self._icp(few, start, mean, information, self.config.icp)
        # Along a direction that walls leave open a hypothesis counts by its weight, however sure it is.
        mode = _Mode(found, hypothesis, self._submap.field.score(few.points, found.pose), 0.0)
        return replace(mode, total=mode.score + weight * self._prior(mode.walls, wide).logs(found.pose).max())

    def _sharpened(self, scan: KeyScan, few: KeyScan, mode: _Mode) -> _Mode:
        """A mode of the ``few`` points, registered with all of the scan's under the hypothesis that is likeliest."""
        mixture, walls = self.mixture, mode.walls
        likeliest = mixture.likeliest(mode.pose, mixture.prior(self._pose, self._covariance, walls, (0.0, 0.0)))
        mean, covariance = mixture.expected(likeliest, self._pose, self._covariance)
        squared = squared_deviations(mode.pose, mean, inverted(covariance + walls))
        information = inverted(covariance) * min(1.0, _FAR / max(squared, 1e-9))
        found = self._icp(scan, mode.pose, mean, information, self._last_steps)
        weight = self.config.prior_weight * self._fewer(few.points)
        found = held_along(found, self._submap.field, few.points, self._usual, self.config.noise, weight)
        return _Mode(found, likeliest, self._submap.field.score(few.points, found.pose), mode.total)

    def _icp(self, scan: KeyScan, start: Array, mean: Array, information: Array, config: IcpConfig) -> Registration:
        return icp(self._submap.lines, scan.points, scan.normals, start, (mean, information), config, _OPEN_SHARE)


def _widened(mode: _Mode, doubt: Array) -> _Mode:
    """A mode with ``doubt`` ``(3, 3)`` in its covariance."""
    return replace(mode, found=replace(mode.found, covariance=mode.found.covariance + doubt))


@njit(cache=True)
def _near(a: Array, b: Array, metres: float, radians: float) -> bool:
    off = between(a, b)
    return math.hypot(off[0], off[1]) < metres and abs(off[2]) < radians


@njit(cache=True)
def _distinct(steps: Array, deviations: Array, metres: float, radians: float) -> NDArray[np.bool_]:
    """Which steps ``(n, 3)`` with their deviations ``(n, 2)`` say more than one before."""
    result = np.ones(len(steps), np.bool_)
    for k in range(len(steps)):
        for i in range(k):
            if result[i] and _near(steps[k], steps[i], metres, radians):
                result[k] = result[k] and not (deviations[k] < 2.0 * deviations[i]).all()
    return result


@njit(cache=True)
def _reach(means: Array, deviations: Array, centre: Array) -> tuple[float, float]:
    """Half a window (m, rad) that covers hypotheses to two deviations."""
    metres, radians = 0.0, 0.0
    for k in range(len(means)):
        off = max(abs(means[k, 0] - centre[0]), abs(means[k, 1] - centre[1]))
        metres = max(metres, off + 2.0 * deviations[k, 0])
        radians = max(radians, abs(wrap(means[k, 2] - centre[2])) + 2.0 * deviations[k, 1])
    return metres, radians


def _on_lines(scan: KeyScan, most: int) -> KeyScan:
    """At most so many of a scan's points, of those on lines where these are enough."""
    kept = np.flatnonzero((scan.normals[:, 0] != 0.0) | (scan.normals[:, 1] != 0.0))
    if len(kept) < 2 * _FEWEST:
        kept = np.arange(len(scan.points))
    kept = kept[:: max(1, math.ceil(len(kept) / most))]
    return replace(scan, points=scan.points[kept], normals=scan.normals[kept])
