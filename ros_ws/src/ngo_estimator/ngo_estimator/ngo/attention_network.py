"""The phases "Attention" and "Optimization" (paper, section "Neural Graph Optimization")."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from ngo_estimator.ngo.meta_poses import GraphState
from ngo_estimator.ngo.pose_aggregation import PoseAggregation, PoseAggregationConfig


@dataclass(frozen=True)
class AttentionConfig:
    """The layers of both phases; fields as in ``NeuralGraphOptimizerConfig``.

    ``loop_channels`` further channels of each pose tell the convolutions of the loops, 0 without loops.
    """

    aggregation: PoseAggregationConfig
    attention: str
    dilations: tuple[int, ...]
    residual: bool
    loop_channels: int


class AttentionNetwork(nn.Module):
    """Attention over all meta-poses, and convolutions along the trajectory.

    Unlike in the paper, features, adjustments and gates are read from the last convolution by layers of kernel 1, and
    only the features pass through a ReLU. With ``residual`` each convolution is added to its input and normalised.
    """

    def build(self, config: AttentionConfig) -> None:
        """Make the layers, freshly initialised; before it a network has none."""
        width = config.aggregation.width
        self._form = config
        self.aggregation = PoseAggregation(config.aggregation)
        self.query = nn.Linear(width, width)
        channels = 2 * width + config.loop_channels
        self.convolutions, self.norms = nn.ModuleList(), nn.ModuleList()
        for dilation in config.dilations:
            self.convolutions.append(nn.Conv1d(channels, width, 3, 1, dilation, dilation))
            self.norms.append(nn.LayerNorm(width) if config.residual else nn.Identity())
            channels = width
        self.feature = nn.Conv1d(width, width, 1)
        self.gate = nn.Conv1d(width, 1, 1)
        self.adjustment = _zero(nn.Conv1d(width, 3, 1))
        if config.loop_channels:
            self.place_gain = nn.Parameter(torch.tensor(0.0))
            self.stiffness = _zero(nn.Conv1d(width, 3, 1))

    def attend(self, features: Tensor, place_similarity: Tensor | None) -> Tensor:
        """Attention weights ``(batch, poses, poses)`` of features F ``(batch, poses, width)``.

        alpha_tu = C_tu / sum_v C_tv with C_tu = <q_t, f_u>, where q_t = ``query``(f_t); by default softmax_u(C_tu).
        ``place_similarity`` ``(batch, poses, poses)`` of the place codes pulls the attention as far as it was learned.
        """
        return self.attention_weights(features, self.place_logits(place_similarity))

    def place_logits(self, place_similarity: Tensor | None) -> Tensor | None:
        """What the similarity of places adds to the attention's logits, the same in all iterations."""
        if place_similarity is None or self._form.attention == "sum":
            return None
        return 10.0 * self.place_gain * place_similarity

    def attention_weights(self, features: Tensor, place_logits: Tensor | None) -> Tensor:
        """As ``attend``, with what ``place_logits`` gave."""
        queries = self.query(features)
        if self._form.attention == "sum":
            # The paper divides by a sum that can vanish; queries of one sign, like the features, keep it positive.
            logits = torch.relu(queries) @ features.mT + 1e-6
            return logits / logits.sum(-1, keepdim=True)
        logits = (queries / math.sqrt(features.shape[-1])) @ features.mT
        return torch.softmax(logits if place_logits is None else logits + place_logits, dim=-1)

    def phases(self, blocks: int, place_similarity: Tensor | None, correction_std: Tensor) -> AttentionPhases:
        """Both phases over the last ``blocks`` meta-poses, for all iterations of one optimisation."""
        return AttentionPhases(self, self._form, blocks, place_similarity, correction_std)


class AttentionPhases:
    """Both phases over a number of meta-poses; the convolutions are laid out once as matrices, for all iterations."""

    def __init__(
        self,
        network: AttentionNetwork,
        form: AttentionConfig,
        blocks: int,
        place_similarity: Tensor | None,
        correction_std: Tensor,
    ) -> None:
        self._network, self._residual = network, form.residual
        self._place_logits, self._correction_std = network.place_logits(place_similarity), correction_std
        layers = [layer for layer in network.convolutions if isinstance(layer, nn.Conv1d)]
        weights = [layer.weight.transpose(1, 2).flatten(1) for layer in layers]
        index = torch.arange(blocks, device=weights[0].device)
        offsets = torch.arange(-1, 2, device=index.device)
        neighbours = {}
        for dilation in {layer.dilation[0] for layer in layers}:
            beside = index[:, None] + dilation * offsets
            # Row ``blocks`` is a zero behind the last pose.
            neighbours[dilation] = beside.masked_fill((beside < 0) | (beside >= blocks), blocks).flatten()
        self._convolutions = (weights, [layer.bias for layer in layers], [neighbours[x.dilation[0]] for x in layers])
        heads = [network.feature, network.gate, network.adjustment]
        heads += [network.stiffness] if form.loop_channels else []
        self._sizes = [head.out_channels for head in heads]
        self._weight = torch.cat([head.weight for head in heads]).squeeze(-1)
        self._bias = torch.cat([head.bias for head in heads if head.bias is not None])

    def attend(self, state: GraphState) -> Tensor:
        """Attention vectors a_t = sum_u alpha_tu f_u ``(batch, blocks, width)`` ("Attention Phase")."""
        return self._network.attention_weights(state.features, self._place_logits) @ state.features

    def optimise(self, state: GraphState, loops: Callable[[GraphState], Tensor]) -> tuple[GraphState, Tensor]:
        """Both phases once: ``attend``, then "Optimization".

        The convolutions h_1 .. h_L take [f_t, a_t], and give beta, nabla P and the next features F. The next relative
        poses are Delta P + beta nabla P.

        Args:
            loops: gives the loops for the convolutions ``(batch, blocks, loop_channels)``.

        Returns:
            The next state, and the stiffness ``(batch, blocks, 3)`` of each meta-step (width 0 without loops).
        """
        hidden = self._convolve(torch.cat((state.features, self.attend(state), loops(state)), dim=-1))
        parts = nn.functional.linear(hidden, self._weight, self._bias).split(self._sizes, dim=-1)
        feature, beta, change = parts[:3]
        stiffness = parts[3] if len(parts) > 3 else hidden[..., :0]
        adjustment = torch.sigmoid(beta) * change * self._correction_std
        keys = state.adjusted.shape[1] - adjustment.shape[1]
        adjusted = torch.cat((state.adjusted[:, :keys], state.adjusted[:, keys:] + adjustment), dim=1)
        return replace(state, adjusted=adjusted, features=torch.relu(feature)), stiffness

    def _convolve(self, inputs: Tensor) -> Tensor:
        """``(batch, poses, channels)`` to ``(batch, poses, width)``."""
        hidden = normed = inputs
        for weight, bias, neighbours, norm in zip(*self._convolutions, self._network.norms, strict=True):
            # As one product it is several times as fast as torch's dilated convolutions.
            padded = nn.functional.pad(normed, (0, 0, 0, 1)).index_select(1, neighbours)
            beside = padded.reshape(normed.shape[0], normed.shape[1], -1)
            out = torch.relu(nn.functional.linear(beside, weight, bias))
            hidden = out + hidden if self._residual and out.shape == hidden.shape else out
            # Without norms nine layers, run five times, let the features grow until gates and stiffness saturate.
            normed = norm(hidden)
        return normed


def _zero(layer: nn.Conv1d) -> nn.Conv1d:
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer
