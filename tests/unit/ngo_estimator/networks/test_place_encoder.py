"""The place encoder and its pair head: shapes, units, batches."""

import pytest
import torch

from ngo_estimator.checkpoint import PlaceNetworks
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.networks.place_encoder import PairHead, PlaceEncoder
from tests.unit.ngo_estimator.samples import WORLDS, observations, place_config


@pytest.mark.parametrize("world", WORLDS)
def test_place_codes_and_pairs_have_their_shapes_and_units(world: str) -> None:
    config = place_config(world, code_size=24, embedding_size=12)
    encoder, head = PlaceEncoder(config).eval(), PairHead(config)
    codes = encoder(observations(world, 6))
    assert codes.shape == (6, 24) and codes.dtype == torch.float32
    embeddings = head.embed(codes.reshape(2, 3, 24))
    assert embeddings.shape == (2, 3, 12)
    assert torch.allclose(embeddings.norm(dim=-1), torch.ones(2, 3))
    measured, log_scale, logit = head(codes.reshape(2, 3, 24), codes.flip(0).reshape(2, 3, 24))
    assert measured.shape == (2, 3, 3) and log_scale.shape == (2, 3, 2) and logit.shape == (2, 3)
    assert measured[..., 2].abs().max() <= torch.pi


def test_a_code_of_a_picture_ends_with_the_ranges_that_are_seen_in_it() -> None:
    registration = RegistrationConfig(9, 90.0, 0.01, odometry=False)
    config = place_config("maze3d", code_size=12, registration=registration)
    encoder = PlaceEncoder(config).eval()
    images = observations("maze3d", 3)
    code, seen = encoder.see(images)
    assert seen is not None and seen.log_range.shape == seen.log_scale.shape == (3, 9)
    with torch.no_grad():
        encoder.ranges.out.bias[9:] = -5.0  # sure of all
        encoder.ranges.out.bias[9] = 5.0  # but the leftmost ray
    codes = encoder(images)
    assert codes.shape == (3, config.code_length) == (3, 21)
    assert torch.equal(codes[:, :12], code)
    assert (codes[:, 12] == 0.0).all() and torch.allclose(codes[:, 13:], seen.log_range[:, 1:].exp())


def test_ranges_can_be_kept_while_the_rest_learns() -> None:
    registration = RegistrationConfig(9, 90.0, 0.01, odometry=False)
    encoder = PlaceEncoder(place_config("maze3d", code_size=12, registration=registration))
    encoder.keep_ranges()
    optimizer = torch.optim.SGD([p for p in encoder.parameters() if p.requires_grad], 0.1)
    images = observations("maze3d", 2)
    code, seen = encoder.see(images)
    code.square().sum().backward()
    optimizer.step()
    changed, again = encoder.see(images)
    assert seen is not None and again is not None
    assert torch.equal(seen.log_range, again.log_range) and not torch.equal(code, changed)


def test_networks_do_without_the_ranges_that_they_see() -> None:
    registration = RegistrationConfig(9, 90.0, 0.01, odometry=False)
    networks = PlaceNetworks(place_config("maze3d", code_size=12, registration=registration)).eval()
    plain, images = networks.without_ranges().eval(), observations("maze3d", 2)
    assert plain.config.registration is None
    assert torch.equal(plain.encoder(images), networks.encoder(images)[:, :12])
