"""Where the next scan is expected, with wheels and without."""

import copy
import math
from collections.abc import Callable

import numpy as np
import pytest

from ngo_estimator.frontend.lidar.motion_prior import MotionPrior, MotionPriorConfig, Prediction
from ngo_estimator.frontend.lidar.wheel_odometry import WheelOdometry
from ngo_estimator.geometry.planar_motion import between, compose, turned_covariance

PERIOD_NS = 100_000_000
STEP = np.array((0.05, 0.0, 0.02))
SURE = np.diag((1e-6, 1e-6, 1e-8))


def begun(start: np.ndarray) -> tuple[WheelOdometry, MotionPrior]:
    """Wheels whose first reading is where the first scan was taken, and the prior of the next scan."""
    wheels, prior = WheelOdometry(), MotionPrior(MotionPriorConfig())
    wheels.add(0, start)
    prior.begin(0, start, wheels)
    return wheels, prior


def driven(steps: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """The motion that is expected next, after steps with covariances."""
    prior, pose = MotionPrior(MotionPriorConfig()), np.zeros(3)
    prior.begin(0, pose, None)
    for k, (step, covariance) in enumerate(steps, 1):
        prior.predict(k * PERIOD_NS, pose, np.zeros((3, 3)), None)
        pose = compose(pose, step)
        prior.accept(k * PERIOD_NS, pose, turned_covariance(pose[2], covariance), step, covariance, False, False, False)
    return between(pose, prior.predict((len(steps) + 1) * PERIOD_NS, pose, np.zeros((3, 3)), None).mean)


def test_a_measured_velocity_goes_on() -> None:
    assert driven([(STEP, SURE)] * 30) == pytest.approx(STEP, abs=2e-3)


def test_an_open_direction_tells_no_velocity() -> None:
    """In a corridor the walls hold nothing along it: the pose stays as predicted there, and the turn counts."""
    prior, pose = MotionPrior(MotionPriorConfig()), np.zeros(3)
    prior.begin(0, pose, None)
    for k in range(1, 21):
        prediction = prior.predict(k * PERIOD_NS, pose, np.zeros((3, 3)), None)
        step, covariance = STEP, SURE
        if k > 10:
            step = between(pose, prediction.mean)
            step[2] = 0.03
            covariance = np.diag((prediction.covariance[0, 0], 1e-6, 1e-8))
        pose = compose(pose, step)
        prior.accept(k * PERIOD_NS, pose, covariance, step, covariance, False, k % 3 == 0, False)
    expected = between(pose, prior.predict(21 * PERIOD_NS, pose, np.zeros((3, 3)), None).mean)
    assert math.hypot(*expected[:2]) == pytest.approx(STEP[0], abs=0.01)
    assert expected[2] == pytest.approx(0.03, abs=2e-3)


def test_a_robot_that_was_seen_to_speed_up_may_do_so_where_no_wall_tells_it() -> None:
    """It speeds up to 3 m/s and stops again; then it enters a corridor slowly and speeds up there."""
    prior, pose, truth = MotionPrior(MotionPriorConfig()), np.zeros(3), 0.0
    prior.begin(0, pose, None)
    for k in range(1, 221):
        truth += 0.1 * 1.5 * (1.0 - math.cos(2.0 * math.pi * k / 40.0))
        before, prediction = pose, prior.predict(k * PERIOD_NS, pose, np.zeros((3, 3)), None)
        covariance, pose = SURE, np.array((truth, 0.0, 0.0))
        if k > 200:
            covariance = np.diag((prediction.covariance[0, 0], 1e-6, 1e-8))
            pose = np.array((prediction.mean[0], 0.0, 0.0))
        prior.accept(k * PERIOD_NS, pose, covariance, pose - before, covariance, False, False, False)
    assert abs(truth - pose[0]) > 1.0
    assert abs(truth - pose[0]) < 3.0 * math.sqrt(covariance[0, 0])


@pytest.mark.parametrize("keys", [1, 4, 1000])
def test_an_error_of_the_velocity_adds_up_over_key_scans(keys: int) -> None:
    """Along a corridor errors of 120 drives are as large as the sum of what their key scans say, however many."""
    config = MotionPriorConfig(acceleration_m_s2=2.0, largest_m_s=4.0)
    random, errors, variance = np.random.default_rng(keys), [], 0.0
    for _ in range(120):
        prior, pose, truth, speed = MotionPrior(config), np.zeros(3), 0.0, 0.4
        prior.begin(0, pose, None)
        total = 0.0
        for k in range(1, 41):
            speed += 0.1 * random.standard_normal()
            truth += 0.1 * speed + config.still_m * random.standard_normal()
            before, prediction = pose, prior.predict(k * PERIOD_NS, pose, np.zeros((3, 3)), None)
            open_ahead = k > 10
            covariance = np.diag((prediction.covariance[0, 0] if open_ahead else 1e-6, 1e-6, 1e-8))
            pose = np.array((prediction.mean[0] if open_ahead else truth, 0.0, 0.0))
            is_key = k % keys == 0 or k in (10, 40)
            shared = prior.accept(k * PERIOD_NS, pose, covariance, pose - before, covariance, False, is_key, False)
            total += (covariance + shared)[0, 0] if is_key else 0.0
        errors.append(pose[0] - truth)
        variance = total
    assert np.std(errors) == pytest.approx(math.sqrt(variance), rel=0.15)


def test_fast_scans_that_are_noisy_are_averaged() -> None:
    """Noise of the poses, and not of the steps: each pose is measured anew."""
    noise = np.random.default_rng(0).normal(0.0, 0.01, (41, 3)) * (1.0, 1.0, 0.1)
    covariance = np.diag((1e-4, 1e-4, 1e-6))
    steps = [STEP + after - before for before, after in zip(noise[:-1], noise[1:], strict=True)]
    last = [driven([(step, covariance) for step in steps[:count]]) - STEP for count in range(20, 40)]
    assert np.std(last, axis=0)[0] < math.sqrt(2.0) * 0.01


def followed(counted: list[np.ndarray], measured: list[np.ndarray]) -> list[Prediction]:
    """The prior of each scan, from wheels at the same stamps and the poses that the scans had in the end."""
    wheels, prior, predictions = WheelOdometry(), MotionPrior(MotionPriorConfig()), []
    wheels.add(0, counted[0])
    prior.begin(0, measured[0], wheels)
    for k in range(1, len(counted)):
        wheels.add(k * PERIOD_NS, counted[k])
        predictions.append(prior.predict(k * PERIOD_NS, measured[k - 1], np.eye(3) * 1e-4, wheels))
        step = measured[k] - measured[k - 1]
        prior.accept(k * PERIOD_NS, measured[k], SURE, step, SURE, False, k % 8 == 0, False)
    return predictions


def test_wheels_that_freeze_count_for_nothing_until_they_catch_up() -> None:
    """On the spot at 1.5 rad/s, so that the turns alone tell it."""
    measured = [np.array((0.0, 0.0, 0.15 * k)) for k in range(20)]
    counted = [measured[8] if 8 <= k < 13 else pose for k, pose in enumerate(measured)]
    trusted = [prediction.measured for prediction in followed(counted, measured)]
    assert trusted == [k < 9 or k > 12 for k in range(1, 20)]  # their whole way counts from the first scan on
    caught_up = followed(counted, measured)[12]
    assert any(start[2] == pytest.approx(measured[13][2], abs=0.02) for start in caught_up.starts)
    again = followed(counted, measured)[14]
    assert again.mean == pytest.approx(measured[15], abs=0.01)


def test_wheels_that_stand_for_long_are_believed() -> None:
    """Noisy scans of a robot that stands look like motion: that is no reason to doubt the wheels for ever."""
    noise = np.random.default_rng(0).normal(0.0, 0.02, (80, 3)) * (1.0, 1.0, 0.2)
    predictions = followed([np.zeros(3)] * 80, list(noise))
    assert not all(prediction.measured for prediction in predictions[:19])
    assert all(prediction.measured for prediction in predictions[21:])
    assert all(math.sqrt(prediction.covariance[0, 0]) < 0.04 for prediction in predictions[21:])


def test_a_robot_drives_on_as_it_did_unless_it_stands() -> None:
    """It drove on after each turn. Where the ranges say that it stands, nothing speeds it up."""
    prior, pose, random = MotionPrior(MotionPriorConfig()), np.zeros(3), np.random.default_rng(1)
    prior.begin(0, pose, None)
    velocity = step = np.zeros(3)
    for k in range(1, 378):  # until the third step after a turn
        turns = (k // 15) % 3 == 0
        aim = np.array((0.05, 0.0, 1.0 if (k // 45) % 2 else -1.0) if turns else (0.6, 0.0, 0.0))
        velocity = velocity + 0.3 * (aim - velocity)
        step = 0.1 * (velocity + 0.01 * random.standard_normal(3))
        prior.predict(k * PERIOD_NS, pose, np.zeros((3, 3)), None)
        pose = compose(pose, step)
        prior.accept(k * PERIOD_NS, pose, SURE, step, SURE, False, False, False)
    other = copy.deepcopy(prior)
    stands = prior.predict(378 * PERIOD_NS, pose, np.zeros((3, 3)), None, True)
    drives = other.predict(378 * PERIOD_NS, pose, np.zeros((3, 3)), None, False)
    assert stands.standing and not drives.standing
    constant, sped_up = (np.hypot(*between(pose, each.mean)[:2]) for each in (stands, drives))
    assert constant + 0.001 < sped_up < 1.2 * step[0]


def along_a_corridor(counted: Callable[[float], float], seconds: float) -> tuple[np.ndarray, list[Prediction]]:
    """The last pose and all predictions in a corridor that tells no motion along it: each pose is as predicted.

    Wheels ``counted`` so many metres by a time (s).
    """
    prior, pose, wheels, found = MotionPrior(MotionPriorConfig()), np.zeros(3), WheelOdometry(), []
    wheels.add(0, np.zeros(3))
    prior.begin(0, pose, wheels)
    for k in range(1, round(10 * seconds) + 1):
        wheels.add(k * PERIOD_NS, np.array((counted(0.1 * k), 0.0, 0.0)))
        prediction = prior.predict(k * PERIOD_NS, pose, SURE, wheels)
        covariance = np.diag((prediction.covariance[0, 0], 1e-6, 1e-8))
        step, pose = between(pose, prediction.mean), prediction.mean
        passes = k % 4 == 0
        prior.accept(k * PERIOD_NS, pose, covariance, step, covariance, passes, passes, False)
        found.append(prediction)
    return pose, found


def test_wheels_that_freeze_are_carried_on_and_count_again() -> None:
    pose, found = along_a_corridor(lambda t: 0.7 * (min(t, 2.0) if t < 3.0 else t), 2.9)
    assert pose[0] == pytest.approx(0.7 * 2.9, abs=0.02)
    assert not any(prediction.by_wheels for prediction in found[20:])
    pose, found = along_a_corridor(lambda t: 0.7 * min(t, 2.0) if t < 3.0 else 0.7 * t + 0.1, 3.0)
    assert pose[0] == pytest.approx(0.7 * 3.0 + 0.1, abs=1e-6)  # by their whole way, slip or not
    assert found[-1].measured and math.sqrt(found[-1].covariance[0, 0]) < 0.4


def test_wheels_that_begin_anew_after_a_freeze_do_not_count() -> None:
    """The robot's base was started again: its pose is zero."""
    pose, found = along_a_corridor(lambda t: 0.7 * min(t, 12.0) if t < 12.5 else 0.7 * (t - 12.5), 13.0)
    assert pose[0] == pytest.approx(0.7 * 13.0, abs=0.1)
    assert not found[124].measured


def test_wheels_that_begin_anew_with_another_heading_do_not_count() -> None:
    """It turns on the spot; the wheels are silent for a second, and begin anew at zero. Walls tell every pose."""
    prior, pose, wheels = MotionPrior(MotionPriorConfig()), np.zeros(3), WheelOdometry()
    wheels.add(0, np.zeros(3))
    prior.begin(0, pose, wheels)
    for k in range(1, 41):
        if k <= 20 or k >= 30:
            wheels.add(k * PERIOD_NS, np.array((0.0, 0.0, 0.1 * (k if k <= 20 else k - 30))))
        prediction = prior.predict(k * PERIOD_NS, pose, SURE, wheels)
        assert abs(between(pose, prediction.mean)[2] - 0.1) < 0.06
        step, pose = np.array((0.0, 0.0, 0.1)), np.array((0.0, 0.0, 0.1 * k))
        prior.accept(k * PERIOD_NS, pose, SURE, step, SURE, k % 4 == 0, k % 4 == 0, False)


def test_a_freeze_of_many_seconds_moves_no_robot_back_that_walls_hold() -> None:
    """Wheels are believed to freeze for 2 s at most. These freeze for 3 s, and for one scan both may be right."""
    wheels, prior = begun(np.zeros(3))
    step = np.array((0.07, 0.0, 0.0))
    for k in range(1, 42):
        wheels.add(k * PERIOD_NS, min(k, 20) * step)
        prediction = prior.predict(k * PERIOD_NS, (k - 1) * step, SURE, wheels)
        off = (prediction.mean - k * step)[0]
        assert abs(off) < 3.0 * math.sqrt(prediction.covariance[0, 0])
        assert any(abs(start[0] - k * step[0]) < 0.1 for start in prediction.starts)
        prior.accept(k * PERIOD_NS, k * step, SURE, step, SURE, k % 4 == 0, k % 4 == 0, False)
    assert not prediction.measured


def test_silent_wheels_that_were_doubted_count_from_the_scan_after_their_slip() -> None:
    """They are extrapolated for half a second before they count as silent."""
    (wheels, prior), step = begun(np.zeros(3)), np.array((0.07, 0.0, 0.0))
    for k in range(1, 41):
        if k <= 20 or k > 30:
            wheels.add(k * PERIOD_NS, k * step + np.array((0.5 if k > 15 else 0.0, 0.0, 0.0)))
        prediction = prior.predict(k * PERIOD_NS, (k - 1) * step, SURE, wheels)
        assert prediction.by_wheels == (k <= 25 or k > 30)
        if k == 25:
            prior.judge(slips=True)
        if k > 30:
            assert prediction.measured and prediction.mean[0] == pytest.approx(k * step[0], abs=0.05)
        prior.accept(k * PERIOD_NS, k * step, SURE, step, SURE, False, False, False)


@pytest.mark.parametrize("heading", [0.0, 2.0])
def test_a_slip_that_lasts_is_compared_with_the_velocity_before_it(heading: float) -> None:
    """Scans that follow slipping wheels measure their turn as the velocity. The robot cannot have begun it at once."""
    start, straight = np.array((1.0, -2.0, heading)), np.array((0.05, 0.0, 0.0))
    (wheels, prior), pose, truth = begun(start), start, start
    for k in range(1, 25):
        slips = k > 20
        step = np.array((0.05, 0.0, 0.12 if slips else 0.0))
        counted, truth = compose(pose, step), compose(truth, straight)
        wheels.add(k * PERIOD_NS, counted)
        prediction = prior.predict(k * PERIOD_NS, pose, SURE, wheels)
        by_velocity = prior.without_slip(k * PERIOD_NS, pose, SURE, wheels, prediction)
        assert (by_velocity is not None) == slips
        if by_velocity is not None:
            other, velocity = by_velocity
            assert velocity == pytest.approx(straight / (PERIOD_NS * 1e-9), abs=0.01)
            assert other.starts[0] == pytest.approx(truth, abs=0.01)
            assert math.sqrt(other.covariance[2, 2]) > 0.12 * (k - 20)
        prior.accept(k * PERIOD_NS, counted, SURE, step, SURE, k % 4 == 0, k % 4 == 0, False)
        pose = counted


def test_a_slip_since_the_last_key_scan_is_noticed_after_its_end() -> None:
    """Walls told the right turn of each scan, and the wheels count right again. Since the key scan they are wrong."""
    (wheels, prior), truth, counted = begun(np.zeros(3)), np.zeros(3), np.zeros(3)
    step, slip = np.array((0.05, 0.0, 0.0)), np.array((0.05, 0.0, 0.1))
    for k in range(1, 25):
        counted, last, truth = compose(counted, slip if 20 < k < 24 else step), truth, compose(truth, step)
        wheels.add(k * PERIOD_NS, counted)
        prediction = prior.predict(k * PERIOD_NS, last, SURE, wheels)
        other = prior.without_slip(k * PERIOD_NS, last, SURE, wheels, prediction)
        prior.accept(k * PERIOD_NS, truth, SURE, step, SURE, k == 20, k == 20, False)
    assert prediction.measured and prediction.mean[2] == pytest.approx(0.3)
    assert other is not None and other[0].mean == pytest.approx(truth, abs=1e-6)


def test_a_slip_goes_on_until_the_wheels_agree_with_the_velocity() -> None:
    (wheels, prior), truth, counted = begun(np.zeros(3)), np.zeros(3), np.zeros(3)
    step, slip = np.array((0.05, 0.0, 0.0)), np.array((0.05, 0.0, 0.1))
    for k in range(1, 31):
        counted = compose(counted, slip if 20 < k <= 24 else step)
        wheels.add(k * PERIOD_NS, counted)
        prediction = prior.predict(k * PERIOD_NS, truth, SURE, wheels)
        last, truth = truth, compose(truth, step)
        other = prior.without_slip(k * PERIOD_NS, last, SURE, wheels, prediction) if prediction.measured else None
        assert prior.slips == (21 < k <= 24)
        if other is not None:
            prior.judge(slips=True)
        prior.accept(k * PERIOD_NS, truth, SURE, step, SURE, k % 4 == 0, k % 4 == 0, False)


def test_walls_judge_whether_wheels_slip() -> None:
    """After a slip the next prior counts from the scan before. Wheels that are right slip no longer."""
    (wheels, prior), truth = begun(np.zeros(3)), np.zeros(3)
    for k, off in ((1, 0.0), (2, 0.1), (3, 0.1)):
        wheels.add(k * PERIOD_NS, np.array((0.05 * k, 0.0, off)))
        prediction = prior.predict(k * PERIOD_NS, truth, SURE, wheels)
        assert prediction.mean[2] == pytest.approx(0.1 if k == 2 else 0.0)
        if k == 2:
            prior.judge(slips=True)
            assert prior.slips
        truth = np.array((0.05 * k, 0.0, 0.0))
        prior.accept(k * PERIOD_NS, truth, SURE, np.array((0.05, 0.0, 0.0)), SURE, False, False, False)
    prior.judge(slips=False)
    assert not prior.slips


def test_wheels_that_count_again_are_compared_with_no_velocity_that_nothing_measured() -> None:
    """They froze for 1.2 s, in which the robot sped up from 0.5 to 1.7 m/s."""
    (wheels, prior), truth, counted = begun(np.zeros(3)), np.zeros(3), np.zeros(3)
    for k in range(1, 40):
        step = np.array((0.05 + 0.01 * min(max(k - 20, 0), 12), 0.0, 0.0))
        last, truth = truth, truth + step
        counted = counted if 20 < k <= 32 else truth
        wheels.add(k * PERIOD_NS, counted)
        prediction = prior.predict(k * PERIOD_NS, last, SURE, wheels)
        if k > 20 and prediction.measured:
            assert prior.without_slip(k * PERIOD_NS, last, SURE, wheels, prediction) is None
        prior.accept(k * PERIOD_NS, truth, SURE, step, SURE, k % 4 == 0, k % 4 == 0, False)
