"""Settings and arguments that cannot be are refused, with their value and what is expected."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from ngo_estimator.data.images import ImageFormat
from ngo_estimator.geometry.branch_and_bound import SearchConfig, pooled_grid, search
from ngo_estimator.geometry.scan_points import Mounting, key_scan
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.mapping.occupancy_grid import OccupancyConfig, OccupancyGrid
from ngo_estimator.mapping.range_scan import range_scan
from ngo_estimator.mapping.scan_map import ScanMapConfig
from ngo_estimator.networks.odometry_smoothing import SmootherConfig
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from ngo_estimator.trajectory.errors import RelativeDelta
from tests.unit.ngo_estimator.samples import local_config, place_config

SCAN = ImageFormat(1, 289, 1, "float32", field_of_view_deg=270.0)
AGGREGATION = PoseAggregationConfig(5)
POINTS = np.array(((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)))


def optimizer(**changes: object) -> NeuralGraphOptimizerConfig:
    return NeuralGraphOptimizerConfig(aggregation=AGGREGATION, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("refused", "words"),
    [
        (lambda: local_config("maze2d", width=2.1), "width is 2.1; expected over 0"),
        (lambda: local_config("maze2d", period_s=math.nan), "period_s is nan; expected positive"),
        (lambda: local_config("maze2d", relative_std=(1.0, 0.0, 1.0)), r"relative_std is \(1.0, 0.0, 1.0\); expected"),
        (lambda: local_config("maze2d", symmetric=True, mirrored_actions=(0, 1, 1)), "mirrored_actions is"),
        (lambda: place_config("maze2d", code_size=0), "code_size is 0; expected at least 1"),
        (lambda: SmootherConfig(6, (0.1, 0.1, 0.1), dilations=()), r"dilations is \(\); expected at least 1"),
        (lambda: SmootherConfig(6, (0.1, 0.0, 0.1)), r"relative_std is \(0.1, 0.0, 0.1\); expected positive"),
        (lambda: PoseAggregationConfig(5, halvings=7), "halvings is 7; expected 0 to 6"),
        (lambda: optimizer(attention="max"), "attention is 'max'; expected"),
        (lambda: optimizer(iterations=0), "iterations is 0; expected at least 1"),
        (lambda: optimizer(loops=False, network=False), "loops, network are False, False; expected"),
        (lambda: ImageFormat(60, 80, 4, "uint8"), "image has 4 channels of uint8; expected"),
        (lambda: replace(SCAN, field_of_view_deg=361.0), "at most 360"),
        (lambda: replace(SCAN, depth_gain_m=0.0), "positive distances"),
        (lambda: SCAN.check(np.full(SCAN.shape, -0.1, np.float32)), "289 negative"),
        (lambda: SCAN.check(np.full(SCAN.shape, math.inf, np.float32)), "no return in 289 depths"),
        (lambda: RegistrationConfig(rays=7, field_of_view_deg=300.0, noise_m=0.001), "expected at least 8"),
        (lambda: RegistrationConfig(rays=9, field_of_view_deg=300.0, noise_m=0.5), "no larger than the tolerance"),
        (lambda: SearchConfig(resolution_m=0.0), "resolution_m"),
        (lambda: pooled_grid(SearchConfig(), np.zeros((0, 2))), "at least one point"),
        (
            lambda: search(
                SearchConfig(), pooled_grid(SearchConfig(), POINTS), POINTS, np.zeros(3), np.array((1.0, -1.0, 0.1))
            ),
            "centre, window",
        ),
        (lambda: key_scan(0, np.arange(10.0), np.ones(9), (0.1, 9.0), Mounting(np.zeros(3))), "shapes"),
        (lambda: key_scan(0, np.arange(9.0), np.ones(9), (2.0, 1.0), Mounting(np.zeros(3))), "range_limits"),
        (lambda: OccupancyGrid(0.0), "resolution_m is 0.0; expected a positive length"),
        (lambda: OccupancyConfig(free=0.7), "free, occupied are 0.7, 0.65; expected 0 <= free < occupied <= 1"),
        (lambda: range_scan(np.zeros(2), np.zeros(3), np.zeros(3), 1.0), r"shapes \(2,\), \(3,\), \(3,\)"),
        (lambda: ScanMapConfig(most_at_a_place=0), "most_at_a_place is 0; expected at least 1"),
        (lambda: RelativeDelta(0.5, "frames"), "delta is"),
    ],
)
def test_it_is_refused_in_words(refused: Callable[[], object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        refused()
