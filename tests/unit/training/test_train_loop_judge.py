"""What the judge of loops learns."""

import pytest
import torch

from ngo_estimator.ngo.loop_judge import EVIDENCE
from training.train_loop_judge import Arguments, Judged, learn


def test_it_learns_which_loops_are_true_and_how_far_off_these_are() -> None:
    torch.manual_seed(0)
    evidence = torch.randn(400, EVIDENCE)
    true, noisy = evidence[:, 0] > 0.0, evidence[:, 1] > 0.0
    off_m = torch.where(true, torch.where(noisy, 0.4, 0.04), torch.tensor(5.0))
    loops = Judged(evidence, torch.zeros(400, 2), torch.stack((off_m, 0.02 * torch.ones(400)), -1), torch.ones(400))
    logit, factor = learn(loops, 200, 1e-2)(evidence)
    assert ((logit > 0.0) == true).double().mean() > 0.95
    assert factor[true & noisy, 0].mean() > factor[true & ~noisy, 0].mean() + 1.0


def test_it_learns_from_no_drive_that_ranges_are_learned_from() -> None:
    with pytest.raises(ValueError, match="drives is 111; expected 1 to 110"):
        Arguments(drives=111)
