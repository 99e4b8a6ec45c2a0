"""The published covariance follows the factors on the steps' deviations, and the poses do not."""

import dataclasses

import numpy as np
import pytest

from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.data.state_arrays import StateError, restore, state_of
from ngo_estimator.geometry.key_scan import KeyScan, no_scan
from ngo_estimator.loops.scan_loops import ScanLoops
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam.own_map import OwnMap
from ngo_estimator.slam.scan_back_end import ScanBackEnd
from tests.unit.ngo_estimator.loops.buildings import HALLWAY, TWICE, between, scan_at

STEP, COVARIANCE = np.array((0.5, 0.0, 0.2)), np.diag((0.02**2, 0.03**2, 0.05**2))


def driven(factors: np.ndarray, keys: int = 6, config: ScanGraphConfig | None = None) -> ScanBackEnd:
    """A graph after steps that each end at a key scan without points."""
    back_end = ScanBackEnd(config or ScanGraphConfig(step_m=1e-6, step_deg=1e-6))
    nothing = np.zeros(0, np.float32)
    for k in range(keys):
        key = KeyScanStep(no_scan(k + 1), k, STEP, COVARIANCE, factors)
        step = RelativeStep(k + 1, k, STEP, COVARIANCE, 0, STEP, nothing, nothing, key=key)
        take(back_end, step)
    return back_end


def take(back_end: ScanBackEnd, step: RelativeStep) -> None:
    """Take a step, the first from the stamp 0, and do the work that it makes due."""
    if step.from_stamp_ns == 0:
        back_end.begin_at(step)
    back_end.append(step)
    back_end.work()


@pytest.mark.parametrize("optimised", [False, True])
def test_the_published_covariance_follows_the_factors_and_the_poses_do_not(optimised: bool) -> None:
    plain, scaled = driven(np.ones(3)), driven(np.full(3, 3.0))
    if optimised:
        for back_end in (plain, scaled):
            back_end._optimise()
    (pose, covariance), (same_pose, larger) = plain.graph.newest(), scaled.graph.newest()
    np.testing.assert_array_equal(same_pose, pose)
    np.testing.assert_allclose(larger, 9.0 * covariance, rtol=1e-6)


def test_optimising_a_chain_without_loops_keeps_its_covariance() -> None:
    back_end = driven(np.array((2.0, 2.0, 0.5)))
    before = back_end.graph.newest()[1]
    back_end._optimise()
    np.testing.assert_allclose(back_end.graph.newest()[1], before, rtol=1e-6)


@pytest.mark.parametrize(("from_key_ns", "registered"), [(0, True), (1, False)])
def test_a_step_in_the_same_key_scans_is_as_sure_as_its_registration(from_key_ns: int, registered: bool) -> None:
    back_end, nothing = ScanBackEnd(ScanGraphConfig(step_m=1e-6, step_deg=1e-6)), np.zeros(0, np.float32)
    for k, key in enumerate((None, KeyScanStep(no_scan(2), from_key_ns, STEP, COVARIANCE))):
        take(back_end, RelativeStep(k + 1, k, STEP, COVARIANCE, 0, STEP, nothing, nothing, key=key))
    covariance = np.linalg.inv(back_end.measurements()[0].information[0])
    assert np.allclose(covariance, COVARIANCE, rtol=1e-3) == registered
    assert covariance[2, 2] == pytest.approx(COVARIANCE[2, 2] * (1.0 if registered else 2.0), rel=1e-6)


def test_a_key_scan_has_no_factors_by_default() -> None:
    key = KeyScanStep(no_scan(1), 0, STEP, COVARIANCE)
    np.testing.assert_array_equal(key.factors, 1.0)
    assert dataclasses.replace(key, factors=np.full(3, 2.0)).factors[0] == 2.0


def test_more_loops_must_agree_where_the_robot_may_be_farther_away_than_was_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The same scans at the same poses: steps that tell little leave room for a place that looks alike.

    There the robot is looked for in its own map, however short its way was.
    """
    sure, lost = (0.02, 0.02, 0.005), (0.5, 0.5, 0.005)
    random = np.random.default_rng(1)
    scans = [dataclasses.replace(scan_at(HALLWAY, pose, random), stamp_ns=k) for k, pose in enumerate(TWICE)]
    usual, wary = ScanGraphConfig(), ScanGraphConfig(agreeing_beyond=1000)
    at_once, _ = first_loop(scans, usual, sure)
    late, agreeing = first_loop(scans, usual, lost)
    assert at_once < late < len(scans) and agreeing >= usual.agreeing_beyond
    assert first_loop(scans, wary, sure)[0] == at_once
    assert late < first_loop(scans, wary, lost)[0] < len(scans)
    monkeypatch.setattr(OwnMap, "look", lambda *_: ScanLoops.none())
    assert first_loop(scans, wary, lost)[0] == len(scans)


def first_loop(scans: list[KeyScan], config: ScanGraphConfig, step_std: tuple[float, float, float]) -> tuple[int, int]:
    """Key scans until the graph has a loop, and how many then agree with it; all, and 0, where it never has any."""
    back_end, nothing, covariance = ScanBackEnd(config), np.zeros(0, np.float32), np.diag(np.square(step_std))
    for k, step in enumerate(between(TWICE[:-1], TWICE[1:])):
        key = KeyScanStep(scans[k + 1], k, step, covariance)
        origin = scans[0] if k == 0 else None
        take(back_end, RelativeStep(k + 1, k, step, covariance, 0, step, nothing, nothing, key=key, origin_scan=origin))
        if len(back_end.measurements()[1].nodes):
            return len(back_end.graph), int(back_end.used_loops.agreeing.max())
    return len(scans), 0


@pytest.mark.parametrize("name", ["_finder._used.rows", "_finder.doubted"])
def test_a_state_with_loops_that_are_not_there_is_refused(name: str) -> None:
    with pytest.raises(StateError, match="not among the 0"):
        restore(ScanBackEnd(ScanGraphConfig()), {**state_of(driven(np.ones(3))), name: np.array((3,))})
