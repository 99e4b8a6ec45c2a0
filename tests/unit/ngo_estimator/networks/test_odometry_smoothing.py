"""What smooths the odometry: fresh it changes nothing, and it looks so far and no farther."""

from dataclasses import replace

import pytest
import torch

from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from tests.unit.ngo_estimator.samples import small_optimizer, trajectory_inputs

STD = (0.1, 0.02, 0.05)
CONFIG = SmootherConfig(6, STD, (1, 2, 4), 8)


def random_smoother(config: SmootherConfig = CONFIG) -> OdometrySmoother:
    torch.manual_seed(0)
    smoother = OdometrySmoother(config).requires_grad_(False)
    for parameter in smoother.parameters():
        parameter.add_(0.3 * torch.randn_like(parameter))
    return smoother


def test_a_fresh_smoother_returns_the_odometry_exactly() -> None:
    relative, log_std, motion, _ = trajectory_inputs(2, 40)
    smoothed, deviations = OdometrySmoother(CONFIG)(relative, log_std, motion)
    assert torch.equal(smoothed, relative) and torch.equal(deviations, log_std)


def test_a_step_depends_on_those_within_the_dilations_and_no_others() -> None:
    smoother, (relative, log_std, motion, _) = random_smoother(), trajectory_inputs(1, 60)
    before, _ = smoother(relative, log_std, motion)
    motion[0, 30] += 1.0
    after, _ = smoother(relative, log_std, motion)
    moved = (after - before).abs().sum(-1)[0].nonzero()[:, 0]
    assert (int(moved[0]), int(moved[-1])) == (30 - 7, 30 + 7)


def test_a_causal_one_corrects_by_what_was_before_and_needs_no_more_of_it_than_it_says() -> None:
    smoother, (relative, log_std, motion, _) = random_smoother(replace(CONFIG, causal=True)), trajectory_inputs(1, 60)
    before, deviations = smoother(relative, log_std, motion)
    latest = [values[0, 60 - smoother.config.reach - 1 :] for values in (relative, log_std, motion)]
    last, last_deviation = smoother(*latest)
    torch.testing.assert_close(last[-1], before[0, -1])
    torch.testing.assert_close(last_deviation[-1], deviations[0, -1])
    motion[0, 30] += 1.0
    after, _ = smoother(relative, log_std, motion)
    moved = (after - before).abs().sum(-1)[0].nonzero()[:, 0]
    assert (int(moved[0]), int(moved[-1])) == (30, 30 + smoother.config.reach)


def test_what_was_fitted_to_held_out_drives_is_added_to_each_step() -> None:
    inputs = trajectory_inputs(1, 30)[:3]
    plain, fitted = (
        random_smoother(replace(CONFIG, **changes))
        for changes in ({}, {"relative_bias": (0.01, 0.0, -0.02), "deviation_scale": (2.0, 1.0, 0.5)})
    )
    (steps, deviations), (moved, scaled) = plain(*inputs), fitted(*inputs)
    torch.testing.assert_close(moved - steps, torch.tensor([0.01, 0.0, -0.02]).expand_as(steps))
    torch.testing.assert_close((scaled - deviations).exp(), torch.tensor([2.0, 1.0, 0.5]).expand_as(steps))


@pytest.mark.parametrize(("form", "blocks"), [("loops", 2), ("smoothed", 6), ("gauss_newton", 0)])
def test_blocks_depend_on_so_many_others_and_no_more(form: str, blocks: int) -> None:
    optimizer, (relative, log_std, motion, _) = small_optimizer(form, trained=True), trajectory_inputs(1, 240)
    assert optimizer.config.context == blocks
    before = optimizer.aggregate(relative, log_std, motion)
    # The outermost steps of a block are what reaches farthest.
    for step, side in ((15 * 8, -1), (15 * 8 + 7, 1)):
        changed = relative.clone()
        changed[0, step] += 0.1
        after = optimizer.aggregate(changed, log_std, motion)
        moved = (after.relative - before.relative).abs().sum(-1)
        if before.features is not None and after.features is not None:
            moved = moved + (after.features - before.features).abs().sum(-1)
        farthest = moved[0].nonzero()[:, 0][0 if side < 0 else -1]
        assert int(farthest) == 15 + side * blocks


def test_a_step_over_lost_frames_is_corrected_no_more_than_others_and_does_not_drown_its_neighbours() -> None:
    smoother, (relative, log_std, motion, _) = random_smoother(), trajectory_inputs(1, 40)
    relative[0, 20] = torch.tensor([50.0, -3.0, 3.0])
    log_std[0, 20] = 3.0
    smoothed, deviations = smoother(relative, log_std, motion)
    assert ((smoothed - relative).abs() <= torch.tensor(STD)).all()
    assert ((deviations - log_std).abs() <= 2.0).all()
    relative[0, 20] *= 1e3
    again, _ = smoother(relative, log_std, motion)
    others = torch.arange(40) != 20
    assert torch.equal(again[:, others], smoothed[:, others])


def test_an_optimizer_keeps_all_but_its_smoother() -> None:
    smoothed, plain = small_optimizer("smoothed", trained=True), small_optimizer("loops", trained=True)
    without = smoothed.with_smoother(None)
    assert without.config.smoother is None
    of_another = plain.with_smoother(smoothed.smoother)
    assert of_another.config == smoothed.config
    for changed, of in ((without, smoothed), (of_another, plain)):
        kept = {name: value for name, value in of.state_dict().items() if not name.startswith("smoother.")}
        assert all(torch.equal(changed.state_dict()[name], value) for name, value in kept.items())
    copied, original = of_another.smoother.state_dict(), smoothed.smoother.state_dict()
    assert copied.keys() == original.keys() and all(torch.equal(copied[name], original[name]) for name in copied)
