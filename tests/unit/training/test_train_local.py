"""The local network's training: metrics on paper, and a calibration that removes bias and scale."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from ngo_estimator.checkpoint import LOCAL, save_checkpoint
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_recordings.errors import RecordingError
from training.common.step_losses import HEADING_WEIGHT, step_losses, step_metrics
from training.data.batches import Batch
from training.data.worlds import WORLDS
from training.recordings.recording_source import RecordedArguments
from training.train_local import (
    Arguments,
    SimulatedSteps,
    calibrated,
    initial_network,
    measure,
    stretch_losses,
)


@pytest.fixture
def network() -> LocalPoseNetwork:
    torch.manual_seed(0)
    return LocalPoseNetwork(LocalPoseConfig(WORLDS["maze2d"].image, width=0.03, actions=3, period_s=0.1)).eval()


def pairs_with_truth(network: LocalPoseNetwork, scale: Tensor, bias: Tensor) -> list[Batch]:
    """Frames whose true motion is the network's estimate, scaled and shifted."""
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(201, 1, 241, 4, generator=generator)
    batch = {"earlier": images[:-1], "later": images[1:], "action": torch.arange(200) % 3}
    with torch.no_grad():
        batch["relative"] = network(*batch.values())[0] * scale + bias
    return [batch]


def test_metrics_on_paper() -> None:
    truth = torch.zeros(2, 3)
    mean = torch.tensor([[0.3, 0.4, 0.0], [0.1, 0.0, np.radians(2.0)]])
    log_std = torch.log(torch.tensor([[0.3, 0.2, 1.0], [0.1, 1.0, np.radians(1.0)]]))
    metrics = step_metrics(mean, log_std, truth)
    assert metrics["rmse_m"] == pytest.approx(np.sqrt((0.25 + 0.01) / 2))
    assert metrics["rmse_deg"] == pytest.approx(np.sqrt(2.0))
    assert metrics["bias_forward_m"] == pytest.approx(0.2)
    assert metrics["bias_deg"] == pytest.approx(1.0)
    # Errors in deviations: 1, 2, 0, 1, 0, 2.
    assert metrics["normalized_error"] == pytest.approx(np.sqrt((1 + 4 + 0 + 1 + 0 + 4) / 6))


def heading_loss(errors: list[float], windows: tuple[int, ...]) -> float:
    """The loss of steps whose headings are so many deviations off, by the weight that headings have."""
    mean = torch.zeros(1, len(errors), 3)
    mean[0, :, 2] = torch.tensor(errors) * 0.5
    truth, std = torch.zeros_like(mean), torch.tensor([1.0, 1.0, 0.5])
    return float(step_losses(mean, torch.zeros_like(mean), truth, std, windows)[0]) * 3 / HEADING_WEIGHT


def test_errors_that_last_cost_more_over_windows_and_errors_that_cancel_less() -> None:
    # Smooth-L1 is |e| - 0.05 from 0.1 on.
    assert heading_loss([1.0, 1.0, 1.0, 1.0], (1,)) == heading_loss([1.0, -1.0, 1.0, -1.0], (1,)) == pytest.approx(0.95)
    assert heading_loss([1.0, 1.0, 1.0, 1.0], (4,)) == pytest.approx(4 / 2 - 0.05)
    assert heading_loss([1.0, -1.0, 1.0, -1.0], (4,)) == 0.0
    # Of windows of two there are three, whose sums are 2, 1 and 0.
    two = np.array([2.0, 1.0]) / np.sqrt(2.0) - 0.05
    assert heading_loss([1.0, 1.0, 0.0, 0.0], (2,)) == pytest.approx(two.sum() / 3)
    assert heading_loss([1.0, 1.0, 0.0, 0.0], (1, 2)) == pytest.approx((two.sum() / 3 + 0.95 / 2) / 2)


def test_windows_do_not_reach_from_one_stretch_of_a_batch_into_the_next(network: LocalPoseNetwork) -> None:
    (pairs,) = pairs_with_truth(network, torch.ones(3), torch.zeros(3))
    pairs = {name: values[:8] for name, values in pairs.items()}
    # The first stretch is off to one side, the second to the other: across the border they would cancel.
    pairs["relative"] += torch.tensor([[0.0, 0.0, 0.4]] * 4 + [[0.0, 0.0, -0.4]] * 4)
    told = LocalPoseNetwork(dataclasses.replace(network.config, action_history=2))
    told.load_state_dict(told.state_dict() | network.state_dict())
    pairs["action"] = pairs["action"].unsqueeze(1).expand(8, 2)
    with torch.no_grad():
        alone, both = (float(stretch_losses(told, pairs, windows)[0]) for windows in ((1,), (4,)))
    each = (0.4 - 0.05) * HEADING_WEIGHT / 3  # of what is seen, and as long as it is what is said
    assert alone == pytest.approx(2 * each, rel=1e-4)
    assert both == pytest.approx(each + (2 * 0.4 - 0.05) * HEADING_WEIGHT / 3, rel=1e-4)


def test_what_earlier_actions_tell_leaves_alone_what_is_seen() -> None:
    torch.manual_seed(0)
    config = LocalPoseConfig(WORLDS["maze2d"].image, 0.03, 3, period_s=0.1, action_history=4)
    network = LocalPoseNetwork(config)
    generator = torch.Generator().manual_seed(1)
    images = torch.rand(9, 1, 241, 4, generator=generator)
    batch = {"earlier": images[:-1], "later": images[1:], "relative": torch.rand(8, 3, generator=generator)}
    batch["action"] = torch.randint(0, 3, (8, 4), generator=generator)

    def gradients(windows: tuple[int, ...]) -> dict[str, Tensor]:
        network.zero_grad()
        sum(stretch_losses(network, batch, windows)).backward()  # type: ignore[union-attr]
        return {name: value.grad.clone() for name, value in network.named_parameters() if value.grad is not None}

    of_steps, of_windows = gradients((1,)), gradients((1, 4))
    seeing = {name for name in of_steps if not name.startswith("fusion")}
    assert all(torch.equal(of_steps[name], of_windows[name]) for name in seeing) and len(seeing) > 10
    assert not torch.equal(of_steps["fusion.4.weight"], of_windows["fusion.4.weight"])


def test_calibration_removes_bias_and_scale(network: LocalPoseNetwork) -> None:
    scale, bias = torch.tensor([1.3, 0.8, 0.5]), torch.tensor([0.1, -0.02, 0.01])
    pairs = pairs_with_truth(network, scale, bias)
    assert measure(network, pairs)["rmse_m"] > 0.05
    config = calibrated(network, pairs)
    assert config.relative_bias == pytest.approx(tuple(bias.tolist()), abs=1e-4)
    assert config.relative_std == pytest.approx(tuple(scale.tolist()), rel=1e-3)
    better = LocalPoseNetwork(config).eval()
    better.load_state_dict(network.state_dict())
    metrics = measure(better, pairs)
    assert metrics["rmse_m"] < 1e-4 and metrics["rmse_deg"] < 1e-2


def test_calibration_of_a_symmetric_network_removes_what_is_to_one_side(network: LocalPoseNetwork) -> None:
    symmetric = LocalPoseNetwork(
        dataclasses.replace(network.config, symmetric=True, mirrored_actions=(0, 2, 1), relative_mean=(0.1, 0.02, 0.03))
    ).eval()
    symmetric.load_state_dict(network.state_dict())
    pairs = pairs_with_truth(symmetric, torch.tensor([1.2, 0.9, 1.1]), torch.tensor([0.0, 0.01, -0.02]))
    better = LocalPoseNetwork(calibrated(symmetric, pairs)).eval()
    better.load_state_dict(network.state_dict())
    metrics = measure(better, pairs)
    assert metrics["rmse_m"] < 1e-4 and metrics["rmse_deg"] < 1e-2


def test_a_component_that_was_not_learned_keeps_a_positive_deviation(network: LocalPoseNetwork) -> None:
    pairs = pairs_with_truth(network, torch.tensor([-1.0, 1.0, 1.0]), torch.tensor([0.4, 0.0, 0.0]))
    config = calibrated(network, pairs)
    assert min(config.relative_std) > 0.0
    better = LocalPoseNetwork(config).eval()
    better.load_state_dict(network.state_dict())
    assert abs(measure(better, pairs)["bias_forward_m"]) < 1e-4


def begun_with(folder: Path, **changes: Any) -> LocalPoseNetwork:
    arguments = Arguments(world="maze2d", recordings=RecordedArguments(from_weights=folder))
    world = dataclasses.replace(WORLDS["maze2d"], **changes)
    return initial_network(arguments, world, SimulatedSteps(arguments, world))[0].eval()


def test_weights_to_begin_with_see_as_before_and_are_told_more(network: LocalPoseNetwork, tmp_path: Path) -> None:
    save_checkpoint(tmp_path / f"{LOCAL}.safetensors", network, LOCAL, "maze2d", {})
    begun = begun_with(tmp_path, action_history=5, mirrors=False)
    assert begun.config.action_history == 5 and not begun.config.symmetric
    (pairs,) = pairs_with_truth(network, torch.ones(3), torch.zeros(3))
    with torch.no_grad():
        told = torch.randint(0, 3, (200, 5), generator=torch.Generator().manual_seed(2))
        told[:, -1] = pairs["action"]
        torch.testing.assert_close(begun(pairs["earlier"], pairs["later"], told)[0], pairs["relative"])
    assert begun_with(tmp_path).config.symmetric
    save_checkpoint(tmp_path / f"{LOCAL}.safetensors", begun, LOCAL, "maze2d", {})
    assert torch.equal(begun_with(tmp_path, action_history=5).fusion[0].weight, begun.fusion[0].weight)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": 0}, "takes actions, maze2d has images alone"),
        ({"action_history": 4}, "takes the latest 5 actions; expected 1 or 4"),
        ({"image": WORLDS["maze3d"].image}, "takes ImageFormat.*; expected ImageFormat"),
    ],
)
def test_weights_that_know_other_things_are_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    config = LocalPoseConfig(WORLDS["maze2d"].image, width=0.03, actions=3, period_s=0.1, action_history=5)
    save_checkpoint(tmp_path / f"{LOCAL}.safetensors", LocalPoseNetwork(config), LOCAL, "maze2d", {})
    with pytest.raises(RecordingError, match=message):
        begun_with(tmp_path, **changes)


def test_deviations_of_many_steps_hold_errors_that_last(network: LocalPoseNetwork) -> None:
    (pairs,) = pairs_with_truth(network, torch.ones(3), torch.zeros(3))
    generator = torch.Generator().manual_seed(3)
    lasting = torch.randn(8, 1, 3, generator=generator).expand(8, 25, 3).flatten(0, 1)  # 25 steps each
    pairs["relative"] = pairs["relative"] + 0.01 * lasting
    of_steps, of_many = (torch.tensor(calibrated(network, [pairs], steps).deviation_scale) for steps in (1, 25))
    assert (of_many > 1.5 * of_steps).all()
