"""Train the network of the learned corrector, which says which loops of a pose graph are right.

    python -m training.train_graph_corrector
    python -m training.train_graph_corrector --no-attention

Each step draws new graphs (``training.scoring.drawn_graphs``), and the network learns at the chain and at poses that it
has corrected itself. The weights go to NAME/ in the package of the estimator. Run it again to continue after a stop.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import IterableDataset

from ngo_estimator.checkpoint import LOOP_ATTENTION
from ngo_estimator.graph.crowds import without_crowds
from ngo_estimator.graph.learned import solved, tensors
from ngo_estimator.graph.loop_features import LoopView
from ngo_estimator.graph.robust import Robust
from ngo_estimator.networks.loop_attention import LoopAttention, LoopAttentionConfig
from training.common import runs
from training.common.command_line import run_command
from training.common.precision import Precision
from training.common.trainer_arguments import TrainerArguments
from training.common.training import Figures, Training, save_weights
from training.data.batches import Batch, Share
from training.data.data_module import StreamedData
from training.scoring.drawn_graphs import TRAIN_SEEDS, VALIDATION_SEEDS, drawn

_ROBUST_EVERY = 6  # graphs of which one is also seen as the robust corrector solves it


@dataclass(frozen=True)
class Arguments(TrainerArguments):
    """Settings of a training of the learned corrector."""

    attention: bool = True  # Whether loops attend to each other; without, the baseline.
    epochs: int = 6  # Epochs; the learning rate falls to zero over all of them.
    steps: int = 50  # Steps of the optimiser in an epoch.
    batch_size: int = 2  # Graphs in a step.
    validation: int = 12  # Graphs that each epoch is measured on.
    learning_rate: float = 3e-3  # Highest learning rate.
    precision: Precision = field(default="32-true", kw_only=True)  # Of the network; graphs are solved in float64.

    @property
    def name(self) -> str:
        """Folder of the weights."""
        return "graphs" if self.attention else "graphs_without_attention"


class GraphTraining(Training):
    """Cross-entropy of loops, as seen at the chain and under the network's own poses."""

    weight_decay = 1e-3

    def __init__(self, arguments: Arguments, network: LoopAttention) -> None:
        super().__init__(arguments)
        self.network = network

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        graphs = [torch.stack([loss for loss, _ in self._looked_at(int(seed))]).mean() for seed in batch["seed"]]
        loss = torch.stack(graphs).mean()
        return loss, {"loss": loss}

    def figures(self, batch: Batch) -> Figures:
        """Cross-entropy and accuracy at the chain, and after it."""
        (first, of_first), (second, of_second), *_ = self._looked_at(int(batch["seed"][0]))
        return {"chain": first, "chain_accuracy": of_first, "corrected": second, "corrected_accuracy": of_second}

    def _looked_at(self, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Cross-entropy and accuracy at each state of the graph of a seed."""
        judged = drawn(seed)
        rng = np.random.default_rng((seed, 1))
        problem, right = judged.problem, torch.from_numpy(judged.right.astype(np.float32))
        if rng.uniform() < 0.5:
            told = rng.uniform(0.0, 2.0) * judged.right + rng.normal(size=len(judged.right))
            problem = replace(problem, similarity=told[:, None])
        problem = without_crowds(problem)
        view = LoopView(problem)
        poses, weights = problem.poses, np.zeros(len(right))
        for look in range(3):
            logit = self.network(*tensors(view.under(poses, weights)))
            yield binary_cross_entropy_with_logits(logit, right), ((logit > 0.0) == (right > 0.5)).float().mean()
            weights = logit.detach().sigmoid().double().numpy()
            if look == 0:
                poses = solved(problem, poses, weights)
            elif seed % _ROBUST_EVERY == 0:
                solution = Robust().correct(judged.problem)
                poses, weights = solution.poses, solution.loop_weights
            else:
                return


class _Seeds(IterableDataset[Batch]):
    def __init__(self, first: int, stride: int, steps: int, size: int) -> None:
        self.first, self.stride, self.steps, self.size = first, stride, steps, size

    def __len__(self) -> int:
        return self.steps

    def __iter__(self) -> Iterator[Batch]:
        for step in range(self.steps):
            first = self.first + step * self.stride
            yield {"seed": torch.arange(first, first + self.size)}


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    run = runs.Run(
        arguments.runs / arguments.name / f"seed{arguments.seed}",
        "train_graph_corrector",
        arguments,
        arguments.epochs,
    )
    network = LoopAttention(LoopAttentionConfig(attention=arguments.attention))
    training, size = GraphTraining(arguments, network), arguments.batch_size
    seeds = TRAIN_SEEDS[arguments.seed * len(TRAIN_SEEDS) // 10 :]

    def stream(epoch: int, share: Share) -> _Seeds:
        steps = arguments.steps // share.ranks
        first = seeds[(epoch * arguments.steps + share.rank) * size]
        return _Seeds(first, size * share.ranks, steps, size)

    held_out = [{"seed": torch.tensor([seed])} for seed in islice(VALIDATION_SEEDS, arguments.validation)]
    data = StreamedData(stream, lambda: held_out, 0)
    run.fit(training, data)
    metrics = run.validate(training, data)
    if run.is_first:
        details = run.ended(metrics)
        save_weights(arguments.out / arguments.name, network.cpu(), LOOP_ATTENTION, details)
    return metrics


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
