"""Fine-tune all networks of a world together, from their trained weights, on short trajectories.

    python -m training.train_end_to_end --world maze2d

Each simulated trajectory is in a maze of its own and is used once. The loss of the corrected trajectory reaches both
encoders through optimizer, loop measurements and aggregation, but no registration of scans: there the place encoder
learns loops alone, and its ranges stay. The result is a set of weights of its own for the estimator. Run it again to
continue after a stop.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from ngo_estimator.checkpoint import (
    LOCAL,
    OPTIMIZER,
    PLACE,
    PlaceNetworks,
    load_local,
    load_optimizer,
    load_place,
)
from ngo_estimator.data.weights_file import CheckpointError, load_description
from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import LocalPoseNetwork
from ngo_estimator.ngo.meta_poses import OptimizedTrajectory
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from training.common import records, runs
from training.common.command_line import run_command
from training.common.step_losses import LIKELIHOOD_WEIGHT, step_losses, step_metrics, windows_within
from training.common.trainer_arguments import TrainerArguments
from training.common.training import Figures, Training, save_weights
from training.data.batches import Batch, Share
from training.data.data_module import StreamedData
from training.data.streams import TrajectoryStream
from training.data.trajectories import rmse_figures
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, VALIDATION_SEEDS, world_named
from training.train_optimizer import trajectory_loss


@dataclass(frozen=True)
class Arguments(TrainerArguments):
    """Settings of a training of all networks together."""

    world: Literal["maze2d", "maze3d"]  # World to train for.
    steps: int = 512  # Steps of a trajectory.
    epochs: int = 8  # Passes of new data.
    batches: int = 128  # Batches in an epoch, of all processes.
    batch_size: int = 2  # Trajectories in a step of the optimiser, in each process; at most 8.
    learning_rate: float = 1e-4  # Highest learning rate of aggregation and optimizer.
    encoder_learning_rate: float = 2e-5  # Highest learning rate of the local network, the place encoder and pair head.
    local_weight: float = 1.0  # Weight of the local network's own loss, which keeps the odometry as good as it was.
    validation_trajectories: int = 16  # Trajectories of the validation split that each epoch is measured on.
    workers: int = 1  # Processes that simulate for each one that trains.
    weights: Path = records.WEIGHTS  # Folder with WORLD/ as the stages made it: the three networks to start from.
    out: Path = field(default=records.ROOT / "runs" / "end_to_end", kw_only=True)  # Folder that gets WORLD/.


class EndToEndTraining(Training):
    """The optimizer's loss on corrected trajectories, and the local network's own loss as an anchor."""

    def __init__(
        self,
        arguments: Arguments,
        local: LocalPoseNetwork,
        place: PlaceNetworks,
        optimizer: NeuralGraphOptimizer,
        scale_m: float,
        scale_rad: float,
        error_windows: tuple[int, ...] = (1,),
    ) -> None:
        super().__init__(arguments)
        self.scale_m, self.scale_rad, self.error_windows = scale_m, scale_rad, error_windows
        self.local_weight, self.encoder_learning_rate = arguments.local_weight, arguments.encoder_learning_rate
        self.local, self.place, self.optimizer = local, place, optimizer
        self.requires_grad_(True)
        self.place.requires_grad_(optimizer.config.loops)  # the paper's form has no use for them
        if place.config.sees_ranges:
            self.place.encoder.keep_ranges()  # no gradient comes through a registration

    def forward(self, batch: Batch) -> tuple[Tensor, Tensor, OptimizedTrajectory]:
        """Relative poses and logarithms of their deviations ``(batch, steps, 3)``, and the corrected trajectories."""
        # As they will be used: the local network's estimate is another one while it is trained alone.
        self.local.eval()
        shape = batch["relative"].shape[:2]
        earlier, later = batch["images"][:, :-1].flatten(0, 1), batch["images"][:, 1:].flatten(0, 1)
        estimates = self.local(earlier, later, batch["action"].flatten(0, 1))
        relative, log_std, motion = (value.float().unflatten(0, shape) for value in estimates)
        relative, log_std = self.local.remembered(relative, log_std, motion)
        has_loops = self.optimizer.config.loops
        codes = self.place.encoder(later).float().unflatten(0, shape) if has_loops else relative
        steps = relative, log_std
        # Sums over the whole trajectory and linear systems need all digits, and are small.
        with torch.autocast(self.device.type, enabled=False):
            loops = None
            if has_loops:
                origin = self.place.encoder(batch["images"][:, 0]).float()
                steps = self.optimizer.registered(*steps, codes, self.place.pair_head, origin)
                loops = self.optimizer.find_loops(steps[0], codes, self.place.pair_head)
            result = self.optimizer(*steps, motion, loops)
        return relative, log_std, result

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        relative, log_std, result = self(batch)
        block = self.optimizer.block
        truth = se2.r2g(batch["relative"])[:, block - 1 :: block]
        std = self.optimizer.correction_std
        corrected = trajectory_loss(result.meta_relative, truth, std, self.scale_m, self.scale_rad)
        pose_loss, likelihood = step_losses(
            relative, log_std, batch["relative"], self.local.relative_std, self.error_windows
        )
        loss = corrected + self.local_weight * (pose_loss + LIKELIHOOD_WEIGHT * likelihood)
        return loss, {"loss": loss, "trajectory_loss": corrected, "pose_loss": pose_loss, "likelihood": likelihood}

    def figures(self, batch: Batch) -> Figures:
        """Mean errors of trajectories before and after correction (RMSE; m, deg), and the errors of single steps."""
        relative, log_std, result = self(batch)
        truth = se2.r2g(batch["relative"])
        poses = {"odometry": se2.r2g(relative), "corrected": result.poses}
        rmse = [rmse_figures(name, of_one, truth) for name, of_one in poses.items()]
        steps = step_metrics(*(value.flatten(0, 1) for value in (relative, log_std, batch["relative"])))
        figures = {name: float(value) for of_one in rmse for name, value in of_one.items()}
        figures |= {f"step_{name}": value for name, value in steps.items()}
        return {f"validation_{name}": value for name, value in figures.items()}

    def parameter_groups(self) -> list[dict[str, Any]]:
        encoders = [p for network in (self.local, self.place) for p in network.parameters() if p.requires_grad]
        groups: list[dict[str, Any]] = [
            {"params": list(self.optimizer.parameters()), "lr": self.arguments.learning_rate}
        ]
        return [*groups, {"params": encoders, "lr": self.encoder_learning_rate}]


@torch.no_grad()
def measure(training: EndToEndTraining, batches: list[Batch]) -> dict[str, float]:
    """Means of the figures over batches, on the CPU."""
    training.cpu()
    figures = [training.figures(batch) for batch in batches]
    return {
        name.removeprefix("validation_"): float(sum(f[name] for f in figures)) / len(figures) for name in figures[0]
    }


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    world = world_named(arguments.world)
    staged, out = arguments.weights / world.name, arguments.out / world.name
    if staged.resolve() == out.resolve():
        raise ValueError(f"out is {arguments.out}, the folder of the weights to start from; expected another one")
    local, local_description = load_local(staged, world.name)
    place, place_description = load_place(staged, world.name)
    optimizer, description = load_optimizer(staged, world.name)
    if description.get("place_encoder_sha256", place_description["sha256"]) != place_description["sha256"]:
        raise CheckpointError(f"{staged}: the optimizer was trained with another place encoder than the one beside it")
    block = optimizer.block
    if arguments.steps % block or arguments.steps < block:
        raise ValueError(f"steps is {arguments.steps}; expected a multiple of {block}, the steps of a meta-pose")
    run = runs.Run(
        arguments.runs / world.name / f"end_to_end-seed{arguments.seed}",
        "train_end_to_end",
        arguments,
        arguments.epochs,
        datapoints=lambda batch: batch["relative"].shape[0] * batch["relative"].shape[1],
        settings=world.stream_settings,
    )
    windows = windows_within(arguments.steps, world.error_windows)
    training = EndToEndTraining(arguments, local, place, optimizer, world.block_m, world.loss_scale_rad, windows)
    # Mazes that neither the local network nor the feature store has seen.
    seeds = OPTIMIZER_TRAIN_SEEDS[len(OPTIMIZER_TRAIN_SEEDS) // 2 :]

    def stream(epoch: int, share: Share) -> TrajectoryStream:
        return TrajectoryStream(world, seeds, epoch, arguments.batches, arguments.batch_size, arguments.steps, share)

    def validation() -> list[Batch]:
        batches = max(1, arguments.validation_trajectories // arguments.batch_size)
        return list(TrajectoryStream(world, VALIDATION_SEEDS, 0, batches, arguments.batch_size, arguments.steps))

    data = StreamedData(stream, validation, arguments.workers)
    before = measure(training, data.validation)
    run.fit(training, data)
    if not run.is_first:
        return {}
    metrics = measure(training, data.validation)
    ended = run.ended(metrics)
    stages = {LOCAL: local_description, PLACE: place_description, OPTIMIZER: description}
    details = {
        **ended,
        "metrics": {**ended["metrics"], "validation_of_stages": before},
        "stages_sha256": {kind: described["sha256"] for kind, described in stages.items()},
    }
    save_weights(out, local, LOCAL, details)
    save_weights(out, place, PLACE, details)
    trained_with = load_description(out / f"{PLACE}.safetensors", PLACE)["sha256"]
    save_weights(out, optimizer, OPTIMIZER, {"place_encoder_sha256": trained_with, **details})
    return metrics


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
