"""What the smoother of the odometry learns from, and that nothing else changes what it has learned."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from ngo_estimator.checkpoint import LOCAL, SMOOTHER, load_local, load_smoother, save_checkpoint, write_untrained
from ngo_estimator.geometry import se2
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from tests.unit.ngo_estimator.samples import small_optimizer, trajectory_inputs
from training.common.records import RunError
from training.data.worlds import world_named
from training.recordings.recording_source import RecordedArguments
from training.train_local import Arguments as TrainLocal
from training.train_local import SimulatedSteps, initial_network
from training.train_optimizer import Arguments, OptimizerTraining
from training.train_smoother import Arguments as SmootherArguments
from training.train_smoother import initial_smoother, main, smoothing_loss, with_memory

STEP_STD, META_STD = torch.tensor([0.01, 0.01, 0.004]), torch.tensor([0.05, 0.04, 0.02])


def loss(error: torch.Tensor, log_std: float = -4.0) -> torch.Tensor:
    """The loss of steps ``(1, steps, 3)`` that are off by ``error``."""
    steps = trajectory_inputs(1, error.shape[1])[0].double()
    return smoothing_loss(
        steps + error, torch.full_like(steps, log_std), se2.r2g(steps), STEP_STD.double(), META_STD.double()
    )


def test_errors_that_last_cost_more_than_those_that_alternate() -> None:
    one = 0.004 * torch.ones(1, 256, 3).double()
    lasting, alternating = loss(one), loss(one * (1.0 - 2.0 * (torch.arange(256) % 2))[:, None])
    assert loss(torch.zeros_like(one)) < alternating < 0.5 * lasting
    # Of a stretch that is shorter than the longest window, those that fit count.
    assert torch.isfinite(loss(one[:, :24]))


def test_deviations_learn_from_errors_and_not_the_other_way_round() -> None:
    steps = trajectory_inputs(1, 64)[0].double()
    truth = se2.r2g(steps)
    for log_std in (-6.0, -2.0):
        relative = (steps + 0.003).requires_grad_()
        deviations = torch.full_like(steps, log_std).requires_grad_()
        smoothing_loss(relative, deviations, truth, STEP_STD.double(), META_STD.double()).backward()
        assert relative.grad is not None and deviations.grad is not None
        assert (deviations.grad.sum() < 0.0) == (log_std == -6.0)  # too sure of itself, or too little
        gradient = relative.grad
        again = (steps + 0.003).requires_grad_()
        smoothing_loss(again, torch.full_like(steps, -3.0), truth, STEP_STD.double(), META_STD.double()).backward()
        torch.testing.assert_close(again.grad, gradient)


def test_it_begins_with_the_weights_that_are_given_and_says_so(tmp_path: Path) -> None:
    write_untrained(tmp_path, "maze3d")
    local, description = load_local(tmp_path)
    smoother = OdometrySmoother(SmootherConfig(local.config.feature_size, local.config.relative_std, (1, 2), 8))
    smoother.head.bias.data.fill_(0.5)
    of = {"local_pose_network_sha256": description["sha256"]}
    save_checkpoint(tmp_path / f"{SMOOTHER}.safetensors", smoother, SMOOTHER, "maze3d", of)
    given = SmootherArguments(world="maze3d", recordings=RecordedArguments(from_weights=tmp_path))
    began, said = initial_smoother(given, local.config)
    assert torch.equal(began.head.bias, smoother.head.bias) and began.head.bias.requires_grad and began.training
    assert said == {"began_with_sha256": load_smoother(tmp_path)[1]["sha256"]}
    fresh, said = initial_smoother(SmootherArguments(world="maze3d"), local.config)
    assert not fresh.head.bias.any() and said == {}
    with pytest.raises(RunError, match="takes 64 motion features; expected 5, as the local network gives"):
        initial_smoother(given, replace(local.config, feature_size=5))


def test_a_memory_becomes_part_of_the_local_network_without_a_bias_on_held_out_drives(tmp_path: Path) -> None:
    tmp_path = tmp_path / "maze3d"
    write_untrained(tmp_path, "maze3d")
    local = load_local(tmp_path)[0]
    torch.manual_seed(0)
    smoother = initial_smoother(SmootherArguments(world="maze3d", memory=True), local.config)[0].requires_grad_(False)
    torch.nn.init.normal_(smoother.head.weight, std=0.05)
    smoother.head.bias += 0.3
    relative, log_std, _, _ = trajectory_inputs(3, 80)
    motion = torch.randn(3, 80, local.config.feature_size)
    held_out = {"relative": relative, "log_std": log_std, "motion": motion, "truth": se2.r2g(relative)}
    found = with_memory(local, smoother, [held_out], 20)
    corrected, deviations = found.remembered(relative, log_std, motion)
    error = corrected - relative
    torch.testing.assert_close(error.mean((0, 1)), torch.zeros(3), atol=1e-6, rtol=0.0)
    sums, variances = (values.unfold(1, 20, 1).sum(-1) for values in (error, (2.0 * deviations).exp()))
    torch.testing.assert_close((sums.square() / variances).mean((0, 1)), torch.ones(3), atol=1e-3, rtol=0.0)
    # Written and read, it is a whole local network; who goes on training that one begins without a memory.
    save_checkpoint(tmp_path / f"{LOCAL}.safetensors", found, LOCAL, "maze3d", {})
    read = load_local(tmp_path)[0]
    assert read.config == found.config
    assert torch.equal(read.remembered(relative, log_std, motion)[0], corrected)
    begun = TrainLocal(world="maze3d", recordings=RecordedArguments(from_weights=tmp_path))
    again, _ = initial_network(begun, world_named("maze3d"), SimulatedSteps(begun, world_named("maze3d")))
    assert again.config.memory is None
    with pytest.raises(RunError, match="has a memory already; expected one as train_local wrote it"):
        main(SmootherArguments(world="maze3d", memory=True, weights=tmp_path.parent))


def test_the_optimizer_that_it_is_part_of_leaves_it_as_it_is() -> None:
    optimizer = small_optimizer("smoothed", trained=True).requires_grad_(True)
    OptimizerTraining(Arguments(world="maze3d", epochs=4), optimizer, world_named("maze3d"))
    learning = {name for name, parameter in optimizer.named_parameters() if parameter.requires_grad}
    assert learning and not any(name.startswith("smoother.") for name in learning)
