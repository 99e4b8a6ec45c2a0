"""Teach the optimizer of ``world:=doom`` to judge loops: how likely they join one place, and how far off they are.

    python -m training.train_loop_judge

It learns from drives on training maps, through levels of rooms and mazes that no other network has seen, by their true
poses. The command writes an optimizer without a network, with this judge (``ngo_estimator.ngo.loop_judge``);
``tune_doom`` chooses its settings then.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from tqdm import tqdm

from ngo_estimator.checkpoint import OPTIMIZER, load_local, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.graph.gauss_newton import pick
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.loop_judge import LoopJudge, evidence_of
from ngo_estimator.ngo.meta_poses import with_origin
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from training.common import records
from training.common.command_line import run_command
from training.common.training import descend, save_weights
from training.data.doom_drives import doom_episodes
from training.data.features import Networks, features_of
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, world_named
from training.scoring.doom_rows import Features

SEARCH = LoopSearch(
    per_pose=8, most=2048, views=1, registrations=5, overlaps=256, least_belief=0.5, drift_m=0.12, drift_rad=0.0075
)
"""Loops for each meta-pose and of all: belief tells so little that true ones are anywhere among them."""

TRUE_M, TRUE_RAD = 0.6, 0.175  # How far off a loop may be that joins one place.

_FIRST_SEED = 190  # Of the optimizer's: the memory learned from those before.
_MOST_DRIVES = 110
_SCALE_WEIGHT = 0.3
_WEIGHT_DECAY = 0.1  # With less, and with more steps, what it said of validation maps became worse.
_FLOOR_M, _FLOOR_RAD = 0.01, 0.002


@dataclass(frozen=True)
class Arguments:
    """Settings of a training of the judge."""

    drives: int = 70  # Drives to learn from.
    frames: int = 1000  # Frames of a drive.
    steps: int = 300  # Steps of the optimiser, each over all loops.
    learning_rate: float = 5e-3  # Learning rate at first; it falls to zero.
    seed: int = 0  # Seed of the initial weights.
    weights: Path = records.WEIGHTS  # Folder with doom/*.safetensors, which gets the optimizer.

    def __post_init__(self) -> None:
        if not 0 < self.drives <= _MOST_DRIVES:
            raise ValueError(
                f"drives is {self.drives}; expected 1 to {_MOST_DRIVES}, since train_ranges learns from those behind"
            )


class Judged(NamedTuple):
    """Loops that the odometry allows: their evidence ``(n, EVIDENCE)``, scales' logarithms and errors.

    ``log_scale`` ``(n, 2)``, ``off`` ``(n, 2)`` (m, rad), and ``weight`` ``(n,)``: a drive counts by the root of its
    loops.
    """

    evidence: Tensor
    log_scale: Tensor
    off: Tensor
    weight: Tensor

    @property
    def true(self) -> Tensor:
        """Which of them join one place ``(n,)``."""
        return (self.off[:, 0] < TRUE_M) & (self.off[:, 1] < TRUE_RAD)


def untrained(folder: Path, search: LoopSearch | None = None) -> NeuralGraphOptimizer:
    """A robust pose graph without a network, for the local network in ``folder``."""
    network, _ = load_local(folder, "doom")
    aggregation = PoseAggregationConfig(
        motion_feature_size=network.config.feature_size, relative_std=network.config.relative_std
    )
    return NeuralGraphOptimizer(
        NeuralGraphOptimizerConfig(aggregation=aggregation, network=False, search=search or SEARCH)
    )


@torch.no_grad()
def judged_of(optimizer: NeuralGraphOptimizer, pair_head: PairHead, features: Features) -> Judged:
    """The loops of a drive."""
    whole = len(features["relative"]) // optimizer.block * optimizer.block
    names = ("relative", "log_std", "motion", "codes")
    relative, log_std, motion, codes = (
        torch.from_numpy(np.asarray(features[name][:whole], dtype=np.float32)).unsqueeze(0) for name in names
    )
    steps = optimizer.aggregate(relative, log_std, motion)
    loops = optimizer.find_loops(relative, codes, pair_head)
    evidence, allowed = evidence_of(loops, steps)
    truth = with_origin(torch.from_numpy(features["truth"])[None, optimizer.block - 1 : whole : optimizer.block])
    true = se2.between(pick(truth, loops.start), pick(truth, loops.end + 1))
    error = se2.wrapped(se2.between(true, loops.measured.double()))[allowed]
    off = torch.stack((error[:, :2].norm(dim=-1), error[:, 2].abs()), dim=-1).float()
    weight = torch.full((len(off),), max(1, len(off)) ** -0.5)
    return Judged(evidence[allowed], loops.log_scale[allowed], off, weight)


def loss_of(judge: LoopJudge, loops: Judged) -> Tensor:
    """What the judge says of places ``(n,)``, and of true ones how likely it makes how far off they are."""
    logit, factor = judge(loops.evidence)
    log_scale = loops.log_scale + factor
    off = (loops.off + loops.off.new_tensor((_FLOOR_M, _FLOOR_RAD))) * torch.exp(-log_scale)
    surprise = (off + log_scale * log_scale.new_tensor((2.0, 1.0))).sum(-1)  # a position has two components
    true = loops.true.to(logit.dtype)
    return binary_cross_entropy_with_logits(logit, true, reduction="none") + _SCALE_WEIGHT * true * surprise


def learn(loops: Judged, steps: int, learning_rate: float, seed: int = 0) -> LoopJudge:
    """A judge that has learned from loops."""
    torch.manual_seed(seed)
    judge = LoopJudge()
    judge.mean.copy_(loops.evidence.mean(0))
    judge.std.copy_(loops.evidence.std(0) + 1e-3)
    weight = loops.weight / loops.weight.mean()
    descend(
        judge.parameters(),
        lambda _: (loss_of(judge, loops) * weight).mean(),
        steps,
        lambda optimizer: torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 1e-3, steps),
        lr=learning_rate,
        weight_decay=_WEIGHT_DECAY,
    )
    return judge.eval()


def together(drives: list[Judged]) -> Judged:
    """The loops of several drives."""
    return Judged(*(torch.cat(column) for column in zip(*drives, strict=True)))


def main(arguments: Arguments) -> None:
    """Learn, print and write."""
    torch.set_num_threads(1)
    folder, world = arguments.weights / "doom", world_named("doom")
    place, described = load_place(folder, "doom")
    networks = Networks(load_local(folder, "doom")[0], place)
    optimizer = untrained(folder).eval()
    drives = []
    for seed in tqdm(OPTIMIZER_TRAIN_SEEDS[_FIRST_SEED : _FIRST_SEED + arguments.drives], desc="drives"):
        for drive in doom_episodes([seed], arguments.frames):
            features = features_of(world, drive, folder, networks)
            drives.append(judged_of(optimizer, networks.place.pair_head, features))
    loops = together(drives)
    if len(loops.off) < 2:
        raise records.RunError(f"there are {len(loops.off)} loops to learn from; expected drives that return")
    judge = learn(loops, arguments.steps, arguments.learning_rate, arguments.seed)
    optimizer.loop_judge.load_state_dict(judge.state_dict())
    metrics = {"loops": len(loops.off), "true": float(loops.true.double().mean())}
    training = {**records.record("train_loop_judge", arguments), "metrics": metrics}
    details = {"place_encoder_sha256": described["sha256"], "judge": training, "metrics": {}}
    save_weights(folder, optimizer, OPTIMIZER, details)
    print(f"{metrics['loops']} loops, {metrics['true']:.0%} true")


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
