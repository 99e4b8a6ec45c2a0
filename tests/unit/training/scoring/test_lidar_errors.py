import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from training.data.lidar_drives import ReferencePoses, Relations, TruePoses
from training.scoring.lidar_errors import absolute_error_m, covariance_errors, lidar_errors

STAMPS = np.array((10, 11, 12, 13)) * 10**9
SQUARE = np.array(((0.0, 0.0, 0.0), (2.0, 0.0, math.pi / 2), (2.0, 2.0, math.pi), (0.0, 2.0, -math.pi / 2)))


def turned(poses: np.ndarray, x: float, y: float, yaw: float) -> np.ndarray:
    cosine, sine = math.cos(yaw), math.sin(yaw)
    return np.stack(
        (
            x + cosine * poses[:, 0] - sine * poses[:, 1],
            y + sine * poses[:, 0] + cosine * poses[:, 1],
            poses[:, 2] + yaw,
        ),
        axis=-1,
    )


def test_the_best_alignment_takes_a_rigid_motion_out() -> None:
    assert absolute_error_m(turned(SQUARE, 3.0, -7.0, 2.5), SQUARE) == pytest.approx(0.0, abs=1e-12)


def test_truth_gives_three_errors_and_a_mapper_one() -> None:
    estimate = turned(SQUARE, 5.0, 5.0, 1.0)
    found = lidar_errors(TruePoses(STAMPS, SQUARE), STAMPS, estimate)
    assert {name: values.shape for name, values in found.items()} == {
        "ate_m": (1,), "position_rmse_m": (1,), "heading_rmse_deg": (1,)
    }  # fmt: skip
    assert max(float(values[0]) for values in found.values()) == pytest.approx(0.0, abs=1e-9)
    assert lidar_errors(ReferencePoses(STAMPS, SQUARE), STAMPS, estimate).keys() == {"ate_m"}


def test_relations_give_an_error_each() -> None:
    wanted = Relations(
        np.array(((10.0, 11.0), (11.0, 12.0))), np.array(((2.0, 0.0, math.pi / 2), (1.0, 0.0, math.pi / 2)))
    )
    found = lidar_errors(wanted, STAMPS, SQUARE)
    assert found["translation_m"] == pytest.approx([0.0, 1.0])
    assert found["far_m"].shape == (0,)


def test_the_truth_is_within_three_deviations_of_a_published_pose_or_not() -> None:
    published = SQUARE.copy()
    published[1, 1] += 0.29  # within 3 x 0.1 m
    published[2, 1] += 0.31  # beyond
    published[3, 2] += 2.0 * math.pi - 0.02  # a turn more, 0.02 rad less: within 3 x 0.01 rad
    covariances = np.tile(np.diag((0.01, 0.01, 1e-4)), (4, 1, 1))
    found = covariance_errors(TruePoses(STAMPS, SQUARE), STAMPS, published, covariances)
    assert found["within_three_deviations"] == [0.75]


def test_the_likelihood_is_that_of_a_normal_distribution_and_best_for_the_deviation_that_is_true() -> None:
    noise = np.random.default_rng(0).standard_normal((4, 3)) * (0.1, 0.1, 0.01)
    truth = TruePoses(STAMPS, SQUARE)
    by_factor = {
        factor: covariance_errors(truth, STAMPS, SQUARE + noise, np.tile(np.diag(variances), (4, 1, 1)))
        for factor in (0.2, 1.0, 5.0)
        for variances in [(factor * np.array((0.1, 0.1, 0.01))) ** 2]
    }
    found = {factor: float(errors["negative_log_likelihood"][0]) for factor, errors in by_factor.items()}
    assert found[1.0] < min(found[0.2], found[5.0])
    density = multivariate_normal(cov=np.diag((0.01 + 1e-6, 0.01 + 1e-6, 1e-4 + 1e-6)))
    assert found[1.0] == pytest.approx(-density.logpdf(noise).mean())
