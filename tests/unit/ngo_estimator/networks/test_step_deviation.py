"""Factors on a step's deviations: none before training, bounded after it, the same in numpy and in torch."""

from pathlib import Path

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import save_checkpoint
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.networks.step_deviation import StepDeviation
from ngo_estimator.networks.step_scaling import (
    STEP_DEVIATION,
    STEP_EVIDENCE,
    UNSURE,
    StepDeviationConfig,
    StepScaling,
)


def evidence(steps: int) -> np.ndarray:
    """Evidence of steps that are all sure ``(steps, 12)``."""
    values = np.random.default_rng(3).normal(size=(steps, len(STEP_EVIDENCE)))
    values[:, UNSURE] = 0.0
    return values


def trained() -> StepDeviation:
    """A network whose factors differ from step to step."""
    torch.manual_seed(1)
    network = StepDeviation(StepDeviationConfig())
    torch.nn.init.normal_(network.head.weight)
    return network.requires_grad_(False)


def in_numpy(network: StepDeviation) -> StepScaling:
    return StepScaling(network.config, {name: value.detach().numpy() for name, value in network.state_dict().items()})


def test_untrained_factors_are_one() -> None:
    network = StepDeviation(StepDeviationConfig())
    assert (network(torch.from_numpy(evidence(20)).float()) == 0.0).all()
    assert (in_numpy(network).factors(evidence(1)[0]) == 1.0).all()


def test_one_step_in_numpy_equals_many_in_torch() -> None:
    network, steps = trained(), evidence(50)
    expected = network.double()(torch.from_numpy(steps)).exp().numpy()[:, [0, 0, 1]]
    scaling = in_numpy(network)
    expected = np.maximum(expected, network.config.least)
    np.testing.assert_allclose(np.stack([scaling.factors(step) for step in steps]), expected, rtol=1e-6)
    assert np.ptp(expected[:, 0]) > 0.5


def test_factors_stay_within_their_limits() -> None:
    network, steps = trained(), evidence(1)
    for change, limit in ((100.0, network.config.largest), (-200.0, network.config.least)):
        network.head.bias += change
        np.testing.assert_allclose(in_numpy(network).factors(steps[0]), limit, rtol=1e-6)


def test_an_unsure_step_keeps_its_deviations() -> None:
    network, step = trained(), evidence(1)[0]
    step[UNSURE] = 1.0
    assert (in_numpy(network).factors(step) == 1.0).all()
    assert (network(torch.from_numpy(step).float()) == 0.0).all()


def test_weights_survive_the_disk_and_damage_is_noticed(tmp_path: Path) -> None:
    network, path, step = trained(), tmp_path / f"{STEP_DEVIATION}.safetensors", evidence(1)[0]
    save_checkpoint(path, network, STEP_DEVIATION, "scan", {})
    assert (StepScaling.load(tmp_path, "scan").factors(step) == in_numpy(network).factors(step)).all()
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(CheckpointError, match="sha256"):
        StepScaling.load(tmp_path, "scan")


def test_weights_of_another_shape_are_refused(tmp_path: Path) -> None:
    network = trained()
    network.head = torch.nn.Linear(16, 3)
    save_checkpoint(tmp_path / f"{STEP_DEVIATION}.safetensors", network, STEP_DEVIATION, "scan", {})
    with pytest.raises(CheckpointError, match="does not fit its configuration"):
        StepScaling.load(tmp_path)


@pytest.mark.parametrize("settings", [{"hidden": 0}, {"largest": 1.0}, {"largest": float("inf")}, {"least": 1.5}])
def test_impossible_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="hidden, least, largest"):
        StepDeviationConfig(**settings)  # type: ignore[arg-type]
