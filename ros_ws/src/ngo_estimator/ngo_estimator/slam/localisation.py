"""Localisation in a map that stays as it is: relative poses in, the pose in the map out where it is known (no ROS).

A frame is compared with the map wherever the robot has moved enough. Over a rolling window of such frames hypotheses
of the newest pose are put together by odometry. A pose is claimed where hypotheses of several frames agree, and no
other pose has nearly as many. One is enough where the matcher finds the way clear there, and nowhere else. From then
on a filter fuses odometry with the sightings that agree with it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry.planar_covariance import position_std, propagate
from ngo_estimator.geometry.se2 import compose
from ngo_estimator.slam.evidence import (
    Hypotheses,
    HypothesisWindow,
    Mode,
    agreeing,
    fused,
    strongest_modes,
    support,
)
from ngo_estimator.slam.sightings import MapMatcher, Sightings

_NEW_LOOKS = 4
"""A claimed pose is seen in one of so many last looks."""

_STRONG = 0.8
"""Belief of sightings that contradict a pose."""


@dataclass(frozen=True)
class LocalisationConfig:
    """When a pose is claimed, and when it is lost again. A place has the length of the matcher's ``place_m``."""

    look_deg: float = 10.0
    """Turn after which the map is looked at, also without the matcher's motion (degrees)."""
    window: int = 24
    """Last looks that count."""
    least_support: float = 7.0
    """Looks that must support a claim; so much strong belief against a pose, and nothing for it, loses it."""
    least_share: float = 0.7
    """Share of the window that must support a claim, 0 to 1."""
    least_way_places: float = 3.0
    """Path over which the support must be spread (places)."""
    most_rival: float = 0.35
    """Support of another pose at most, as a share of the claim's, 0 to below 1."""
    lost_places: float = 2.0
    """Deviation of the position past which a pose is lost (places)."""

    def __post_init__(self) -> None:
        check_positive(self, "look_deg least_support lost_places")
        check(self, "window", "at least 2", lambda x: x >= 2)
        check(self, "least_way_places", "finite, from 0 on", lambda x: 0.0 <= x < math.inf)
        check(self, "most_rival", "a share of 0 to below 1", lambda x: 0.0 <= x < 1.0)
        check(self, "least_share", "a share of 0 to 1", lambda x: 0.0 <= x <= 1.0)


@dataclass(frozen=True)
class Localisation:
    """What is known after a frame.

    ``pose_xyyaw`` (3,) of the newest frame in the map and its ``covariance`` (3, 3); both None while the pose is not
    known. ``hypotheses`` are the strongest modes of the window, best
    first. ``claimed`` and ``lost`` say whether this frame began or ended that the pose is known.
    """

    stamp_ns: int
    pose_xyyaw: np.ndarray | None
    covariance: np.ndarray | None
    hypotheses: tuple[Mode, ...]
    claimed: bool
    lost: bool


class Localiser:
    """Takes steps, and reports where in the map the robot is once that is beyond doubt."""

    def __init__(self, matcher: MapMatcher, config: LocalisationConfig | None = None) -> None:
        self.config = config or LocalisationConfig()
        self._hurries = True
        self._matcher = matcher
        self._window = HypothesisWindow(self.config.window)
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the pose is not known."""
        self._matcher.reset()
        self._window.clear()
        self._odometry = np.zeros(3)
        self._way_m = self._turn_rad = math.inf  # since the last look
        self._looks_since = 0  # the whole map was asked
        self._track: tuple[np.ndarray, np.ndarray] | None = None
        self._modes: tuple[Mode, ...] = ()

    def take_time(self) -> None:
        """Claim nothing by one sighting: its pose is right, and too rough for what is mapped from there on."""
        self._hurries = False

    def set_pose(self, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> None:
        """Take the newest frame's pose ``(3,)`` and covariance ``(3, 3)`` from somebody who knows them."""
        self._track = pose_xyyaw.astype(np.float64), covariance.astype(np.float64)
        self._window.clear()
        self._modes = ()

    def update(self, step: RelativeStep, relative: np.ndarray, covariance: np.ndarray) -> Localisation:
        """Take the next step: ``relative`` ``(3,)`` with its ``covariance`` ``(3, 3)``, as the log of steps has it."""
        known = self._track is not None
        self._move(relative, covariance)
        usable = self._matcher.append(step, self._odometry)
        due = self._way_m >= self._matcher.look_m or self._turn_rad >= math.radians(self.config.look_deg)
        if usable and due:
            self._look()
        found = self._track is not None
        pose, covariance_now = (None, None) if self._track is None else self._track
        return Localisation(step.stamp_ns, pose, covariance_now, self._modes, found and not known, known and not found)

    def _move(self, relative: np.ndarray, covariance: np.ndarray) -> None:
        """Carry everything over a step."""
        self._odometry = compose(self._odometry, relative)
        self._way_m += float(np.hypot(relative[0], relative[1]))
        self._turn_rad += abs(float(relative[2]))
        self._window.move(relative, covariance)
        if self._track is not None:
            pose = compose(self._track[0], relative)
            self._track = pose, propagate(self._track[1], pose, relative, covariance)

    def _look(self) -> None:
        """Compare the newest frame with the map, and weigh what the window says."""
        self._way_m = self._turn_rad = 0.0
        self._looks_since += 1
        if self._track is not None and self._looks_since < self._matcher.search_every:
            self._correct(Sightings.none())
            return
        self._looks_since = 0
        self._window.add(self._matcher.everywhere())
        hypotheses, place_m = self._window.hypotheses(), self._matcher.place_m
        self._modes = strongest_modes(hypotheses, place_m)
        if self._track is None:
            if self._modes and (mode := self._beyond_doubt()) is not None:
                agree = agreeing(hypotheses, mode.pose_xyyaw, mode.covariance, place_m)
                self._track = fused(hypotheses.where(agree), mode.pose_xyyaw)
            return
        agree = agreeing(hypotheses, *self._track, place_m)
        if self._contradicted(hypotheses, agree):
            self._track = None
            return
        newest = hypotheses.where(hypotheses.look == len(self._window) - 1)
        self._correct(Sightings(newest.poses, newest.covariance, newest.belief))

    def _correct(self, newest: Sightings) -> None:
        """Fuse the track with what agrees with it, of the newest look and of the map around."""
        assert self._track is not None
        both = newest.and_also(self._matcher.around(self._track[0]))
        seen = Hypotheses(both.poses, both.covariance, both.belief, np.zeros(len(both), np.int64))
        seen = seen.where(agreeing(seen, *self._track, self._matcher.place_m))
        if len(seen.look):
            self._track = fused(seen, *self._track)

    def _beyond_doubt(self) -> Mode | None:
        """The strongest mode, if it is the only one where the way is clear; where none is, if it has many sightings."""
        matcher, strongest = self._matcher, self._modes[0]
        # A way that is clear has asked all frames, and not only those with sightings.
        clear = [mode for mode in self._modes if self._hurries and matcher.is_clear(mode.pose_xyyaw)]
        if clear:
            return clear[0] if len(clear) == 1 and clear[0].support >= strongest.support else None
        many = self._supported(strongest, self._modes[1:])
        return strongest if many and matcher.allows(strongest.pose_xyyaw) else None

    def _supported(self, mode: Mode, others: Sequence[Mode]) -> bool:
        config, rival = self.config, max((other.support for other in others), default=0.0)
        return (
            mode.support >= config.least_share * len(self._window)
            and rival <= config.most_rival * mode.support
            and may_claim(config, self._window, mode, self._matcher.place_m)
        )

    def _contradicted(self, hypotheses: Hypotheses, agree: np.ndarray) -> bool:
        """Whether the track is lost; ``agree`` says which hypotheses agree with it."""
        assert self._track is not None
        place_m, least = self._matcher.place_m, self.config.least_support
        if position_std(self._track[1]) > self.config.lost_places * place_m:
            return True
        ours = support(hypotheses, agree)
        if ours == 0.0 and support(hypotheses, hypotheses.belief >= _STRONG) >= least:
            return True
        others = [mode for mode in self._modes if not _same(mode, self._track[0], place_m)]
        if len(others) == len(self._modes) and self._modes:
            track = Mode(*self._track, ours, np.zeros(0, np.int64))
            return self._supported(others[0], (*others[1:], track))
        return False


def may_claim(config: LocalisationConfig, window: HypothesisWindow, mode: Mode, place_m: float) -> bool:
    """Whether a mode of a window's hypotheses has support enough, over a way that is long enough and up to now."""
    way_m = window.way_m[mode.looks]
    return (
        mode.support >= config.least_support
        and float(way_m[0] - way_m[-1]) >= config.least_way_places * place_m
        and mode.looks[-1] >= len(window) - _NEW_LOOKS
    )


def _same(mode: Mode, pose: np.ndarray, place_m: float) -> bool:
    """Whether a mode lies within a place of a pose ``(3,)``."""
    return bool(np.hypot(*(mode.pose_xyyaw - pose)[:2]) <= place_m)
