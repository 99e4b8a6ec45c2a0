"""DeepVO: what it sees of a sequence, and the stretches that it is trained on."""

import dataclasses

import numpy as np
import pytest
import torch

from ngo_estimator.checkpoint import WORLD_IMAGES
from training import train_deepvo
from training.baselines.deepvo import DeepVO, DeepVOConfig, trajectory_steps
from training.data.batches import mirrored, relative_poses
from training.data.episodes import images_of, simulate
from training.data.streams import PairStream
from training.data.worlds import TRAIN_SEEDS, world_named
from training.train_deepvo import StretchStream

CONFIG = DeepVOConfig(WORLD_IMAGES["maze3d"], width=0.02, relative_std=(0.1, 0.04, 0.08), symmetric=True)


@pytest.fixture(scope="module")
def network() -> DeepVO:
    torch.manual_seed(0)
    return DeepVO(CONFIG).eval()


def pictures(frames: int, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, 256, (frames, 60, 80, 3), generator=torch.Generator().manual_seed(seed)).to(torch.uint8)


def test_nine_convolutions_and_two_lstm_layers(network: DeepVO) -> None:
    assert sum(isinstance(layer, torch.nn.Conv2d) for layer in network.convolutions.layers) == 9
    assert network.lstm.num_layers == 2
    assert DeepVO(dataclasses.replace(CONFIG, width=0.25)).lstm.hidden_size == 248


def test_a_trajectory_in_chunks_is_the_whole_one(network: DeepVO) -> None:
    images = pictures(41)
    with torch.inference_mode():
        whole, _ = network(images.unsqueeze(0))
    for chunk in (7, 40, 100):
        torch.testing.assert_close(trajectory_steps(network, images, chunk), whole[0], atol=1e-6, rtol=1e-4)


def test_the_mirror_image_of_a_trajectory_gives_its_mirror_image(network: DeepVO) -> None:
    images = pictures(9)
    flipped = trajectory_steps(network, images.flip(-2)) * torch.tensor([1.0, -1.0, -1.0])
    torch.testing.assert_close(flipped, trajectory_steps(network, images), atol=1e-6, rtol=1e-4)


def test_stretches_are_of_the_frames_of_the_local_network(monkeypatch: pytest.MonkeyPatch) -> None:
    world = world_named("maze2d")
    monkeypatch.setattr(PairStream, "FRAMES", 41)
    stream = StretchStream(world, TRAIN_SEEDS, 3, 640, 4, 13)
    assert stream.groups == PairStream(world, TRAIN_SEEDS, 3, 640, 4).groups
    batches = list(stream)
    assert len(batches) == len(stream) == 2 * (8 * 3 // 4)
    episodes = list(simulate(world, stream.groups[0], 41))
    kept = [images_of(world, episode) for episode in episodes]
    for batch in batches[:6:2]:
        assert batch["images"].shape[:2] == (4, 14) and batch["relative"].shape == (4, 13, 3)
        for images, relative in zip(batch["images"], batch["relative"], strict=True):
            (place,) = [
                (maze, first) for maze in range(8) for first in (0, 13, 26) if torch.equal(kept[maze][first], images[0])
            ]
            maze, first = place
            assert torch.equal(images, kept[maze][first : first + 14])
            torch.testing.assert_close(relative, relative_poses(episodes[maze].poses_xyyaw)[first : first + 13])
    turned = mirrored(batches[1])
    assert any(torch.equal(turned["images"][0, 0], images[first]) for images in kept for first in (0, 13, 26))


def test_a_calibrated_network_has_no_constant_error(network: DeepVO, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(train_deepvo, "simulate", lambda world, seeds, _: simulate(world, seeds, 120))
    world, seeds = world_named("maze3d"), [2_000_000_000, 2_000_000_001]
    final = DeepVO(train_deepvo.calibrated(network, world, seeds)).eval()
    final.load_state_dict(network.state_dict())
    errors = [
        trajectory_steps(final, images_of(world, episode)) - relative_poses(episode.poses_xyyaw)
        for episode in simulate(world, seeds, 120)
    ]
    np.testing.assert_allclose(torch.cat(errors).mean(dim=0), 0.0, atol=1e-5)
