"""Train the local pose network on pairs of consecutive frames.

    python -m training.train_local --world maze2d
    python -m training.train_local --data drive_1.mcap drive_2.mcap --name my_robot

Pairs come from simulated mazes (`--world`) or from recordings (`--data`). After the training the output is calibrated
on frames that the network has not seen: one bias and one scale for each component. The weights go into the package of
the estimator. Training on recordings keeps the epoch with the smallest validation loss. Run it again to continue after
a stop.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import IterableDataset

from ngo_estimator.checkpoint import LOCAL, load_local
from ngo_estimator.networks.local_pose_network import LocalPoseConfig, LocalPoseNetwork
from ngo_recordings.errors import RecordingError
from training.common import runs
from training.common.command_line import run_command
from training.common.step_losses import LIKELIHOOD_WEIGHT, step_losses, step_metrics
from training.common.training import Figures, OverallTraining, save_weights
from training.data.batches import Batch, Share, action_histories, relative_poses
from training.data.data_module import StreamedData
from training.data.data_source import Domain
from training.data.episodes import images_of, simulate
from training.data.streams import PairStream
from training.data.worlds import OPTIMIZER_TRAIN_SEEDS, TRAIN_SEEDS, VALIDATION_SEEDS, World
from training.recordings.recording_source import SourceArguments, inputs_of, open_source
from training.recordings.recording_streams import RecordedSteps

CALIBRATION_MAZES = 64  # Mazes that the output of a world's network is calibrated in.


@dataclass(frozen=True)
class Arguments(SourceArguments):
    """Settings of a training of the local pose network."""

    without_action: bool = False  # Worlds: whether the network sees images alone, without the actions.
    width: float = 0.25  # Channels of the convolutions, as a fraction of FlowNetS's.
    epochs: int = 8  # Passes of new data.
    datapoints: int = 200_000  # Frame pairs in an epoch, of all processes; each pair of recordings twice at most.
    batch_size: int = 256  # Frame pairs in a step of the optimiser, in each process; less on small recordings.
    learning_rate: float = 2e-3  # Highest learning rate of the one-cycle schedule.
    validation_mazes: int = 8  # Mazes of the validation split that each epoch is measured on.
    workers: int = 1  # Processes that simulate for each one that trains.

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.without_action and self.world is None:
            raise ValueError("without_action is given with recordings; expected --action none, which leaves it out")


class LocalTraining(OverallTraining):
    """The training of a local network by ``step_losses`` of single steps and of windows."""

    def __init__(self, arguments: Arguments, network: LocalPoseNetwork, error_windows: tuple[int, ...] = (1,)) -> None:
        super().__init__(arguments)
        self.network, self.error_windows = network, error_windows

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        pose_loss, likelihood = stretch_losses(self.network, batch, self.error_windows)
        return pose_loss + LIKELIHOOD_WEIGHT * likelihood, {"pose_loss": pose_loss, "likelihood": likelihood}

    def estimates(self, batch: Batch) -> tuple[Tensor, ...]:
        return *estimated(self.network, batch)[:2], batch["relative"]

    def overall(self, *columns: Tensor) -> Figures:
        mean, log_std, truth = columns
        loss = step_losses(mean, log_std, truth, self.network.relative_std)[0]
        metrics = step_metrics(mean, log_std, truth)
        return {"validation_loss": loss, **{f"validation_{name}": value for name, value in metrics.items()}}


class SimulatedSteps:
    """Pairs from the mazes of a world, each used once, in the form of ``RecordedSteps``."""

    def __init__(self, arguments: Arguments, world: World) -> None:
        self.arguments, self.world = arguments, world

    def pairs(self, epoch: int, share: Share) -> IterableDataset[Batch]:
        return PairStream(self.world, TRAIN_SEEDS, epoch, self.arguments.datapoints, self.arguments.batch_size, share)

    def validation(self) -> list[Batch]:
        return episode_pairs(self.world, list(VALIDATION_SEEDS[: self.arguments.validation_mazes]))

    def unseen(self) -> list[Batch]:
        return episode_pairs(self.world, list(OPTIMIZER_TRAIN_SEEDS[-CALIBRATION_MAZES:]))

    def typical(self) -> Tensor:
        return typical_steps(self.world)


def typical_steps(world: World) -> Tensor:
    """Relative poses ``(n, 3)`` of drives through mazes of the training."""
    return torch.cat([pairs["relative"] for pairs in episode_pairs(world, list(TRAIN_SEEDS[:8]))])


def episode_pairs(world: World, seeds: list[int]) -> list[Batch]:
    """All consecutive frames of an episode in each of the mazes ``seeds``."""
    result = []
    for episode in simulate(world, seeds, 1000):
        images = images_of(world, episode)
        pairs = {"earlier": images[:-1], "later": images[1:], "relative": relative_poses(episode.poses_xyyaw)}
        if world.actions:
            pairs["action"] = action_histories(episode.actions)
        result.append(pairs)
    return result


def estimated(network: LocalPoseNetwork, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
    """The network's estimate of a batch of pairs: mean, logarithm of the deviations, motion features."""
    estimate: tuple[Tensor, Tensor, Tensor] = network(
        batch["earlier"], batch["later"], batch.get("action"), batch.get("twist")
    )
    return estimate


def stretch_losses(network: LocalPoseNetwork, batch: Batch, windows: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """The losses of a network on a batch of stretches, each with the steps of the longest of ``windows``.

    The estimate from the frames alone has the ``step_losses`` of single steps. Where the network also takes earlier
    actions, its fused estimate has those of all windows; their gradient does not reach the estimate from the frames.
    """
    estimates = network.estimates(batch["earlier"], batch["later"], batch.get("action"), batch.get("twist"))
    truth, std = batch["relative"], network.relative_std
    pose_loss, likelihood = step_losses(*estimates.visual, truth, std)
    if estimates.fused is estimates.visual:
        return pose_loss, likelihood
    mean, log_std, truth = (values.unflatten(0, (-1, max(windows))) for values in (*estimates.fused, truth))
    of_fused = step_losses(mean, log_std, truth, std, windows)
    return pose_loss + of_fused[0], likelihood + of_fused[1]


@torch.no_grad()
def calibrated(network: LocalPoseNetwork, pairs: list[Batch], steps: int = 1) -> LocalPoseConfig:
    """The network's configuration with the bias and scale of each component that fit ``pairs`` best (least squares).

    Each deviation is scaled so that its mean square equals that of the errors, of both summed over so many ``steps``
    that follow each other in a drive. Where errors last, more of them make deviations larger than those of a step.
    """
    network = network.eval()
    parts = [estimated(network, p) for p in pairs]
    lengths = [len(p["relative"]) for p in pairs]
    estimates, log_std = (torch.cat([part[k] for part in parts]).double() for k in (0, 1))
    truth = torch.cat([p["relative"] for p in pairs]).double()
    mean, std = list(network.config.relative_mean), list(network.config.relative_std)
    bias = list(network.config.relative_bias)
    fits = torch.zeros_like(truth)
    for i in range(3):
        fitted, _ = np.polyfit(estimates[:, i].numpy(), truth[:, i].numpy(), 1)
        scale = max(fitted, 0.01)  # what was not learned at all may fit best mirrored; a deviation stays positive
        rest = float((truth[:, i] - scale * estimates[:, i]).mean())
        mean[i], std[i], bias[i] = float(scale * mean[i]), float(scale * std[i]), float(scale * bias[i] + rest)
        fits[:, i] = scale * estimates[:, i] + rest
        log_std[:, i] += math.log(scale)
    fitted_values = {"relative_mean": tuple(mean), "relative_std": tuple(std), "relative_bias": tuple(bias)}
    deviation = lasting_deviation((fits - truth).split(lengths), log_std.mul(2.0).exp().split(lengths), steps)
    return dataclasses.replace(network.config, **fitted_values, deviation_scale=deviation)  # type: ignore[arg-type]


def lasting_deviation(errors: Sequence[Tensor], variances: Sequence[Tensor], steps: int) -> tuple[float, float, float]:
    """The factor of deviations with which errors ``(n, 3)`` of drives, summed over so many ``steps``, are as stated."""
    squares = [
        _sums(error, steps).square() / _sums(variance, steps) for error, variance in zip(errors, variances, strict=True)
    ]
    x, y, yaw = torch.cat(squares).mean(0).sqrt().clamp(min=0.01).tolist()
    return x, y, yaw


def _sums(values: Tensor, steps: int) -> Tensor:
    """Sums of each ``steps`` rows of ``values`` ``(n, 3)`` that follow each other; of all rows where there are less."""
    return values.unfold(0, min(steps, len(values)), 1).sum(-1)


def main(arguments: Arguments) -> dict[str, float]:
    """Train, calibrate, write the weights, and return the validation metrics (in the first process, which does so)."""
    source = open_source(arguments)
    domain = source.domain
    if arguments.without_action:
        domain = dataclasses.replace(domain, actions=0, mirrored_actions=())
    settings: dict[str, Any] | None = None
    steps: SimulatedSteps | RecordedSteps
    if isinstance(domain, World):
        steps = SimulatedSteps(arguments, domain)
        of_steps = {"action_history": domain.action_history, "error_windows": list(domain.error_windows)}
        settings = {**of_steps, **domain.stream_settings}
    elif source.recorded is not None:
        steps = RecordedSteps(source.recorded, arguments.datapoints, arguments.batch_size)
    kind = "local-no_action" if arguments.without_action else "local"
    run = runs.Run(
        arguments.runs / domain.name / kind,
        "train_local",
        arguments,
        arguments.epochs,
        best="validation_loss",
        data=source.sha256,
        settings=settings,
    )
    network, begun = initial_network(arguments, domain, steps)
    training = LocalTraining(arguments, network, domain.error_windows)
    data = StreamedData(steps.pairs, steps.validation, arguments.workers)
    run.fit(training, data)
    if not run.is_first:
        return {}
    training.cpu()
    final = LocalPoseNetwork(calibrated(network, steps.unseen(), domain.deviation_steps)).eval()
    final.load_state_dict(network.state_dict())
    metrics = measure(final, data.validation)
    save_weights(arguments.out / domain.name, final, LOCAL, {**run.ended(metrics, begun), **source.about})
    return metrics


def initial_network(
    arguments: Arguments, domain: Domain, steps: SimulatedSteps | RecordedSteps
) -> tuple[LocalPoseNetwork, dict[str, str]]:
    """A fresh network or that of ``--from-weights``, and the entry of the JSON that names these weights.

    Raises ``RecordingError`` where those weights take other images, or other control inputs.
    """
    wanted = domain.action_history if domain.actions else 1
    if arguments.recordings.from_weights is not None:
        return _begun_network(arguments.recordings.from_weights, domain, wanted)
    some = steps.typical()
    config = LocalPoseConfig(
        image=domain.image,
        width=arguments.width,
        actions=domain.actions,
        period_s=domain.period_s,
        relative_mean=(float(some[:, 0].mean()), 0.0, 0.0),
        # A robot that never moves sideways gives no scale for it.
        relative_std=(float(some[:, 0].std()), max(float(some[:, 1].std()), 1e-4), max(float(some[:, 2].std()), 1e-4)),
        symmetric=domain.mirrors,
        mirrored_actions=domain.mirrored_actions,
        twist=domain.twist,
        twist_scale=domain.twist_scale,
        action_history=wanted,
    )
    return LocalPoseNetwork(config), {}


def _begun_network(folder: Path, domain: Domain, wanted: int) -> tuple[LocalPoseNetwork, dict[str, str]]:
    network, description = load_local(folder)
    config = network.config
    if (config.actions, config.twist) != (domain.actions, domain.twist):
        raise RecordingError(
            f"{folder} takes {inputs_of(config)}, {domain.name} has {inputs_of(domain)}; expected the same "
            "(--action none, --twist none leave them out)"
        )
    if config.image != domain.image:
        raise RecordingError(f"{folder} takes {config.image}; expected {domain.image}")
    if config.action_history not in (1, wanted):
        raise RecordingError(f"{folder} takes the latest {config.action_history} actions; expected 1 or {wanted}")
    # Calibrated they are anew; a memory was of the steps of these weights.
    changes: dict[str, Any] = {"deviation_scale": (1.0, 1.0, 1.0), "relative_bias": (0.0, 0.0, 0.0), "memory": None}
    if domain.mirrors:
        changes |= {"symmetric": True, "mirrored_actions": domain.mirrored_actions}
    changed = LocalPoseNetwork(dataclasses.replace(config, period_s=domain.period_s, action_history=wanted, **changes))
    # What takes earlier actions into account is new where the weights know none.
    kept = {name: value for name, value in network.state_dict().items() if not name.startswith("memory.")}
    changed.load_state_dict(changed.state_dict() | kept)
    return changed, {"began_with_sha256": description["sha256"]}


@torch.no_grad()
def measure(network: LocalPoseNetwork, pairs: list[Batch]) -> dict[str, float]:
    """``step_metrics`` of a network over episodes."""
    mean, log_std, _ = (torch.cat(column) for column in zip(*(estimated(network, p) for p in pairs), strict=True))
    return step_metrics(mean, log_std, torch.cat([p["relative"] for p in pairs]))


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
