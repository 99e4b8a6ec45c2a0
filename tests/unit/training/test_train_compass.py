"""Training data and figures of the compass."""

import math

import numpy as np
import pytest
import torch

from ngo_estimator.geometry.lattice import reading_of
from ngo_estimator.networks.compass import Compass, CompassConfig
from ngo_sim.maze2d import Maze2D, Maze2DConfig
from ngo_sim.raycast import cast_rays
from training.data import streams
from training.data.streams import Batch, simulate
from training.data.worlds import TRAIN_SEEDS, WORLDS
from training.train_compass import Arguments, CompassStream, CompassTraining, lattice_errors, reading_metrics

WORLD = WORLDS["maze2d"]


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "_GROUP", 2)
    monkeypatch.setattr(CompassStream, "FRAMES", 41)


def stream(epoch: int = 0, batch_size: int = 21) -> CompassStream:
    return CompassStream(WORLD, TRAIN_SEEDS, epoch, 2 * 2 * 21, batch_size)


def same(a: Batch, b: Batch) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def test_an_epoch_is_a_function_of_its_number() -> None:
    first, again, second = (list(stream(epoch)) for epoch in (2, 2, 3))
    assert len(first) == len(stream(2)) == 4
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert not any(same(a, b) for a, b in zip(first, second, strict=True))


def test_batches_hold_every_second_frame_once_at_its_pose() -> None:
    batch, mirror = list(stream())[:2]
    flip = torch.tensor([1.0, -1.0, -1.0])
    found = {tuple(pose.tolist()): image for pose, image in zip(batch["poses"], batch["images"], strict=True)}
    found |= {
        tuple(pose.tolist()): image.flip(1)
        for pose, image in zip(mirror["poses"] * flip, mirror["images"], strict=True)
    }
    episodes = list(simulate(WORLD, stream().groups[0], 41))
    expected = {
        tuple(pose.tolist()): torch.from_numpy(image)[None]
        for episode in episodes
        for pose, image in zip(episode.poses_xyyaw[::2].astype(np.float32), episode.observations[::2], strict=True)
    }
    assert len(found) >= 40 and found.keys() == expected.keys()
    assert all(torch.equal(found[pose], expected[pose]) for pose in found)


def test_a_mirrored_frame_is_what_the_mirrored_maze_shows() -> None:
    env = Maze2D(Maze2DConfig(rows=5, cols=5))
    scan, info = env.reset(seed=TRAIN_SEEDS[0])
    x, y, yaw = info["pose_xyyaw"]
    frame = {"images": torch.from_numpy(scan)[None, None], "poses": torch.from_numpy(info["pose_xyyaw"])[None]}
    walls, colors = (np.ascontiguousarray(blocks[::-1]) for blocks in (env.maze.walls, env.colors))
    expected = np.empty_like(scan)
    pose = (x, env.maze.size_m[1] - y, -yaw)
    cast_rays(walls, 1.0, *pose, np.cos(env.ray_angles_rad), np.sin(env.ray_angles_rad), colors, expected)
    mirror = streams.mirrored(frame)
    assert np.abs(expected - scan).max() > 0.1
    assert np.allclose(mirror["images"][0, 0].numpy(), expected, atol=1e-5)
    assert lattice_errors(reading_of(mirror["poses"], 1.0), torch.tensor([pose], dtype=torch.float64), 1.0).max() < 1e-5


def test_errors_forget_the_symmetries_and_nothing_else() -> None:
    pose = torch.tensor([[3.3, 7.6, math.radians(133.0)]])
    reading = reading_of(pose, 1.0)
    assert lattice_errors(reading, pose, 1.0).max() < 1e-5
    off = lattice_errors(reading + torch.tensor([0.03, 0.04, -0.02]), pose, 1.0)
    assert torch.allclose(off, torch.tensor([[0.05, 0.02]]), atol=1e-5)


def test_figures_of_honest_scales_are_one_and_a_half() -> None:
    generator = np.random.default_rng(0)
    log_scale = torch.from_numpy(generator.uniform(-5.0, -2.0, (20_000, 2)))
    unit = np.stack((generator.gamma(2.0, 1.0, 20_000), generator.gamma(1.0, 1.0, 20_000)), axis=1)
    figures = reading_metrics(torch.from_numpy(unit) * log_scale.exp(), log_scale)
    assert figures["mean_ratio_m"] == pytest.approx(1.0, abs=0.02)
    assert figures["mean_ratio_deg"] == pytest.approx(1.0, abs=0.02)
    assert figures["within_median_m"] == pytest.approx(0.5, abs=0.01)
    assert figures["within_median_deg"] == pytest.approx(0.5, abs=0.01)
    certain = reading_metrics(torch.full((10, 2), 0.1), torch.zeros(10, 2))
    assert certain["median_m"] == pytest.approx(0.1) and certain["p99_deg"] == pytest.approx(math.degrees(0.1))


def test_the_loss_teaches_a_compass_to_read() -> None:
    torch.manual_seed(0)
    network = Compass(CompassConfig(image=WORLD.image, block_m=WORLD.block_m, width=8, hidden_size=64))
    training = CompassTraining(Arguments(world="maze2d"), network)
    batch = next(iter(stream(batch_size=42)))
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    before = training(batch)["error"].item()
    for _ in range(100):
        optimizer.zero_grad()
        training(batch)["loss"].backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    after = training(batch)["error"].item()
    assert before > 0.3 and after < 0.1
