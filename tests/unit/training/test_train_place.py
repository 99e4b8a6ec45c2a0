"""What the place encoder learns, and what it begins with."""

import dataclasses
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ngo_estimator.checkpoint import PLACE, PlaceNetworks, load_place, save_checkpoint, write_untrained
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.networks.place_encoder import SeenRanges
from training.common.records import RunError
from training.data.worlds import world_named
from training.recordings.recording_source import RecordedArguments
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
