"""What the trainings of places, familiarity and loops learn, and what they begin with."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ngo_estimator.checkpoint import PLACE, PlaceNetworks, load_place, save_checkpoint, write_untrained
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.networks.familiarity import FamiliarityConfig
from ngo_estimator.networks.place_encoder import SeenRanges
from ngo_estimator.ngo.loop_judge import EVIDENCE
from training.common.records import RunError
from training.data.worlds import world_named
from training.recordings.recording_source import RecordedArguments
from training.train_familiarity import Seen, fit, inconsistent
from training.train_loop_judge import Arguments as JudgeArguments
from training.train_loop_judge import Judged, learn
from training.train_place import Arguments, PlaceTraining, initial_networks

WORLD = world_named("maze3d")
REGISTRATION = RegistrationConfig(9, 90.0, 0.01, odometry=False)


def networks(folder: Path, registration: RegistrationConfig | None = REGISTRATION) -> PlaceNetworks:
    """Untrained ones that see ranges."""
    write_untrained(folder, "maze3d")
    torch.manual_seed(0)
    return PlaceNetworks(dataclasses.replace(load_place(folder)[0].config, registration=registration))


def test_ranges_are_learned_of_the_frames_that_they_belong_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    training = PlaceTraining(Arguments("maze3d"), WORLD, networks(tmp_path))
    pictures = torch.randint(0, 256, (2, 4, 60, 80, 3), dtype=torch.uint8)
    ranges = 1.0 + 9.0 * torch.rand(4, 2, 9)
    truth = {pictures[k, row].numpy().tobytes(): ranges[row, k] for k in range(2) for row in range(4)}

    def see(images: Tensor) -> tuple[Tensor, SeenRanges]:
        log_range = torch.stack([truth[image.numpy().tobytes()] for image in images]).log()
        return torch.randn(len(images), 128), SeenRanges(log_range, torch.full_like(log_range, -3.0))

    monkeypatch.setattr(training.networks.encoder, "see", see)
    batch = {"a": pictures[0], "b": pictures[1], "poses": torch.zeros(4, 2, 3), "maze": torch.arange(4)}
    assert training({**batch, "ranges": ranges}, augment=False)["median_range_percent"] == 0.0
    assert training({**batch, "ranges": ranges.flip(1)}, augment=False)["median_range_percent"] > 10.0


def test_weights_that_see_ranges_learn_on_from_recordings_without_them(tmp_path: Path) -> None:
    begun = networks(tmp_path)
    save_checkpoint(tmp_path / f"{PLACE}.safetensors", begun, PLACE, "maze3d", {})
    arguments = Arguments("maze3d", recordings=RecordedArguments(from_weights=tmp_path))
    of_recordings = dataclasses.replace(WORLD, registration=None)
    plain, said = initial_networks(arguments, of_recordings)
    assert plain.config.registration is None and plain.training and "began_with_sha256" in said
    assert torch.equal(plain.encoder.code.weight, begun.encoder.code.weight)
    seeing, _ = initial_networks(arguments, dataclasses.replace(WORLD, registration=REGISTRATION))
    assert torch.equal(seeing.encoder.ranges.out.weight, begun.encoder.ranges.out.weight)
    with pytest.raises(RunError, match=r"has the registration RegistrationConfig\(rays=9.*expected .*rays=81"):
        initial_networks(arguments, WORLD)


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
    assert inconsistent({"noise": 0.98, "black": 0.9}) == "black (90.0%)"
    assert inconsistent({"noise": 0.97}) == inconsistent({}) == ""


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
        JudgeArguments(drives=111)
