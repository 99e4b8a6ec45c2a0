"""All numbers of the mixture front end, but those of registration and of making points, which loops share."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ngo_estimator.data.lidar_file import read_lidar_file
from ngo_estimator.geometry.scan_matching import IcpConfig
from ngo_estimator.geometry.scan_points import ScanPointsConfig
from ngo_estimator.geometry.score_field import ScoreFieldConfig


@dataclass(frozen=True)
class MixtureConfig:
    """Settings of the front end; see the comment of each."""

    # Hypotheses of a motion: wheels that are good, wheels that are poor, the last displacement, the last velocity,
    # none, anything. One of the weight 0, but not anything, is left out.
    first_weights: tuple[float, ...] = (0.45, 0.2, 0.1, 0.15, 0.07, 0.03)
    first_factors: tuple[float, ...] = (0.5, 2.0, 3.0, 2.0, 3.0, 1.0)  # on the deviations below
    least_factors: tuple[float, ...] = (0.1, 1.0, 0.5, 0.3, 0.5, 1.0)
    most_factor: float = 6.0
    least_weight: float = 0.01
    still_m: float = 0.01  # deviation of a motion's position where there is none; it grows with way and turn
    way_share: float = 0.08  # m for each m
    turn_m: float = 0.05  # m for each rad
    still_deg: float = 0.3  # the same of its heading
    turn_share: float = 0.08  # rad for each rad
    way_rad: float = 0.03  # rad for each m
    anything: tuple[float, float] = (0.3, 0.3)  # deviation of anything, in usual periods of the scanner (m, rad)
    most_gap: float = 10.0  # usual periods up to which deviations without wheels grow
    repeated: float = 8.0  # steps that share an error of the wheels

    # Learning, by distance.
    learn_rate: float = 0.05  # what one match counts at most
    learn_way: float = 0.2  # way (m) and turn (rad) that make it count so much
    certain_m: float = 5.0  # way and turn that the wheels' calibration counts as known at first
    certain_rad: float = 3.0
    remembered_m: float = 100.0  # way after which it is forgotten

    # Search: windows cover all hypotheses, within limits.
    least: float = 0.07  # no hypothesis is surer than this where the place is chosen (m, rad)
    prior_weight: float = 0.025  # of the prior's logarithm against a mean score, which is less where scans usually fit:
    usual_misfit: float = 0.05  # what their points usually lack to 1, below which it is
    search_points: int = 120
    most_window_m: float = 2.5
    heading_step_deg: float = 1.25
    apart_m: float = 0.3  # modes closer than this are one; windows are half as wide again at least
    apart_deg: float = 6.0
    margin: float = 3.0  # of log likelihoods, up to which the second mode counts
    noise: float = 0.5  # log likelihood by which a mode of the search must be better than where a hypothesis leads

    # Lost, and segments.
    lost_share: float = 0.6  # of the usual score, below which what was seen before contradicts a scan
    lost: float = 0.8  # dead reckoning (m, rad) after which a segment begins
    silent_s: float = 4.0  # of scans and wheels, after which a segment begins

    # Key scans.
    key_m: float = 0.3
    key_deg: float = 15.0
    new_share: float = 0.8  # of the usual score, below which the search goes on in a wider window
    submap_scans: int = 20

    cells: ScoreFieldConfig = field(default_factory=ScoreFieldConfig)
    icp: IcpConfig = field(default_factory=IcpConfig)
    points: ScanPointsConfig = field(default_factory=ScanPointsConfig)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            may_be_zero = name == "first_weights" and value[-1] > 0.0 and all(0.0 <= each < math.inf for each in value)
            if not (may_be_zero or _positive(value)):
                raise ValueError(f"{name} is {value}; expected positive numbers")
        if not all(len(each) == 6 for each in (self.first_weights, self.first_factors, self.least_factors)):
            raise ValueError(
                "first_weights, first_factors, least_factors: expected one number for each of 6 hypotheses"
            )
        if len(self.anything) != 2:
            raise ValueError(f"anything is {self.anything}; expected two deviations")


def read_mixture_config(weights: Path, world: str | None = None) -> MixtureConfig:
    """The front end's settings in ``lidar.json`` of the folder ``weights``; raises ``LidarFileError`` of one line."""
    return read_lidar_file(weights, "odometry", MixtureConfig, world)


def _positive(value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_positive(each) for each in value)
    return not isinstance(value, int | float) or 0.0 < value < math.inf
