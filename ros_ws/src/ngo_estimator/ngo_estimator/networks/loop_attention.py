"""Attention among the loops of a pose graph: which of them are right, by what each and its partners say.

Tokens are loops; what the cycle of two loops says of both is the attention's bias (paper, section "Neural Graph
Optimizer": there the tokens are poses).
"""

from dataclasses import dataclass

from torch import Tensor, nn


@dataclass(frozen=True)
class LoopAttentionConfig:
    """Sizes of the network."""

    token_features: int = 35
    pair_features: int = 12
    width: int = 56  # channels of a loop
    heads: int = 4
    layers: int = 3
    attention: bool = True  # without it, each loop is judged for itself: the baseline

    def __post_init__(self) -> None:
        sizes = (self.token_features, self.pair_features, self.width, self.heads, self.layers)
        if min(sizes) < 1 or self.width % self.heads:
            raise ValueError(f"sizes are {sizes}; expected positive ones, and a width that its heads divide")


class _Attention(nn.Module):
    """Each loop attends to its partners."""

    def __init__(self, config: LoopAttentionConfig, pair_width: int) -> None:
        super().__init__()
        self.heads = config.heads
        self.query_key_value = nn.Linear(config.width, 3 * config.width)
        self.pair = nn.Linear(pair_width, config.heads + config.width)
        self.out = nn.Linear(config.width, config.width)

    def forward(self, tokens: Tensor, partners: Tensor, pairs: Tensor) -> Tensor:
        query, key, value = (
            each.unflatten(-1, (self.heads, -1)) for each in self.query_key_value(tokens).chunk(3, dim=-1)
        )
        bias, said = self.pair(pairs).split((self.heads, tokens.shape[-1]), dim=-1)
        logits = (query[:, None] * key[partners]).sum(-1) / query.shape[-1] ** 0.5 + bias
        values = value[partners] + said.unflatten(-1, (self.heads, -1))
        return self.out((logits.softmax(1)[..., None] * values).sum(1).flatten(1))


class _Layer(nn.Module):
    def __init__(self, config: LoopAttentionConfig, pair_width: int) -> None:
        super().__init__()
        width = config.width
        self.attention = _Attention(config, pair_width) if config.attention else None
        self.norm = nn.LayerNorm(width)
        self.mixed = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, tokens: Tensor, partners: Tensor, pairs: Tensor) -> Tensor:
        if self.attention is not None:
            tokens = tokens + self.attention(self.norm(tokens), partners, pairs)
        mixed: Tensor = tokens + self.mixed(tokens)
        return mixed


class LoopAttention(nn.Module):
    """Log odds of loops.

    Args:
        config: its sizes.
    """

    def __init__(self, config: LoopAttentionConfig) -> None:
        super().__init__()
        self.config = config
        pair_width = 32
        self.token = nn.Sequential(nn.Linear(config.token_features, config.width), nn.GELU())
        self.pair = nn.Sequential(nn.Linear(config.pair_features, pair_width), nn.GELU()) if config.attention else None
        self.layers = nn.ModuleList(_Layer(config, pair_width) for _ in range(config.layers))
        self.odds = nn.Sequential(nn.LayerNorm(config.width), nn.Linear(config.width, 1))

    def forward(self, tokens: Tensor, partners: Tensor, pairs: Tensor) -> Tensor:
        """Log odds ``(n,)`` from features ``(n, f)``, partners ``(n, p)``, and features of pairs ``(n, p, g)``."""
        values = self.token(tokens)
        said = pairs if self.pair is None else self.pair(pairs)
        for layer in self.layers:
            values = layer(values, partners, said)
        odds: Tensor = self.odds(values).squeeze(-1)
        return odds
