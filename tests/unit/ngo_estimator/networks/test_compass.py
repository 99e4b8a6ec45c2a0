"""The compass's network: shapes, units, seams and batches."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor

from ngo_estimator.checkpoint import WORLD_IMAGES, CheckpointError, save_checkpoint
from ngo_estimator.geometry.lattice import snapped
from ngo_estimator.networks.compass import COMPASS, Compass, CompassConfig, load_compass, read_frames
from tests.unit.ngo_estimator.samples import observations


def small(**changes: object) -> Compass:
    torch.manual_seed(0)
    settings = {"image": WORLD_IMAGES["maze2d"], "block_m": 1.0, "width": 4, "hidden_size": 32, **changes}
    return Compass(CompassConfig(**settings)).eval().requires_grad_(False)  # type: ignore[arg-type]


def constant(wall: float, first: tuple[float, float], second: tuple[float, float]) -> Compass:
    """A compass that sees these phases in every scan: four times the heading, and (u, v) in both charts."""
    network = small().train()  # as it is, without the mirror image
    phases = torch.tensor([wall, *first, *second])
    network.phases.weight.zero_()
    network.phases.bias.copy_(torch.stack((phases.cos(), phases.sin()), dim=1).flatten())
    return network


def test_readings_have_their_shapes_and_ranges() -> None:
    readings, log_scale = small()(observations("maze2d", 200))
    assert readings.shape == (200, 3) and log_scale.shape == (200, 2)
    assert readings.dtype == log_scale.dtype == torch.float32
    assert readings[:, :2].abs().max() <= 0.5 and readings[:, 2].abs().max() <= math.pi / 4
    assert (readings.std(0) > 0).all() and (log_scale.std(0) > 0).all()


def test_batch_is_as_many_singles() -> None:
    network, images = small(), observations("maze2d", 5)
    readings, log_scale = network(images)
    in_parts = read_frames(network, images, batch_size=2)
    for k in range(5):
        reading, scale = network(images[k : k + 1])
        for single, batched in ((reading, readings), (scale, log_scale)):
            assert torch.allclose(single[0], batched[k], atol=1e-5)
    assert torch.allclose(in_parts[0], readings, atol=1e-5) and torch.allclose(in_parts[1], log_scale, atol=1e-5)


def test_the_mirror_image_of_a_scan_reads_as_the_mirror_image_of_its_pose() -> None:
    network, images = small(), observations("maze2d", 50)
    pose = torch.tensor([2.0, 3.0, 1.0])
    (readings, log_scale), (mirrored, mirrored_scale) = network(images), network(images.flip(-2))
    flip = torch.tensor([1.0, -1.0, -1.0])
    poses = snapped(readings, pose, 1.0)
    assert torch.allclose(snapped(mirrored * flip, poses, 1.0), poses, atol=1e-5)
    assert torch.allclose(mirrored_scale, log_scale, atol=1e-6)
    assert not torch.allclose(network.train()(images)[0], readings, atol=1e-3)


def test_positions_scale_with_the_block() -> None:
    images = observations("maze2d", 3)
    (r1, s1), (r2, s2) = (small(block_m=block_m)(images) for block_m in (1.0, 3.0))
    assert torch.allclose(3.0 * r1[:, :2], r2[:, :2]) and torch.equal(r1[:, 2], r2[:, 2])
    assert torch.allclose(3.0 * s1[:, 0].exp(), s2[:, 0].exp()) and torch.equal(s1[:, 1], s2[:, 1])


@pytest.mark.parametrize("psi", [-40.0, -20.0, 0.0, 20.0, 40.0])
def test_the_chart_is_the_one_whose_seam_is_far(psi: float) -> None:
    read = constant(math.radians(4.0 * psi), (0.4, 0.8), (-1.2, 2.0))(observations("maze2d", 1))[0][0]
    assert read[2].item() == pytest.approx(math.radians(psi), abs=1e-5)
    expected = (0.4, 0.8) if abs(psi) < 22.5 else (-1.2, 2.0) if psi > 0 else (2.0, 1.2)
    assert torch.allclose(2.0 * math.pi * read[:2], torch.tensor(expected), atol=1e-4)


def test_a_heading_on_either_side_of_45_degrees_means_one_pose() -> None:
    pose = torch.tensor([3.2, -1.7, math.radians(135.0)])

    def posed(psi: float) -> Tensor:
        readings, _ = constant(math.radians(4.0 * psi), (0.1, 0.2), (1.0, -0.7))(observations("maze2d", 1))
        return snapped(readings[0], pose, 1.0)

    below, above = posed(44.999), posed(-44.999)
    assert torch.allclose(below, above, atol=1e-3)


def test_gradients_are_finite_where_a_vector_is_zero() -> None:
    network = small().requires_grad_(True).train()
    with torch.no_grad():
        network.phases.weight.zero_()
        network.phases.bias.zero_()
    readings, log_scale = network(observations("maze2d", 4))
    (readings.sum() + log_scale.sum()).backward()
    gradients = [parameter.grad for parameter in network.parameters() if parameter.grad is not None]
    assert gradients and all(gradient.isfinite().all() for gradient in gradients)


def test_a_stored_compass_reads_the_same(tmp_path: Path) -> None:
    network, images = small(), observations("maze2d", 2)
    save_checkpoint(tmp_path / f"{COMPASS}.safetensors", network, COMPASS, "maze2d", {"training": "none"})
    loaded, description = load_compass(tmp_path, "maze2d")
    assert description["network"] == "compass" and loaded.config == network.config
    assert torch.equal(loaded(images)[0], network(images)[0])
    with pytest.raises(CheckpointError, match="expected 'maze3d'"):
        load_compass(tmp_path, "maze3d")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": WORLD_IMAGES["maze3d"]}, "expected a row scan"),
        ({"block_m": 0.0}, "block_m is 0.0"),
        ({"width": 0}, "width and hidden_size are 0"),
        ({"hidden_size": 0}, "are 4 and 0"),
    ],
)
def test_impossible_compasses_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(**change)
