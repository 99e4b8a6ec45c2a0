"""Train the smoother of the odometry on whole trajectories of the feature store.

    python -m training.train_smoother --world maze3d
    python -m training.train_smoother --data drive_1.mcap drive_2.mcap --name my_robot
    python -m training.train_smoother --world doom --memory

The weights go beside those of the other networks. `train_optimizer` takes them from there where it smooths
(`--smoothing True`), so train the smoother first. With `--memory` it corrects a step by those before it alone, and
becomes part of the local network, whose odometry is better from then on: make the feature store anew after it. Both
learn from the mirrored trajectories of `featurise --mirror-drives` as well. Run it again to continue after a stop.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ngo_estimator.checkpoint import LOCAL, SMOOTHER, load_local, load_place, load_smoother
from ngo_estimator.geometry import se2
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig, block_variances, poses_in_blocks
from training.common import records, runs
from training.common.command_line import run_command
from training.common.precision import Precision
from training.common.step_losses import LIKELIHOOD_WEIGHT, step_losses, windows_within
from training.common.training import Figures, Training, save_weights
from training.data.batches import Batch
from training.data.data_source import MIRRORED_STORE, TRAIN_STORE
from training.data.feature_store import training_stores
from training.data.trajectories import StoredTrajectories, correction_scale, rmse_figures, stretch_data
from training.recordings.recording_source import SourceArguments, open_source
from training.train_local import lasting_deviation

ERROR_WINDOWS = (1, 4, 16)
"""Meta-poses that follow each other, over which errors are added up: what lasts makes the odometry drift."""

_STORES = (TRAIN_STORE,)  # another driver's ways cost more on the first one's than they are worth
_BLOCK = PoseAggregationConfig(1).block
_LARGEST_OF_MEMORY = 2.0  # a robot that slides along a wall moves sideways faster than it usually does


@dataclass(frozen=True)
class Arguments(SourceArguments):
    """Settings of a training of the odometry smoother."""

    memory: bool = False  # Whether it sees earlier steps alone, and becomes the memory of the local network.
    epochs: int = 300  # Epochs; the learning rate falls to zero over all of them.
    steps: int = 40  # Steps of the optimiser in an epoch; of recordings at most one for each stretch, or eight.
    batch_size: int = 8  # Trajectories in a step.
    learning_rate: float = 3e-3  # Highest learning rate.
    precision: Precision = field(default="32-true", kw_only=True)  # Arithmetic of the network.
    weights: Path = records.WEIGHTS  # Folder with NAME's local network and place encoder, of which the features are.


class SmootherTraining(Training):
    """Errors of smoothed steps and meta-poses; on the validation split, errors of whole trajectories by odometry.

    ``step_std`` and ``meta_std`` (m, m, rad) are the errors of steps and meta-poses that are not smoothed.
    """

    weight_decay = 1e-3

    def __init__(self, arguments: Arguments, smoother: OdometrySmoother, step_std: Tensor, meta_std: Tensor) -> None:
        super().__init__(arguments)
        self.smoother = smoother
        self.register_buffer("step_std", step_std, persistent=False)
        self.register_buffer("meta_std", meta_std, persistent=False)
        self.step_std: Tensor
        self.meta_std: Tensor

    def forward(self, batch: Batch) -> Any:
        return self.smoother(batch["relative"], batch["log_std"], batch["motion"])

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        relative, log_std = self(batch)
        loss = smoothing_loss(relative, log_std, batch["truth"], self.step_std, self.meta_std)
        return loss, {"loss": loss}

    def figures(self, batch: Batch) -> Figures:
        odometry, smoothed = (se2.r2g(relative) for relative in (batch["relative"], self(batch)[0]))
        return rmse_figures("odometry", odometry, batch["truth"]) | rmse_figures("smoothed", smoothed, batch["truth"])


def smoothing_loss(relative: Tensor, log_std: Tensor, truth: Tensor, step_std: Tensor, meta_std: Tensor) -> Tensor:
    """Errors of steps, errors of meta-poses added up over windows, and what the meta-poses' deviations say of these.

    Args:
        relative, log_std: smoothed steps ``(batch, steps, 3)``, and the logarithm of their deviations.
        truth: true global poses after each step ``(batch, steps, 3)``.
        step_std, meta_std: units of the errors of steps and of meta-poses ``(3,)``.
    """
    in_blocks = poses_in_blocks(relative, _BLOCK)
    steps = se2.wrapped(relative - se2.g2r(truth))
    metas = se2.wrapped(in_blocks[..., -1, :] - se2.g2r(truth[:, _BLOCK - 1 :: _BLOCK]))
    deviations = 0.5 * block_variances(in_blocks.detach(), log_std).log()
    windows = windows_within(metas.shape[1], ERROR_WINDOWS)
    of_steps, _ = step_losses(steps, torch.zeros_like(steps), torch.zeros_like(steps), step_std)
    of_metas, likelihood = step_losses(metas, deviations, torch.zeros_like(metas), meta_std, windows)
    return of_steps + of_metas + LIKELIHOOD_WEIGHT * likelihood


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    name = arguments.name
    folder, out = arguments.weights / name, arguments.out / name
    local, described = load_local(folder, name)
    if arguments.memory and local.config.memory is not None:
        raise records.RunError(
            f"the local network in {folder} has a memory already; expected one as train_local wrote it"
        )
    source = open_source(arguments, (local, described))
    place, of_place = load_place(folder, name)
    features = arguments.runs / name / "features"
    learned_from = (*_STORES, MIRRORED_STORE) if (features / MIRRORED_STORE).exists() else _STORES
    stores = training_stores(features, learned_from, source.domain, described, of_place)
    train, validation = (StoredTrajectories(some, None, place.pair_head, _BLOCK) for some in stores)
    made_with = {"local_pose_network_sha256": described["sha256"]}
    run = runs.Run(
        arguments.runs / name / f"{'memory' if arguments.memory else 'smoother'}-seed{arguments.seed}",
        "train_smoother",
        arguments,
        arguments.epochs,
        best="smoothed_m",
        data=source.sha256,
        settings={"error_windows": ERROR_WINDOWS, "stores": learned_from, "trajectories": len(train), **made_with},
    )
    scales = (torch.tensor(correction_scale(train, steps)) for steps in (1, train.block))
    smoother, begun = initial_smoother(arguments, local.config)
    training = SmootherTraining(arguments, smoother, *scales)
    few = source.recorded is not None
    data = stretch_data(train, validation, arguments.steps, arguments.batch_size, arguments.seed, few)
    run.fit(training, data)
    metrics = run.validate(training, data)
    if not run.is_first:
        return {}
    smoother.cpu()
    details = {**made_with, **run.ended(metrics, begun)}
    if arguments.memory:
        lasting = source.domain.deviation_steps
        remembering = with_memory(local, smoother, data.validation, lasting)
        of_memory = {"memory": {**details, "deviation_steps": lasting}}
        save_weights(out, remembering, LOCAL, records.kept_details(described) | of_memory)
    else:
        save_weights(out, smoother, SMOOTHER, {**details, **source.about}, half=True)
    return metrics


@torch.no_grad()
def with_memory(
    local: LocalPoseNetwork, smoother: OdometrySmoother, held_out: list[Batch], steps: int
) -> LocalPoseNetwork:
    """The local network with a causal smoother as its memory, without a bias on drives that were held out.

    Its deviations are those of errors over so many ``steps``, as ``train_local`` fits them.
    """
    errors, variances = [], []
    for batch in held_out:
        relative, log_std = smoother(batch["relative"], batch["log_std"], batch["motion"])
        errors += list(se2.wrapped(relative - se2.g2r(batch["truth"])))
        variances += list(torch.exp(2.0 * log_std))
    x, y, yaw = torch.cat(errors).mean(0).tolist()
    errors = [error - error.new_tensor((x, y, yaw)) for error in errors]
    memory = dataclasses.replace(
        smoother.config,
        relative_bias=(-x, -y, -yaw),
        deviation_scale=lasting_deviation(errors, variances, steps),
    )
    remembering = LocalPoseNetwork(dataclasses.replace(local.config, memory=memory)).eval()
    of_memory = {f"memory.{name}": value for name, value in smoother.state_dict().items()}
    remembering.load_state_dict(local.state_dict() | of_memory)
    return remembering


def initial_smoother(arguments: Arguments, local: LocalPoseConfig) -> tuple[OdometrySmoother, dict[str, str]]:
    """A fresh smoother, or that of the weights to begin with; and what the JSON beside the new weights says of it.

    Raises:
        RunError: the weights are of a smoother for other steps.
    """
    largest = _LARGEST_OF_MEMORY if arguments.memory else 1.0
    config = SmootherConfig(local.feature_size, local.relative_std, causal=arguments.memory, largest=largest)
    began = arguments.recordings.from_weights
    if began is None:
        return OdometrySmoother(config), {}
    smoother, description = load_smoother(began)
    if smoother.config.motion_feature_size != config.motion_feature_size:
        raise records.RunError(
            f"the smoother in {began} takes {smoother.config.motion_feature_size} motion features; expected "
            f"{config.motion_feature_size}, as the local network gives"
        )
    return smoother.requires_grad_(True).train(), {"began_with_sha256": description["sha256"]}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
