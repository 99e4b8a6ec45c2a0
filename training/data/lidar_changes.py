"""What real robots do to the data of their lidar and wheels, as seeded changes of a drive.

A change touches what an estimator is given. When a scan was taken, and where the robot was then, stays with the scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ngo_estimator.geometry.planar_motion import all_between
from ngo_estimator.geometry.scan_points import Mounting
from training.data.sensor_log import SensorLog

Change = Callable[[SensorLog, np.random.Generator], SensorLog]

_S = 1_000_000_000
_MS = 1_000_000
_MOVES_M = 1e-3  # a step of the wheels that is longer shows that the robot drives
_AFTER_S, _BEFORE_END_S = 30, 60  # events lie this far from both ends, so that they end within the drive


def changed(log: SensorLog, name: str, seed: int) -> SensorLog:
    """The log after the change of this name in ``CHANGES``: the same for the same seed.

    Raises:
        ValueError: there is no such change, or the drive is too short for it.
    """
    if name not in CHANGES:
        raise ValueError(f"the change is {name!r}; expected one of {', '.join(CHANGES)}")
    return CHANGES[name](log, np.random.default_rng(seed)).in_order()


def clean(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Nothing happens."""
    return log


def scans_bunched(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Scans are stamped on arrival, and half of the time they arrive in bunches of 0.3 to 1.8 s."""
    return replace(log, stamps_ns=_bunched_ns(log.stamps_ns, rng))


def wheels_bunched(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Wheel poses are stamped on arrival, in bunches of 0.3 to 1.8 s."""
    return replace(log, wheel_stamps_ns=_bunched_ns(log.wheel_stamps_ns, rng))


def both_bunched(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Scans and wheel poses are stamped on arrival, each in bunches of their own."""
    return wheels_bunched(scans_bunched(log, rng), rng)


def both_bunched_short(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The same with bunches of 0.3 to 0.6 s."""
    stamps_ns = _bunched_ns(log.stamps_ns, rng, 0.6)
    return replace(log, stamps_ns=stamps_ns, wheel_stamps_ns=_bunched_ns(log.wheel_stamps_ns, rng, 0.6))


def stamps_jitter(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Stamps of scans are wrong by 30 ms (standard deviation), still in order."""
    off_ns = (0.03 * _S * rng.normal(size=len(log.stamps_ns))).astype(np.int64)
    return replace(log, stamps_ns=_increasing(np.sort(log.stamps_ns + off_ns)))


def one_scan_in_ten(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Nine of ten scans are lost, at random."""
    return log.keep_scans(rng.random(len(log.stamps_ns)) > 0.9)


def no_scans_for_10s(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Scans are missing for 10 s, eight times, while the robot drives on."""
    return log.keep_scans(~_within(log.stamps_ns, _moments_ns(log, rng, 8), 10))


def wheels_silent_for_10s(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Wheel poses are missing for 10 s, eight times."""
    return log.keep_wheels(~_within(log.wheel_stamps_ns, _moments_ns(log, rng, 8), 10))


def carried_while_paused(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Scans and wheel poses are missing for 20 s, three times, and the wheels do not count the way meanwhile."""
    moments_ns = _moments_ns(log, rng, 3)
    missing = _within(log.wheel_stamps_ns, moments_ns, 20)
    heard = log.keep_scans(~_within(log.stamps_ns, moments_ns, 20)).keep_wheels(~missing)
    follows = np.diff(np.flatnonzero(~missing)) == 1
    return heard.with_wheel_steps(heard.wheel_steps * follows[:, None])


def wheels_lose_5s(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The wheels do not count for 5 s, eight times."""
    lost = _within(log.wheel_stamps_ns[1:], _moments_ns(log, rng, 8), 5)
    return log.with_wheel_steps(log.wheel_steps * ~lost[:, None])


def wheels_begin_anew(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The wheels' pose begins at zero again, five times."""
    poses = log.wheel_poses.copy()
    for first in np.searchsorted(log.wheel_stamps_ns, _moments_ns(log, rng, 5)):
        poses[first:] = all_between(poses[first : first + 1], poses[first:])
    return replace(log, wheel_poses=poses)


def wheels_spin(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The wheels count a metre within 1 s that the robot does not go, eight times."""
    steps, stamps_ns = log.wheel_steps, log.wheel_stamps_ns[1:]
    for moment_ns in _moments_ns(log, rng, 8):
        spinning = _within(stamps_ns, moment_ns, 1)
        steps[spinning, 0] += 1.0 / max(spinning.sum(), 1)
    return log.with_wheel_steps(steps)


def wheels_scale_80(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The wheels count 20 % too little way."""
    return log.with_wheel_steps(log.wheel_steps * (0.8, 0.8, 1.0))


def wheels_turn_wrong_way(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The wheels count turns with the wrong sign."""
    return log.with_wheel_steps(log.wheel_steps * (1.0, 1.0, -1.0))


def range_5m(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Walls farther than 5 m return nothing."""
    return replace(log, ranges=np.where(log.ranges > 5.0, np.float32(np.inf), log.ranges))


def noise_5cm(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Ranges are wrong by 5 cm (standard deviation)."""
    noisy = log.ranges + rng.normal(0.0, 0.05, log.ranges.shape)
    return replace(log, ranges=np.where(log.returned, noisy, log.ranges).astype(np.float32))


def rays_lost(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """40 % of the rays return nothing, at random, and read zero."""
    return replace(log, ranges=np.where(rng.random(log.ranges.shape) < 0.4, np.float32(0.0), log.ranges))


def quarter_of_rays(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The scanner has only each fourth ray."""
    angle, time = 4.0 * log.scanner.angle_increment, 4.0 * log.scanner.time_increment
    coarse = replace(log.scanner, angle_increment=angle, time_increment=time)
    return replace(log, ranges=log.ranges[:, ::4], scanner=coarse)


def half_covered(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The first half of the rays returns nothing."""
    ranges = log.ranges.copy()
    ranges[:, : ranges.shape[1] // 2] = np.inf
    return replace(log, ranges=ranges)


def people(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """Eight people walk along 0.5 to 1.5 m away, each over a twentieth of the view."""
    scans, rays = log.ranges.shape
    begin = rng.uniform(0.0, 1.0, 8)
    sides = (begin + np.cumsum(rng.normal(0.0, 0.01, (scans, 8)), axis=0)) % 1.0  # as shares of the view
    away_m = 1.0 + 0.5 * np.sin(np.arange(scans)[:, None] / 20.0 + 9.0 * sides)
    middle, half = (sides * rays).astype(np.int64), rays // 40
    ranges, ray = np.where(log.returned, log.ranges, np.inf), np.arange(rays)
    seen = np.full_like(ranges, np.inf)
    for person in range(8):
        first = middle[:, person : person + 1] - half
        covered = (ray >= first) & (ray < first + 2 * half)
        seen = np.where(covered, np.minimum(seen, away_m[:, person : person + 1]), seen)
    return replace(log, ranges=np.where(seen < ranges, seen, log.ranges).astype(np.float32))


def mounted_3_deg_off(log: SensorLog, rng: np.random.Generator) -> SensorLog:
    """The mounting says 3 deg too much."""
    turned = log.mounting.sensor_xyyaw + (0.0, 0.0, math.radians(3.0))
    return replace(log, mounting=Mounting(turned, log.mounting.upside_down))


CHANGES: dict[str, Change] = {
    change.__name__: change
    for change in (
        clean,
        scans_bunched,
        wheels_bunched,
        both_bunched,
        both_bunched_short,
        stamps_jitter,
        one_scan_in_ten,
        no_scans_for_10s,
        wheels_silent_for_10s,
        carried_while_paused,
        wheels_lose_5s,
        wheels_begin_anew,
        wheels_spin,
        wheels_scale_80,
        wheels_turn_wrong_way,
        range_5m,
        noise_5cm,
        rays_lost,
        quarter_of_rays,
        half_covered,
        people,
        mounted_3_deg_off,
    )
}
"""By name; the docstring of each says what happens."""

OF_WHEELS = frozenset(name for name in CHANGES if name.startswith("wheels_"))
"""Changes that leave scans and mounting as they are."""

UNSEEDED = frozenset(
    change.__name__
    for change in (
        clean,
        wheels_scale_80,
        wheels_turn_wrong_way,
        range_5m,
        quarter_of_rays,
        half_covered,
        mounted_3_deg_off,
    )
)
"""Changes that are the same for every seed."""


def _bunched_ns(stamps_ns: np.ndarray, rng: np.random.Generator, longest_s: float = 1.8) -> np.ndarray:
    """Stamps of arrival: some stretches of 1 to 4 s arrive in time, others at their end, a millisecond apart."""
    ends, late, at = [], [], int(stamps_ns[0])
    while at < stamps_ns[-1]:
        late.append(rng.random() > 0.5)
        at += int((rng.uniform(0.3, longest_s) if late[-1] else rng.uniform(1.0, 4.0)) * _S)
        ends.append(at)
    stretch = np.searchsorted(ends, stamps_ns, side="right")
    is_late = np.append(late, False)[stretch]  # what comes at the very end is in time
    behind = np.searchsorted(stretch, stretch, side="right") - 1 - np.arange(len(stretch))
    arrived = np.where(is_late, np.append(ends, 0)[stretch] - _MS * behind, stamps_ns)
    return _increasing(np.maximum.accumulate(arrived))


def _increasing(stamps_ns: np.ndarray) -> np.ndarray:
    """Stamps that do not decrease, a nanosecond later each, so that none comes twice."""
    return stamps_ns + np.arange(len(stamps_ns))


def _moments_ns(log: SensorLog, rng: np.random.Generator, count: int) -> np.ndarray:
    """Stamps ``(count,)`` in order at which the robot drives by its wheels."""
    begin_ns = log.wheel_stamps_ns[:-1]
    moves = np.hypot(*np.diff(log.wheel_poses[:, :2], axis=0).T) > _MOVES_M
    after, before = log.wheel_stamps_ns[:1] + _AFTER_S * _S, log.wheel_stamps_ns[-1:] - _BEFORE_END_S * _S
    driving = np.flatnonzero(moves & (begin_ns > after) & (begin_ns < before))
    if len(driving) < count:
        raise ValueError(
            f"the wheels move at {len(driving)} readings between {_AFTER_S} s after the begin and {_BEFORE_END_S} s "
            f"before the end; expected at least {count}"
        )
    return np.asarray(begin_ns[np.sort(rng.choice(driving, count, replace=False))])


def _within(stamps_ns: np.ndarray, moments_ns: np.ndarray, duration_s: int) -> np.ndarray:
    """Which stamps ``(n,)`` lie less than a duration after one of the moments."""
    since_ns = stamps_ns[:, None] - np.atleast_1d(moments_ns)
    return np.asarray(((since_ns > 0) & (since_ns < duration_s * _S)).any(axis=1))
