"""The odometry of local networks alone, on validation mazes."""

import json

import numpy as np
import pytest

from ngo_sim.episodes import Episode
from training import evaluate_odometry
from training.evaluate_odometry import Arguments
from training.scoring import validation_steps
from training.scoring.validation_steps import true_steps


def test_a_heading_error_that_lasts_adds_up(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def steps(_: object, __: object, episode: Episode) -> np.ndarray:
        return true_steps(episode) + np.array([0.0, 0.0, 1e-3])

    monkeypatch.setattr(validation_steps, "estimated_steps", steps)
    result = evaluate_odometry.main(Arguments("maze2d", driver="random", mazes=2, frames=130))
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == result
    assert (result["driver"], result["mazes"], result["frames"]) == ("random", 2, 130)
    (network,) = result["networks"]
    assert network["rmse_deg"]["mean"] == pytest.approx(np.degrees(1e-3))
    assert network["rpe_100_deg"]["mean"] == pytest.approx(np.degrees(0.1))
    assert network["rmse_m"]["mean"] == pytest.approx(0.0, abs=1e-12) and network["final_percent"]["mean"] > 0.0


def test_the_shipped_network_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    result = evaluate_odometry.main(Arguments("maze2d", mazes=2, frames=130))
    (network,) = result["networks"]
    assert 0.0 < network["rmse_deg"]["mean"] < 0.2 and 0.0 < network["final_percent"]["mean"] < 2.0
    assert network["sha256"][:8] in capsys.readouterr().out


def test_drives_shorter_than_what_is_measured_are_refused() -> None:
    with pytest.raises(ValueError, match="frames is 100; expected more than 100"):
        Arguments("maze2d", frames=100)
