"""The losses compute where their batch is: no tensor made on the CPU meets one of another device.

No GPU is needed: on torch's ``meta`` device, which has shapes but no numbers, mixing fails as it would on a GPU.
"""

import contextlib
import dataclasses
from pathlib import Path
from typing import Any

import lightning
import pytest
import torch

from ngo_estimator.checkpoint import PlaceNetworks, load_local, load_optimizer, load_place, write_untrained
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from training import train_end_to_end, train_local, train_place
from training.data.batches import Batch, mirrored
from training.data.worlds import WORLDS

WORLD = WORLDS["maze3d"]  # its pictures are made brighter and darker at random
BATCH = 8


def step(module: lightning.LightningModule, batch: Batch) -> torch.Tensor:
    """The loss of the mirror image of a batch, after a backward pass that reaches some parameter."""
    loss: Any = module.to("meta").training_step(mirrored({name: x.to("meta") for name, x in batch.items()}), 0)
    loss.backward()
    assert any(parameter.grad is not None for parameter in module.parameters())
    return loss


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder: Path = tmp_path_factory.mktemp("weights")
    write_untrained(folder, "maze3d")
    return folder


def images(*shape: int) -> torch.Tensor:
    return torch.zeros(*shape, 60, 80, 3, dtype=torch.uint8)


def test_the_local_networks_loss_stays_on_its_device(weights: Path) -> None:
    module = train_local.LocalTraining(train_local.Arguments("maze3d"), load_local(weights)[0].requires_grad_())
    batch = {
        "earlier": images(BATCH),
        "later": images(BATCH),
        "action": torch.zeros(BATCH).long(),
        "relative": torch.zeros(BATCH, 3),
    }
    assert step(module, batch).device.type == "meta"


@pytest.mark.parametrize("sees_ranges", [False, True])
def test_the_place_encoders_loss_stays_on_its_device(weights: Path, sees_ranges: bool) -> None:
    registration = RegistrationConfig(9, 90.0, 0.01, odometry=False) if sees_ranges else None
    config = dataclasses.replace(load_place(weights)[0].config, registration=registration)
    module = train_place.PlaceTraining(train_place.Arguments("maze3d"), WORLD, PlaceNetworks(config))
    batch = {
        "ranges": torch.ones(BATCH, 2, 9),
        "a": images(BATCH),
        "b": images(BATCH),
        "poses": torch.zeros(BATCH, 2, 3),
        "maze": torch.zeros(BATCH).long(),
    }
    assert step(module, batch).device.type == "meta"


def test_the_loss_of_all_networks_together_stays_on_its_device(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())  # meta knows none
    networks = (load(weights)[0] for load in (load_local, load_place, load_optimizer))
    module = train_end_to_end.EndToEndTraining(train_end_to_end.Arguments("maze3d"), *networks, 1.0, 0.02)
    batch = {"images": images(2, 129), "action": torch.zeros(2, 128).long(), "relative": torch.zeros(2, 128, 3)}
    assert step(module, batch).device.type == "meta"
