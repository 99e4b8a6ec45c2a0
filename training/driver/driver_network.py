"""The learned driver's network for stable-baselines3, and its export to the simulator."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from ngo_common.files import write_together
from ngo_sim.policy_network import FORMAT, MIRRORED_SENSES, MIRRORED_SIGNS, NETWORK, SENSES, PolicyConfig


class Features(BaseFeaturesExtractor):
    """The network of ngo_sim.policy_network up to the sum and the difference of its two hidden layers."""

    def __init__(self, observation_space: Any, config: PolicyConfig) -> None:
        super().__init__(observation_space, 2 * config.hidden)
        before, layers = config.pictures, []
        for channels, kernel, stride in zip(config.channels, config.kernels, config.strides, strict=True):
            layers += [nn.Conv2d(before, channels, kernel, stride), nn.ReLU()]
            before = channels
        self.convolutions = nn.Sequential(*layers, nn.Flatten())
        self.hidden = nn.Linear(int(np.prod(config.feature_shape)) + SENSES, config.hidden)

    def forward(self, observations: dict[str, Tensor]) -> Tensor:
        """(batch, 2 hidden) of pictures (batch, pictures, height, width) in [0, 1] and senses (batch, 8)."""
        pictures, senses = observations["pictures"], observations["senses"]
        mirrored_senses = senses[:, list(MIRRORED_SENSES)] * senses.new_tensor(MIRRORED_SIGNS)
        seen = self.convolutions(torch.cat((pictures, pictures.flip(-1))))
        both = torch.relu(self.hidden(torch.cat((seen, torch.cat((senses, mirrored_senses))), dim=1)))
        own, mirrored = both.chunk(2)
        return torch.cat((own + mirrored, own - mirrored), dim=1)


class Odds(nn.Module):
    """The last layer of ngo_sim.policy_network: (batch, 2 hidden) to the logarithms of the odds, (batch, 3)."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.common, self.turn = nn.Linear(hidden, 2), nn.Linear(hidden, 1, bias=False)
        for layer in (self.common, self.turn):
            nn.init.orthogonal_(layer.weight, gain=0.01)
        nn.init.zeros_(self.common.bias)

    def forward(self, features: Tensor) -> Tensor:
        even, odd = features.chunk(2, dim=1)
        forward, turn = self.common(even).unbind(1)
        left = self.turn(odd).squeeze(1)
        return torch.stack((forward, turn + left, turn - left), dim=1)


class Worth(nn.Module):
    """The critic's last layer: (batch, 2 hidden) to (batch, 1), the same in a mirror."""

    def __init__(self, hidden: int) -> None:
        super().__init__()
        self.linear = nn.Linear(hidden, 1)

    def forward(self, features: Tensor) -> Tensor:
        even, _ = features.chunk(2, dim=1)
        return self.linear(even)


class MirroredPolicy(MultiInputActorCriticPolicy):
    """Actor and critic that share all but their last layers."""

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        hidden = self.features_dim // 2
        self.action_net, self.value_net = Odds(hidden), Worth(hidden)  # type: ignore[assignment]
        optimizer_class: Any = self.optimizer_class
        self.optimizer = optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


def export(path: Path, state: dict[str, Tensor], config: PolicyConfig, details: dict[str, Any]) -> dict[str, Any]:
    """Write the actor as safetensors with its description beside it; returns the description."""
    layers = {"hidden": "features_extractor.hidden", "common": "action_net.common", "turn": "action_net.turn"}
    layers |= {f"convolution_{i}": f"features_extractor.convolutions.{2 * i}" for i in range(len(config.channels))}
    tensors = {}
    for name in config.tensor_shapes():
        layer, _, part = name.partition(".")
        tensors[name] = np.ascontiguousarray(state[f"{layers[layer]}.{part}"].detach().numpy())
    weights = save(tensors)
    description = {
        "format": FORMAT,
        "network": NETWORK,
        "world": "maze3d",
        "sha256": hashlib.sha256(weights).hexdigest(),
        "config": dataclasses.asdict(config),
        **details,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_together({path: weights, path.with_suffix(".json"): json.dumps(description, indent=2) + "\n"})
    return description
