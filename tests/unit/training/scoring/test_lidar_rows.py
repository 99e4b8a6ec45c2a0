"""The lidar's rows: their errors, what is kept of them, and wrong loops."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from ngo_estimator.frontend.lidar.mixture_config import MixtureConfig
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_points import Mounting
from ngo_estimator.graph.corrector import GraphProblem
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.robust import Robust
from ngo_recordings.scan_stream import LidarScan, WheelPose
from training.baselines.graph_peers import least_squares
from training.data.lidar_drives import LidarDrive, ReferencePoses, Relations, TruePoses
from training.scoring.lidar_errors import absolute_error_m, covariance_errors, lidar_errors
from training.scoring.lidar_rows import FRONT_ABLATION, ROWS, DriveRuns, Estimate, Row, changed, identity_of
from training.scoring.lidar_scores import scored, scored_rows
from training.scoring.wrong_loops import with_wrong_loops

POSES = np.stack((np.arange(5.0), np.zeros(5), np.zeros(5)), axis=-1)
STAMPS = (1 + np.arange(5)) * 10**9


def drive() -> LidarDrive:
    scans = tuple(LidarScan(int(stamp), 0.0, 0.1, np.ones(5, np.float32), 0.0, 10.0, 0.0, "laser") for stamp in STAMPS)
    wheels = tuple(WheelPose(int(stamp), pose) for stamp, pose in zip(STAMPS, 1.5 * POSES, strict=True))
    return LidarDrive("straight", "straight", scans, wheels, Mounting(np.zeros(3)), TruePoses(STAMPS, POSES))


def test_errors_and_what_is_drawn_of_an_estimate(tmp_path: Path) -> None:
    def estimate(_: DriveRuns) -> Estimate:
        return Estimate(STAMPS, POSES + (0.0, 0.5, 0.0), facts={"loops": 3})

    measured = scored(DriveRuns(drive(), tmp_path), Row(estimate, {"a": 1}, code=()))
    assert measured.errors["ate_m"] == pytest.approx([0.0], abs=1e-9)
    assert measured.errors["loops"] == pytest.approx([3.0])
    assert measured.drawn["path"].shape == measured.drawn["truth"].shape == (5, 3)


def test_a_row_that_needs_wheels_says_that_there_are_none(tmp_path: Path) -> None:
    without = replace(drive(), wheels=())
    assert scored(DriveRuns(without, tmp_path), ROWS["wheels"]).failed == "straight has no wheel odometry"


def test_a_failure_is_kept_in_words(tmp_path: Path) -> None:
    def estimate(_: DriveRuns) -> Estimate:
        raise ValueError("no scan fits")

    measured = scored(DriveRuns(drive(), tmp_path), Row(estimate, None, code=()))
    assert measured.failed == "no scan fits"
    assert measured.errors == {}


def test_rows_of_our_own_follow_from_the_settings_files(tmp_path: Path) -> None:
    def identities() -> dict[str, str]:
        return {name: row.identity for name, row in scored_rows(ROWS, tmp_path).items()}

    (tmp_path / "lidar.json").write_text("{}")
    before = identities()
    (tmp_path / "lidar.json").write_text("{} ")
    changed_rows = {name for name, identity in identities().items() if identity != before[name]}
    assert "ours" in changed_rows and "gtsam_lm" in changed_rows
    assert not changed_rows & {"wheels", "kiss_icp"}


def test_every_row_has_settings_of_its_own() -> None:
    ours = [identity_of(row.settings) for name, row in ROWS.items() if name.startswith(("ours", "without"))]
    assert len(set(ours)) == len(ours)


def test_a_change_goes_down_the_dots_and_an_unknown_name_is_an_error() -> None:
    from ngo_estimator.loops.scan_settings import ScanGraphConfig

    config = changed(ScanGraphConfig(), {"kernel": 7.0, "loops.every": 4})
    assert (config.kernel, config.loops.every) == (7.0, 4)
    assert ScanGraphConfig().kernel != 7.0
    with pytest.raises(TypeError):
        changed(ScanGraphConfig(), {"kernal": 7.0})


SQUARE_NS = np.array((10, 11, 12, 13)) * 10**9
SQUARE = np.array(((0.0, 0.0, 0.0), (2.0, 0.0, math.pi / 2), (2.0, 2.0, math.pi), (0.0, 2.0, -math.pi / 2)))


def test_the_best_alignment_takes_a_rigid_motion_out() -> None:
    assert absolute_error_m(se2.compose(np.array((3.0, -7.0, 2.5)), SQUARE), SQUARE) == pytest.approx(0.0, abs=1e-12)


def test_truth_gives_three_errors_and_a_mapper_one() -> None:
    estimate = se2.compose(np.array((5.0, 5.0, 1.0)), SQUARE)
    found = lidar_errors(TruePoses(SQUARE_NS, SQUARE), SQUARE_NS, estimate)
    assert {name: values.shape for name, values in found.items()} == {
        "ate_m": (1,), "position_rmse_m": (1,), "heading_rmse_deg": (1,)
    }  # fmt: skip
    assert max(float(values[0]) for values in found.values()) == pytest.approx(0.0, abs=1e-9)
    assert lidar_errors(ReferencePoses(SQUARE_NS, SQUARE), SQUARE_NS, estimate).keys() == {"ate_m"}


def test_relations_give_an_error_each() -> None:
    wanted = Relations(
        np.array(((10.0, 11.0), (11.0, 12.0))), np.array(((2.0, 0.0, math.pi / 2), (1.0, 0.0, math.pi / 2)))
    )
    found = lidar_errors(wanted, SQUARE_NS, SQUARE)
    assert found["translation_m"] == pytest.approx([0.0, 1.0])
    assert found["far_m"].shape == (0,)


def test_the_truth_is_within_three_deviations_of_a_published_pose_or_not() -> None:
    published = SQUARE.copy()
    published[1, 1] += 0.29  # within 3 x 0.1 m
    published[2, 1] += 0.31  # beyond
    published[3, 2] += 2.0 * math.pi - 0.02  # a turn more, 0.02 rad less: within 3 x 0.01 rad
    covariances = np.tile(np.diag((0.01, 0.01, 1e-4)), (4, 1, 1))
    found = covariance_errors(TruePoses(SQUARE_NS, SQUARE), SQUARE_NS, published, covariances)
    assert found["within_three_deviations"] == [0.75]


def test_the_likelihood_is_that_of_a_normal_distribution_and_best_for_the_deviation_that_is_true() -> None:
    noise = np.random.default_rng(0).standard_normal((4, 3)) * (0.1, 0.1, 0.01)
    truth = TruePoses(SQUARE_NS, SQUARE)
    by_factor = {
        factor: covariance_errors(truth, SQUARE_NS, SQUARE + noise, np.tile(np.diag(variances), (4, 1, 1)))
        for factor in (0.2, 1.0, 5.0)
        for variances in [(factor * np.array((0.1, 0.1, 0.01))) ** 2]
    }
    found = {factor: float(errors["negative_log_likelihood"][0]) for factor, errors in by_factor.items()}
    assert found[1.0] < min(found[0.2], found[5.0])
    density = multivariate_normal(cov=np.diag((0.01 + 1e-6, 0.01 + 1e-6, 1e-4 + 1e-6)))
    assert found[1.0] == pytest.approx(-density.logpdf(noise).mean())


NODES = 60
COVARIANCE = np.diag((0.02**2, 0.02**2, 0.01**2))


def straight(pairs: np.ndarray) -> RelativePoses:
    """What is measured between nodes one metre apart on a line."""
    relative = np.zeros((len(pairs), 3))
    relative[:, 0] = pairs[:, 1] - pairs[:, 0]
    return RelativePoses.of_covariances(pairs, relative, np.tile(COVARIANCE, (len(pairs), 1, 1)))


CHAIN = np.arange(NODES - 1)
STEPS = straight(np.stack((CHAIN, CHAIN + 1), axis=1))
LOOPS = straight(np.stack((np.arange(0, 40), np.arange(20, 60)), axis=1))
TRUTH = np.stack((np.arange(NODES), np.zeros(NODES), np.zeros(NODES)), axis=-1).astype(float)


@pytest.mark.parametrize(("percent", "wrong"), [(10, 4), (50, 40), (60, 60)])
def test_right_loops_stay_and_wrong_ones_are_a_share_of_all(percent: float, wrong: int) -> None:
    fed = with_wrong_loops(LOOPS, NODES, percent, np.random.default_rng(1))
    np.testing.assert_array_equal(fed.nodes[:40], LOOPS.nodes)
    assert wrong - 6 <= len(fed.nodes) - 40 <= wrong  # a few would join neighbours
    off = np.abs(fed.residuals(TRUTH)).max(axis=1)
    assert off[:40].max() < 1e-9
    assert (off[40:] > 3.0).all()
    assert fed.relative.shape == (len(fed.nodes), 3)
    assert fed.root.shape == (len(fed.nodes), 3, 3)


@pytest.mark.parametrize("percent", [20, 60])
def test_our_corrector_withstands_wrong_loops_and_least_squares_do_not(percent: float) -> None:
    fed = with_wrong_loops(LOOPS, NODES, percent, np.random.default_rng(2))
    start = TRUTH + np.linspace(0.0, 0.1, NODES)[:, None] * (1.0, 1.0, 0.1)
    problem = GraphProblem(start, STEPS, fed, np.ones(len(fed)))
    assert np.abs(Robust().correct(problem).poses - TRUTH).max() < 0.05
    assert np.abs(least_squares(problem) - TRUTH).max() > 1.0


@pytest.mark.parametrize("row", FRONT_ABLATION)
def test_each_row_of_the_ablation_leaves_something_out(row: str) -> None:
    config = MixtureConfig()
    assert changed(config, FRONT_ABLATION[row].settings.odometry) != config
