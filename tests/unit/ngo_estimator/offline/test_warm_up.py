"""What is compiled before it is needed, and what is said while it lasts."""

import threading
from pathlib import Path

import numpy as np
import pytest

from ngo_estimator.frontend.intake import own_returns
from ngo_estimator.frontend.lidar import motion_mixture, velocity_filter
from ngo_estimator.geometry import branch_and_bound, mode_search, scan_matching, scan_points, scan_registration_kernels
from ngo_estimator.graph import block_cholesky, loop_errors, normal_equations
from ngo_estimator.loops import shared_views_kernel
from ngo_estimator.offline import compiling
from ngo_estimator.offline.warm_up_scans import warm_up_scans
from ngo_estimator.offline.warm_up_trajectory import warm_up_networks
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from tests.unit.ngo_estimator.samples import small_optimizer, small_pair_head
from tests.unit.ngo_estimator.slam.test_online_trajectory import make_steps


def test_what_takes_long_is_said_while_it_lasts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "_SILENT_S", 0.01)
    said = threading.Event()
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        said.set()

    with compiling.compiling(say):
        assert said.wait(30.0)
    assert len(lines) == 1 and lines[0].startswith("compiles, once after an installation")


def test_what_is_short_or_fails_is_not_said(monkeypatch: pytest.MonkeyPatch) -> None:
    timers: list[threading.Timer] = []

    class Kept(threading.Timer):
        def start(self) -> None:
            timers.append(self)
            super().start()

    monkeypatch.setattr(threading, "Timer", Kept)
    lines: list[str] = []
    with compiling.compiling(lines.append):
        pass
    with pytest.raises(ValueError, match="weights"), compiling.compiling(lines.append):
        raise ValueError("weights")
    for timer in timers:
        timer.join(30.0)
    assert len(timers) == 2 and lines == []


WEIGHTS = Path(__file__).parents[4] / "ros_ws/src/ngo_estimator/weights"


def test_registration_and_the_search_for_loops_are_compiled() -> None:
    warm_up_scans()
    points, search = (scan_points._surfaces, own_returns._left_out), (mode_search._modes, branch_and_bound._best_first)
    without_wheels = velocity_filter._predicted, velocity_filter._corrected
    for function in (*points, scan_matching._icp, *search, motion_mixture._calibrated, *without_wheels):
        assert function.signatures, function


@pytest.mark.parametrize("world", ["maze2d", "maze3d"])
def test_all_that_an_update_of_the_shipped_networks_runs_is_compiled(world: str) -> None:
    online = OnlineTrajectory.load(WEIGHTS / world, 2000, world, 128, 1)
    warm_up_networks(online)
    assert online.trajectory() is None
    views = [shared_views_kernel.share_views] if world == "maze3d" else []
    closing = [loop_errors.loop_residuals, loop_errors.odometry_variances, normal_equations._linearise]
    solver = [block_cholesky.factorise, block_cholesky.solve, scan_registration_kernels.register_pairs]
    for function in (*closing, *solver, *views):
        assert function.signatures, function


@pytest.mark.parametrize("form", ["loops", "paper"])
def test_a_trajectory_is_as_new_behind_it(form: str) -> None:
    new, warm = (
        OnlineTrajectory(small_optimizer(form, trained=True), None if form == "paper" else small_pair_head(), 32, 2, 1)
        for _ in range(2)
    )
    warm_up_networks(warm)
    for step in make_steps(40):
        ours, theirs = new.update(step), warm.update(step)
        assert not theirs.fault
        np.testing.assert_array_equal(theirs.pose_xyyaw, ours.pose_xyyaw)
    ours, theirs = new.state(), warm.state()
    assert all(theirs[name].tobytes() == array.tobytes() for name, array in ours.items())
