"""What is known of motion where frames are unfamiliar, of a robot that is told nothing of it."""

import torch

from ngo_estimator.networks.familiarity import FamiliarityConfig
from training.train_familiarity import Seen, dishonest, fit


def _drive(config: FamiliarityConfig, steps: int = 400) -> Seen:
    truth = torch.tensor([0.1, 0.0, 0.02]) + torch.randn(steps, 3) * torch.tensor([0.03, 0.01, 0.05])
    return Seen(
        looks=torch.randn(steps, config.look_size),
        motions=torch.randn(steps, config.motion_size),
        told=torch.ones(steps, 1),
        relative=truth,
        change=torch.rand(steps) + 0.5,
        truth=truth,
    )


def test_an_unknown_step_is_a_step_of_the_robot_and_limits_of_few_drives_have_a_margin() -> None:
    torch.manual_seed(0)
    config = FamiliarityConfig(8, 4, actions=0, twist=False)
    seen, held_out = [_drive(config)], [_drive(config)]
    fitted = fit(config, seen, held_out).config
    # Deviations of a stretch add up: those of one step must not allow for a stretch.
    assert 0.02 < fitted.told_std[0] < 0.04 and 0.04 < fitted.told_std[2] < 0.06
    wider = fit(config, seen, held_out, margin=1.25).config
    assert [round(b / a, 6) for a, b in zip(fitted.limits, wider.limits, strict=True) if a < 1e8] == [1.25, 1.25, 1.25]


def test_faults_that_stay_outside_of_their_deviations_are_named() -> None:
    assert dishonest({"noise": 0.98, "black": 0.9}) == "black (90.0%)"
    assert dishonest({"noise": 0.97}) == dishonest({}) == ""
