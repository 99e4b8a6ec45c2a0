"""The local network: its layers, normalisation, and what it is told of a step."""

import dataclasses

import pytest
import torch
from torch import nn

from ngo_estimator.networks.flownet import FlowNetConvolutions
from ngo_estimator.networks.local_pose_network import NO_ACTION, LocalPoseNetwork
from tests.unit.ngo_estimator.samples import WORLDS, local_config, observations


@pytest.mark.parametrize("world", WORLDS)
def test_local_network_gives_poses_deviations_and_features(world: str) -> None:
    network = LocalPoseNetwork(local_config(world, feature_size=20)).eval()
    images = observations(world, 6)
    mean, log_std, feature = network(images[:5], images[1:], torch.tensor([0, 1, 2, 0, 1]))
    assert mean.shape == log_std.shape == (5, 3) and feature.shape == (5, 20)
    assert all(value.isfinite().all() and value.dtype == torch.float32 for value in (mean, log_std, feature))


def test_normalisation_turns_the_output_into_metres_and_radians() -> None:
    torch.manual_seed(0)
    plain = LocalPoseNetwork(local_config("maze2d")).eval()
    scaled_config = dataclasses.replace(plain.config, relative_mean=(0.3, -0.1, 0.02), relative_std=(0.5, 0.1, 0.2))
    scaled = LocalPoseNetwork(scaled_config).eval()
    scaled.load_state_dict(plain.state_dict())
    images, actions = observations("maze2d", 4), torch.tensor([0, 1, 2])
    mean, log_std, feature = plain(images[:3], images[1:], actions)
    scaled_mean, scaled_log_std, scaled_feature = scaled(images[:3], images[1:], actions)
    std = torch.tensor(scaled_config.relative_std)
    assert torch.allclose(scaled_mean, mean * std + torch.tensor(scaled_config.relative_mean), atol=1e-6)
    assert torch.allclose(scaled_log_std.exp(), log_std.exp() * std, rtol=1e-5)
    assert torch.equal(scaled_feature, feature)


def test_the_action_matters_and_must_be_given_exactly_when_it_was_in_training() -> None:
    images = observations("maze2d", 2)
    with_action = LocalPoseNetwork(local_config("maze2d")).eval()
    without = LocalPoseNetwork(local_config("maze2d", actions=0)).eval()
    left, right = (with_action(images[:1], images[1:], torch.tensor([action]))[0] for action in (1, 2))
    assert not torch.equal(left, right)
    assert without(images[:1], images[1:], None)[0].shape == (1, 3)
    with pytest.raises(ValueError, match="no actions were given"):
        with_action(images[:1], images[1:], None)
    with pytest.raises(ValueError, match="actions were given"):
        without(images[:1], images[1:], torch.tensor([1]))


def test_a_network_is_told_as_many_of_the_latest_actions_as_it_was_made_for() -> None:
    torch.manual_seed(0)
    images = observations("maze2d", 2).repeat_interleave(2, dim=0)
    network = LocalPoseNetwork(local_config("maze2d", action_history=3)).eval()
    torch.nn.init.normal_(network.fusion[-1].weight)  # untrained, it has no say

    def of(*actions: int) -> torch.Tensor:
        return network(images[:1], images[3:], torch.tensor([actions]))[0]

    now = of(NO_ACTION, NO_ACTION, 1)
    assert not torch.equal(now, of(NO_ACTION, 1, 1)) and not torch.equal(now, of(NO_ACTION, NO_ACTION, 2))
    assert not torch.equal(of(0, 1, 1), of(1, 0, 1))
    assert torch.equal(of(2, 2, 0, 1, 1), of(0, 1, 1))
    for wrong in (torch.tensor([1]), torch.tensor([[1, 1]]), torch.zeros(1, 3, 1).long()):
        with pytest.raises(ValueError, match="expected the latest 3 of each"):
            network(images[:1], images[3:], wrong)


@pytest.mark.parametrize("world", WORLDS)
def test_a_symmetric_network_sees_the_mirror_image_as_the_mirrored_motion(world: str) -> None:
    torch.manual_seed(0)
    config = local_config(world, symmetric=True, mirrored_actions=(0, 2, 1), action_history=2)
    network = LocalPoseNetwork(config).eval()
    images, actions = observations(world, 4), torch.tensor([[1, 0], [NO_ACTION, 1], [2, 2]])
    mean, log_std, feature = network(images[:3], images[1:], actions)
    mirrored = images.flip(-2)
    other, other_log_std, _ = network(mirrored[:3], mirrored[1:], torch.tensor([[2, 0], [NO_ACTION, 2], [1, 1]]))
    assert torch.allclose(other, mean * torch.tensor([1.0, -1.0, -1.0]), atol=1e-6)
    assert torch.allclose(other_log_std, log_std, atol=1e-6)
    # Training sees each picture once: there the network is the plain one.
    plain = LocalPoseNetwork(local_config(world, action_history=2)).eval()
    plain.load_state_dict(network.state_dict())
    once = plain(images[:3], images[1:], actions)
    trained = network.train()(images[:3], images[1:], actions)
    assert all(torch.allclose(a, b, atol=1e-6) for a, b in zip(trained, once, strict=True))
    assert torch.allclose(feature, once[2], atol=1e-6) and not torch.allclose(mean, once[0], atol=1e-4)


def test_the_velocity_matters_and_must_be_given_exactly_when_it_was_in_training() -> None:
    images = observations("maze2d", 2)
    told = LocalPoseNetwork(local_config("maze2d", actions=0, twist=True)).eval()
    slow, fast = (told(images[:1], images[1:], None, torch.tensor([[v, 0.0, 0.1]]))[0] for v in (0.2, 1.0))
    assert not torch.equal(slow, fast)
    with pytest.raises(ValueError, match="twist is not given to a network with twist=True"):
        told(images[:1], images[1:])
    with pytest.raises(ValueError, match="twist is given to a network with twist=False"):
        LocalPoseNetwork(local_config("maze2d"))(images[:1], images[1:], torch.tensor([1]), torch.zeros(1, 3))


def test_the_velocity_is_told_in_its_own_units_and_the_mirrored_one_in_a_mirror() -> None:
    torch.manual_seed(0)
    images = observations("maze2d", 2)
    network = LocalPoseNetwork(local_config("maze2d", actions=0, twist=True, symmetric=True)).eval()
    scaled = LocalPoseNetwork(dataclasses.replace(network.config, twist_scale=(2.0, 4.0, 8.0))).eval()
    scaled.load_state_dict(network.state_dict())
    twist, flip = torch.tensor([[0.4, 0.1, -0.3]]), torch.tensor([1.0, -1.0, -1.0])
    mean = network(images[:1], images[1:], None, twist)[0]
    assert torch.allclose(scaled(images[:1], images[1:], None, twist * torch.tensor([2.0, 4.0, 8.0]))[0], mean)
    in_the_mirror = network(images[:1].flip(-2), images[1:].flip(-2), None, twist * flip)[0]
    assert torch.allclose(in_the_mirror, mean * flip, atol=1e-6)


def test_width_one_is_flownet_simple() -> None:
    convolutions = [m for m in FlowNetConvolutions(6, (60, 80), 1.0).layers if isinstance(m, nn.Conv2d)]
    assert [m.out_channels for m in convolutions] == [64, 128, 256, 256, 512, 512, 512, 512, 1024]
    assert [m.kernel_size[0] for m in convolutions] == [7, 5, 5, 3, 3, 3, 3, 3, 3]
    assert [m.stride[0] for m in convolutions] == [2, 2, 2, 1, 2, 1, 2, 1, 2]
