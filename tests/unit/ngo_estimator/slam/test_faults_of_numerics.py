"""A fault of numerics costs an optimisation, or loops. The trajectory goes on by odometry, and says so."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_estimator.loops.place_loop_finder import PlaceLoopFinder
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.slam import odometry_blocks
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.trajectory_update import TrajectoryUpdate

WEIGHTS = Path(__file__).parents[4] / "ros_ws/src/ngo_estimator/weights"


@pytest.fixture(scope="module")
def maze2d() -> OnlineTrajectory:
    return OnlineTrajectory.load(WEIGHTS / "maze2d", world="maze2d", iterations_per_step=1)


@pytest.fixture(scope="module")
def maze3d() -> OnlineTrajectory:
    return OnlineTrajectory.load(WEIGHTS / "maze3d", world="maze3d", iterations_per_step=1)


def drive(core: OnlineTrajectory, count: int, size: float = 1.0) -> list[RelativeStep]:
    """A drive through arcs, with features and codes of no camera, as large as ``size``."""
    rng = np.random.default_rng(0)
    feature_size, code_length = core.feature_sizes
    odom, steps = torch.zeros(3, dtype=torch.float64), []
    for k in range(count):
        relative = np.array([0.1, 0.0, 0.05]) + rng.normal(scale=0.01, size=3)
        odom = se2.compose(odom, torch.from_numpy(relative))
        motion, code = (size * rng.normal(size=length).astype(np.float32) for length in (feature_size, code_length))
        covariance = np.diag((1e-4, 1e-4, 2.5e-5))
        stamps = (k + 1) * 10**8, k * 10**8
        steps.append(RelativeStep(*stamps, relative, covariance, 0, odom.numpy(), motion, code))
    return steps


def take(core: OnlineTrajectory, steps: list[RelativeStep]) -> list[TrajectoryUpdate]:
    core.reset()
    updates = [core.update(step) for step in steps]
    for update in updates:
        assert np.isfinite(update.pose_xyyaw).all() and np.isfinite(update.covariance).all()
        assert np.linalg.eigvalsh(update.covariance)[0] > 0.0 and not update.restarted
    trajectory = core.trajectory()
    assert trajectory is not None and len(trajectory.stamps_ns) == len(steps) + 1
    assert np.isfinite(trajectory.poses_xyyaw).all() and np.isfinite(trajectory.odometry_std).all()
    return updates


@pytest.mark.parametrize("world", ["maze2d", "maze3d"])
@pytest.mark.parametrize("variance", [1e4, 1e300])
@pytest.mark.parametrize("places", ["x and y", "all"])
def test_huge_variances_and_unusual_codes_break_nothing(
    world: str, variance: float, places: str, request: pytest.FixtureRequest
) -> None:
    core = request.getfixturevalue(world)
    huge = np.array([variance, variance, 2.5e-5 if places == "x and y" else variance])
    for size, which in ((1.0, range(48)), (2000.0, range(30, 48)), (1.0, range(37, 38))):
        steps = drive(core, 48, size)
        for k in which:
            steps[k] = replace(steps[k], covariance=np.diag(huge))
        assert {update.fault for update in take(core, steps)} == {""}


@pytest.mark.parametrize(
    ("owner", "name", "complaint"),
    [
        (odometry_blocks, "registered_steps", "the registration of steps failed, LinAlgError: singular"),
        (PlaceLoopFinder, "_find_places", "the search for loops failed, LinAlgError: singular"),
        (PlaceLoopFinder, "_find_overlaps", "the search for loops failed, LinAlgError: singular"),
        (PlaceLoopFinder, "for_optimizer", "an optimisation failed, LinAlgError: singular"),
        (NeuralGraphOptimizer, "iterate", "an optimisation failed, LinAlgError: singular"),
    ],
)
def test_what_fails_once_is_said_once_and_costs_nothing_else(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, complaint: str
) -> None:
    core = request.getfixturevalue("maze3d" if name == "_find_overlaps" else "maze2d")
    whole, calls = getattr(owner, name), 0

    def fails_once(*arguments: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == 3:
            raise np.linalg.LinAlgError("singular")
        return whole(*arguments, **named)

    monkeypatch.setattr(owner, name, fails_once)
    updates = take(core, drive(core, 64))
    assert calls > 3 and [update.fault for update in updates if update.fault] == [complaint]
    assert updates[-1].frames == 65 and any(update.optimized for update in updates[56:])


def test_poses_that_are_no_numbers_are_not_taken(maze2d: OnlineTrajectory, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = drive(maze2d, 64)
    whole, begun = NeuralGraphOptimizer.iterate, 0

    def broken(*arguments: Any, **named: Any) -> Any:
        nonlocal begun
        begun += 1
        this = begun
        for result in whole(*arguments, **named):
            if this == 4:
                result.meta_relative[-1][0, 1, 0] = torch.nan
            yield result

    monkeypatch.setattr(NeuralGraphOptimizer, "iterate", broken)
    updates = take(maze2d, steps)
    faults = {update.fault for update in updates if update.fault}
    assert faults == {"an optimisation failed, ArithmeticError: poses or their covariances came out as no numbers"}
    assert updates[-1].frames == 65 and updates[-1].fault == ""
