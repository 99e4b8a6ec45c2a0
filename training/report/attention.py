"""The attention of an optimizer: its entropy, and its share on true revisits."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.meta_poses import OptimizedTrajectory
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from training.data.batches import alike
from training.data.worlds import World
from training.scoring.row_estimators import Arrays
from training.scoring.statistics import mean_interval
from training.scoring.table_rows import Sources

ROWS = ("paper_5", "ngo_5")
"""Whose attention is reported, that of the first training seed."""

_MIN_SEPARATION = 6  # meta-poses, as in the search for loops: nearer ones are not another visit


@dataclass(frozen=True)
class Attention:
    """Attention of one trajectory.

    ``weights`` ``(iterations, poses, poses)``: each row is what a meta-pose attends to, and sums to one; ``revisits``
    ``(poses, poses)``: which pairs of meta-poses are at one place.
    """

    weights: np.ndarray
    revisits: np.ndarray
    result: OptimizedTrajectory

    @property
    def relative_entropy(self) -> np.ndarray:
        """Mean entropy ``(iterations,)`` in units of that of a uniform attention."""
        entropy = -(self.weights * np.log(np.maximum(self.weights, 1e-30))).sum(axis=-1)
        return entropy.mean(axis=-1) / np.log(self.weights.shape[-1])

    @property
    def revisit_mass(self) -> np.ndarray:
        """Mean share of the attention ``(iterations,)`` on revisits, over the meta-poses that have any."""
        return (self.weights * self.revisits).sum(axis=-1)[:, self._have_any].mean(axis=-1)

    @property
    def uniform_share(self) -> float:
        """The ``revisit_mass`` of a uniform attention."""
        return float(self.revisits.mean(axis=-1)[self._have_any].mean())

    @property
    def _have_any(self) -> np.ndarray:
        return np.asarray(self.revisits.any(axis=-1))


def attention_of(
    optimizer: NeuralGraphOptimizer, pair_head: PairHead, arrays: Arrays, world: World
) -> Iterator[Attention]:
    """The attention over each trajectory of ``arrays`` ``(trajectories, steps, ...)``, on whole meta-poses."""
    if not optimizer.config.network:
        raise ValueError("this optimizer has no attention; expected one with a network")
    steps = arrays["relative"].shape[1] // optimizer.block * optimizer.block
    for k in range(len(arrays["relative"])):
        names = ("relative", "log_std", "motion", "codes", "origin_code")
        relative, log_std, motion, codes, origin = (
            torch.from_numpy(np.array(arrays[name][k : k + 1, :steps], dtype=np.float32)) for name in names
        )
        with torch.inference_mode():
            loops = None
            if optimizer.config.loops:
                relative, log_std = optimizer.registered(relative, log_std, codes, pair_head, origin[:, 0])
                loops = optimizer.find_loops(relative, codes, pair_head)
            attended: list[Tensor] = []

            def keep(_: nn.Module, inputs: tuple[Tensor], __: Tensor, kept: list[Tensor] = attended) -> None:
                kept.append(inputs[0])

            hook = optimizer.query.register_forward_hook(keep)
            try:
                result = optimizer(relative, log_std, motion, loops)
            finally:
                hook.remove()
            similarity = None if loops is None else loops.embeddings @ loops.embeddings.mT
            weights = torch.cat([optimizer.attend(features, similarity) for features in attended])
        truth = np.asarray(arrays["truth"][k, optimizer.block - 1 : steps : optimizer.block])
        yield Attention(weights.double().numpy(), revisits(truth, world), result)


def revisits(poses_xyyaw: np.ndarray, world: World) -> np.ndarray:
    """Which pairs of meta-poses ``(poses, 3)`` are at one place, well apart in time ``(poses, poses)``."""
    index = np.arange(len(poses_xyyaw))
    apart = np.abs(index[:, None] - index[None]) >= _MIN_SEPARATION
    return apart & alike(poses_xyyaw, world.place_radius_m, world.heading_limit_rad)


def attention_json(sources: Sources, arrays: Arrays) -> dict[str, Any]:
    """``ROW.{iterations: [{relative_entropy, revisit_mass}], uniform_share}``, means over trajectories."""
    place, _ = load_place(sources.networks, sources.world.name)
    result: dict[str, Any] = {}
    for row in ROWS:
        optimizer, _ = load_optimizer(sources.row_folder(row, 0), sources.world.name)
        found = [one for one in attention_of(optimizer, place.pair_head, arrays, sources.world) if one.revisits.any()]
        if len(found) < 2:  # nothing to say of attention on revisits
            continue
        entropy, mass = (
            np.stack([getattr(one, name) for one in found]) for name in ("relative_entropy", "revisit_mass")
        )
        result[row] = {
            "trajectories": len(found),
            "iterations": [
                {
                    "relative_entropy": mean_interval(entropy[:, k]).as_json(),
                    "revisit_mass": mean_interval(mass[:, k]).as_json(),
                }
                for k in range(entropy.shape[1])
            ],
            "uniform_share": mean_interval(np.array([one.uniform_share for one in found])).as_json(),
        }
    return result
