"""What the smoother of the odometry learns from, and that nothing else changes what it has learned."""

import torch

from ngo_estimator import se2
from tests.unit.ngo_estimator.samples import small_optimizer, trajectory_inputs
from training.train_optimizer import Arguments, OptimizerTraining
from training.train_smoother import smoothing_loss
from training.worlds import world_named

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


def test_the_optimizer_that_it_is_part_of_leaves_it_as_it_is() -> None:
    optimizer = small_optimizer("smoothed", trained=True).requires_grad_(True)
    OptimizerTraining(Arguments(world="maze3d", epochs=4), optimizer, world_named("maze3d"))
    learning = {name for name, parameter in optimizer.named_parameters() if parameter.requires_grad}
    assert learning and not any(name.startswith("smoother.") for name in learning)
