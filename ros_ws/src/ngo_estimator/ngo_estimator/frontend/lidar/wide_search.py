"""Where a scan may have been taken when the prediction is of no help: all of a wide window, and whether it is unique.

Not in the paper. A corridor's doors repeat, and a room looks alike from its corners: a second place that fits nearly as
well makes the match doubtful, and its distance goes into the covariance.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from ngo_estimator.geometry.branch_and_bound import PooledGrid, SearchConfig, SearchMatch, response_at, search
from ngo_estimator.geometry.planar_motion import Array, squared_deviations, wrap


@dataclass(frozen=True)
class WideSearchConfig:
    """How far wide searches go.

    A search goes ``least_m`` from the prediction, or ``deviations`` of it where that is farther, at most ``most_m``. It
    turns by each of ``turns_deg`` until a pose has a response of ``enough``. A place away from the prediction costs
    ``squared_cost`` of the response for each squared deviation, but at most ``far_cost`` and ``metre_cost`` a metre and
    ``radian_cost`` a radian. The place that was found near it is left for one that is better by ``better`` after that.
    A second place whose response is at least ``alike`` of the best makes it doubtful. ``most_points`` of the scan are
    looked up.
    """

    least_m: float = 1.5
    deviations: float = 2.5
    most_m: float = 4.0
    turns_deg: tuple[float, ...] = (60.0, 180.0)
    enough: float = 0.55
    better: float = 0.03
    squared_cost: float = 0.05
    far_cost: float = 0.1
    metre_cost: float = 0.02
    radian_cost: float = 0.15
    alike: float = 0.92
    most_points: int = 120
    search: SearchConfig = field(default_factory=SearchConfig)

    def __post_init__(self) -> None:
        positive = (self.least_m, self.deviations, *self.turns_deg)
        if not (all(0.0 < x < math.inf for x in positive) and self.least_m <= self.most_m < math.inf):
            raise ValueError(
                f"least_m, deviations, turns_deg are {positive} and most_m is {self.most_m}; expected positive "
                "numbers, and most_m at least least_m"
            )
        shares = (self.enough, self.better, self.alike)
        if not all(0.0 < x <= 1.0 for x in shares) or self.most_points < 10 or not self.turns_deg:
            raise ValueError(
                f"enough, better, alike are {shares}, most_points is {self.most_points} and turns_deg is "
                f"{self.turns_deg}; expected shares of one, at least 10 points and one turn"
            )


@dataclass(frozen=True, eq=False)
class WidePlace:
    """The best pose ``(3,)`` of a wide window; ``better`` than the given place or not; ``doubt`` ``(3, 3)`` is the
    covariance of not knowing it from the second place, None where it is unique."""

    pose: Array
    better: bool
    doubt: Array | None


def wide_place(
    config: WideSearchConfig,
    grid: PooledGrid,
    points: Array,
    prior: tuple[Array, Array],
    deviation_m: float,
    given: Array,
) -> WidePlace | None:
    """Search points ``(n, 2)`` around the predicted pose; None where nothing fits.

    ``prior`` is its mean ``(3,)`` and its information ``(3, 3)``; ``deviation_m`` is how far it may be wrong. ``given``
    ``(3,)`` is the pose that was found near it.
    """
    mean, _ = prior
    few = points[:: max(1, math.ceil(len(points) / config.most_points))]
    reach = min(max(config.least_m, config.deviations * deviation_m), config.most_m)
    match: SearchMatch | None = None
    for turn_deg in config.turns_deg:
        window = np.array((reach, reach, math.radians(turn_deg)))
        wider = search(config.search, grid, few, mean, window)
        if wider is not None and (match is None or wider.response > match.response + config.better):
            match = wider
        if match is not None and match.response >= config.enough:
            break
    if match is None:
        return None
    second = match.second if match.second_pose is not None else 0.0
    alike = match.second_pose is not None and second >= config.alike * match.response
    best, other, response = match.pose, match.second_pose, match.response
    costs = [_cost(config, prior, pose) for pose in (best, best if other is None else other)]
    if alike and other is not None and second - costs[1] > response - costs[0]:
        best, other, response, costs = other, best, second, costs[::-1]
    doubt = None
    if alike and other is not None:
        apart = other - best
        apart[2] = wrap(apart[2])
        doubt = 0.25 * np.outer(apart, apart)  # of two places, one as likely as the other
    near = response_at(grid, few, given) - _cost(config, prior, given)
    return WidePlace(best, response - costs[0] > near + config.better, doubt)


def _cost(config: WideSearchConfig, prior: tuple[Array, Array], pose: Array) -> float:
    """What a pose costs by its distance from the prediction."""
    mean, information = prior
    way, turn = math.hypot(pose[0] - mean[0], pose[1] - mean[1]), abs(wrap(pose[2] - mean[2]))
    most = config.far_cost + config.metre_cost * way + config.radian_cost * turn
    return min(config.squared_cost * squared_deviations(pose, mean, information), most)
