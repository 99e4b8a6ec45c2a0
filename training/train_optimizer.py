"""Train the pose aggregation and the Neural Graph Optimizer on whole trajectories of the feature store.

    python -m training.train_optimizer --world maze2d
    python -m training.train_optimizer --data drive_1.mcap drive_2.mcap --name my_robot

The weights go into the package of the estimator. Training on recordings checks the optimizer on the validation part: if
it does not correct these trajectories, an optimizer that closes no loops is written instead. Run it again to continue
after a stop.
"""

import dataclasses
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import lightning
import torch
from torch import Tensor, nn
from torch.nn.functional import huber_loss

from ngo_estimator.checkpoint import OPTIMIZER, load_local, load_optimizer, load_place, load_smoother, save_checkpoint
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.ngo.loop_closing import OVERLAPS_AFTER
from ngo_estimator.ngo.neural_graph_optimizer import (
    NeuralGraphOptimizer,
    NeuralGraphOptimizerConfig,
)
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from training.common import records, runs
from training.common.command_line import run_command
from training.common.precision import Precision
from training.data.batches import Batch
from training.data.data_source import Domain
from training.data.feature_store import training_stores
from training.data.trajectories import (
    StoredTrajectories,
    StretchData,
    correction_scale,
    loops_of,
    rmse_figures,
)
from training.data.worlds import world_named
from training.recordings.recording_source import (
    NO_LOOPS,
    RecordedData,
    SourceArguments,
    open_recorded,
)

HEADING_WEIGHT = 0.3
RELATIVE_WEIGHT = 0.05
_LEAST_GAIN = 0.1
"""Of loops on the validation part of recordings, which is small: less may be chance, and do harm on a longer way."""


@dataclass(frozen=True)
class Arguments(SourceArguments):
    """Settings of a training of the optimizer."""

    form: Literal["loops", "gauss_newton", "paper"] = "loops"
    """loops: attention, convolution and loop closures. gauss_newton: loop closures alone. paper: no loop closures."""
    iterations: int = 5
    """Attend-optimise iterations."""
    smoothing: bool | None = None
    """Whether the smoother of ``train_smoother`` smooths the odometry before loops are closed; none: the world's
    default, and no smoothing for recordings."""
    width: int = 64
    """Channels of aggregation and optimizer."""
    loops_per_pose: int | None = None
    """Loop candidates of a meta-pose; none: the world's default."""
    max_loops: int | None = None
    """Loop candidates of a trajectory; none: the world's default."""
    epochs: int | None = None
    """Epochs, over which the learning rate falls to zero; none: the world's default."""
    steps: int = 40
    """Steps of the optimiser in an epoch; of recordings at most one for each stretch."""
    batch_size: int = 8
    """Trajectories in a step."""
    learning_rate: float = 1e-3
    """Highest learning rate."""
    seed: int = 0
    """Seed of initial weights and of the order of the data."""
    precision: Precision = field(default="32-true", kw_only=True)
    """Arithmetic of the network; loops are always closed in float64."""
    weights: Path = records.WEIGHTS
    """Folder with NAME's other networks."""
    out: Path = records.WEIGHTS
    """Folder that gets NAME/neural_graph_optimizer.safetensors."""
    runs: Path = records.ROOT / "runs"
    """Folder of the feature stores, checkpoints and logs."""


def trajectory_loss(
    meta_relative: list[Tensor], truth: Tensor, correction_std: Tensor, scale_m: float, scale_rad: float
) -> Tensor:
    """Huber losses on global and relative meta-poses after every iteration, later ones with more weight.

    Args:
        meta_relative: relative meta-poses ``(batch, blocks, 3)`` after each iteration.
        truth: true global meta-poses ``(batch, blocks, 3)``.
        correction_std: typical error of a relative meta-pose ``(3,)``.
        scale_m, scale_rad: errors of position and heading below count by their square, so that large ones do not rule.
    """
    true_relative = se2.g2r(truth)
    loss, weights = truth.new_zeros(()), 0.0
    for number, relative in enumerate(meta_relative, start=1):
        error = se2.r2g(relative) - truth
        position = huber_loss(error[..., :2] / scale_m, torch.zeros_like(error[..., :2]), delta=1.0)
        heading = huber_loss(error[..., 2] / scale_rad, torch.zeros_like(error[..., 2]), delta=1.0)
        local = step_loss(relative, true_relative, correction_std)
        loss = loss + number * (position + HEADING_WEIGHT * heading + RELATIVE_WEIGHT * local)
        weights += number
    return loss / weights


def step_loss(relative: Tensor, truth: Tensor, std: Tensor) -> Tensor:
    """Huber loss on relative poses ``(batch, steps, 3)`` in units of their deviations."""
    step = relative - truth
    step = se2.wrapped(step) / std
    return huber_loss(step, torch.zeros_like(step), delta=1.0)


class OptimizerTraining(lightning.LightningModule):
    """``trajectory_loss`` on stretches of trajectories; on the validation split, errors of whole ones."""

    def __init__(
        self,
        arguments: Arguments,
        optimizer: NeuralGraphOptimizer,
        domain: Domain,
        registration: RegistrationConfig | None = None,
    ) -> None:
        super().__init__()
        self.arguments, self.optimizer, self.domain = arguments, optimizer, domain
        self.registration = registration
        if optimizer.config.smoother is not None:
            optimizer.smoother.requires_grad_(False)  # it has learned what it can, at a rate of its own

    def forward(self, batch: Batch) -> Any:
        loops = loops_of(batch, self.registration)
        return self.optimizer(batch["relative"], batch["log_std"], batch["motion"], loops)

    def training_step(self, batch: Batch, _: int) -> Tensor:
        block = self.optimizer.block
        loss = trajectory_loss(
            self(batch).meta_relative,
            batch["truth"][:, block - 1 :: block],
            self.optimizer.correction_std,
            self.domain.loss_scale_m,
            self.domain.loss_scale_rad,
        )
        self.log("loss", loss, on_step=False, on_epoch=True, prog_bar=True, sync_dist=True)
        return loss

    def validation_step(self, batch: Batch, _: int) -> None:
        estimates = {"odometry": se2.r2g(batch["odometry"]), "corrected": self(batch).poses}
        if self.optimizer.config.smoother is not None:
            steps, _ = self.optimizer.smoother(batch["relative"], batch["log_std"], batch["motion"])
            estimates["smoothed"] = se2.r2g(steps)
        for name, poses in estimates.items():
            figures = rmse_figures(name, poses, batch["truth"])
            self.log_dict(figures, on_epoch=True, prog_bar=True, batch_size=len(poses), sync_dist=True)

    def configure_optimizers(self) -> Any:
        slow: list[nn.Parameter] = []
        fast: list[nn.Parameter] = []
        for name, parameter in self.optimizer.named_parameters():
            if not parameter.requires_grad:
                continue
            # A single number that starts from zero.
            (fast if name == "place_gain" else slow).append(parameter)
        rate = self.arguments.learning_rate
        groups: list[dict[str, Any]] = [{"params": slow}]
        if fast:
            groups.append({"params": fast, "lr": 20.0 * rate, "weight_decay": 0.0})
        optimizer = torch.optim.AdamW(groups, lr=rate, weight_decay=1e-3)
        return runs.one_cycle(optimizer, self.trainer)


class Choices(NamedTuple):
    """Arguments with a default of their own in each domain."""

    smoothing: bool
    loops_per_pose: int
    max_loops: int
    epochs: int


def choices(arguments: Arguments, domain: Domain) -> Choices:
    """The given arguments, and the domain's defaults for all others."""
    given = arguments
    return Choices(
        domain.smoothing and given.form != "paper" if given.smoothing is None else given.smoothing,
        domain.loops_per_pose if given.loops_per_pose is None else given.loops_per_pose,
        domain.max_loops if given.max_loops is None else given.max_loops,
        domain.optimizer_epochs if given.epochs is None else given.epochs,
    )


def config_of(
    arguments: Arguments,
    domain: Domain,
    scale: tuple[float, float, float],
    smoother: SmootherConfig | None = None,
) -> NeuralGraphOptimizerConfig:
    """The optimizer's configuration; ``scale`` is the typical error of the odometry over a meta-pose."""
    local, _ = load_local(arguments.weights / domain.name, domain.name)
    aggregation = PoseAggregationConfig(
        motion_feature_size=local.config.feature_size, width=arguments.width, relative_std=local.config.relative_std
    )
    changes: dict[str, Any] = {"iterations": arguments.iterations, "correction_std": scale, "smoother": smoother}
    if arguments.form == "paper":
        return NeuralGraphOptimizerConfig.paper_form(aggregation, **changes)
    place, _ = load_place(arguments.weights / domain.name, domain.name)
    chosen = choices(arguments, domain)
    search = LoopSearch(
        per_pose=chosen.loops_per_pose,
        most=chosen.max_loops,
        min_apart=domain.loops_apart,
        views=domain.loop_views,
        # Where the place codes hold ranges, every iteration also measures loops once more.
        registrations=0 if place.config.registration is None else arguments.iterations,
        overlaps=0 if place.config.registration is None or arguments.iterations <= OVERLAPS_AFTER else domain.overlaps,
    )
    return NeuralGraphOptimizerConfig(
        aggregation=aggregation,
        search=search,
        network=arguments.form == "loops",
        **changes,
    )


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    name = arguments.world or arguments.recordings.name
    folder = arguments.weights / name
    local, local_description = load_local(folder, name)
    recorded: RecordedData | None = None
    if arguments.world is None:
        recorded = open_recorded(arguments.recordings, arguments.runs, (local, local_description))
    domain = world_named(name) if recorded is None else recorded.domain
    chosen = choices(arguments, domain)
    arguments = replace(arguments, **chosen._asdict())  # a run's record says what was trained
    place, place_description = load_place(folder, domain.name)
    about: dict[str, Any] = {"place_encoder_sha256": place_description["sha256"]}
    smooths: dict[str, Any] = {}
    if recorded is not None:
        about["data"] = recorded.about
    if NO_LOOPS in place_description:
        return _without_loops(arguments, domain, about, str(place_description[NO_LOOPS]))
    if arguments.smoothing and arguments.form != "paper" and place.config.registers_odometry:
        raise records.RunError(
            f"smoothing is asked for in {domain.name}, whose odometry is registered; expected one of the two, as what "
            "smooths odometry learned from steps that are not"
        )
    features = arguments.runs / domain.name / "features"
    stores = training_stores(features, domain.optimizer_stores, domain, local_description, place_description)
    smoother: OdometrySmoother | None = None
    if arguments.smoothing:
        smoother, described = load_smoother(folder, domain.name)
        smooths["odometry_smoother_sha256"] = described["sha256"]
    began = arguments.recordings.from_weights
    optimizer = None if began is None else begun_optimizer(began, smoother, place.config.registration is not None)
    made_of = None if smoother is None else smoother.config
    config = config_of(arguments, domain, (1.0, 1.0, 1.0), made_of) if optimizer is None else optimizer.config
    search = config.search if config.loops else None
    block = PoseAggregationConfig(1).block
    train, validation = (StoredTrajectories(some, search, place.pair_head, block) for some in stores)
    run = runs.Run(
        arguments.runs / domain.name / f"optimizer-{arguments.form}-{arguments.iterations}-seed{arguments.seed}",
        "train_optimizer",
        arguments,
        chosen.epochs,
        arguments.seed,
        best=None if recorded is None else "corrected_m",
        data=None if recorded is None else recorded.sha256,
        settings={
            "loss_scale": domain.loss_scale,
            "search": dataclasses.asdict(search) if search is not None else None,
            "stores": list(domain.optimizer_stores),
            **smooths,
        },
    )
    if optimizer is None:
        fresh = NeuralGraphOptimizer(config_of(arguments, domain, correction_scale(train), made_of))
        optimizer = fresh.with_smoother(smoother)
    training = OptimizerTraining(arguments, optimizer, domain, place.config.registration)
    few = recorded is not None
    data = StretchData(train, validation, arguments.steps, arguments.batch_size, arguments.seed, few)
    run.fit(training, data)
    metrics = run.validate(training, data)
    if not run.is_first:
        return {}
    details = {**about, **smooths, "training": run.finish(metrics), "metrics": {"validation": metrics}}
    print("validation", {name: round(value, 4) for name, value in metrics.items()})
    without = min(metrics[name] for name in ("odometry_m", "smoothed_m") if name in metrics)
    if recorded is not None and metrics["corrected_m"] > (1.0 - _LEAST_GAIN) * without:
        why = (
            f"on the validation part the corrected path ({metrics['corrected_m']:.3f} m) is not {_LEAST_GAIN:.0%} "
            f"better than the odometry ({without:.3f} m): record more, with more places seen again"
        )
        return {**metrics, **_without_loops(arguments, domain, about, why)}
    path = arguments.out / domain.name / f"{OPTIMIZER}.safetensors"
    save_checkpoint(path, optimizer.cpu(), OPTIMIZER, domain.name, details)
    return metrics


def begun_optimizer(folder: Path, smoother: OdometrySmoother | None, registers: bool) -> NeuralGraphOptimizer:
    """The optimizer of the weights to begin with, but for its smoother, which knows the odometry of another network.

    Without ``registers`` place codes hold no ranges any more, and it registers nothing.
    """
    optimizer = load_optimizer(folder)[0]
    if optimizer.config.smoother is not None:
        print(f"the smoother in {folder} is left out{'' if smoother is None else ': the one trained here is taken'}")
    optimizer = optimizer.with_smoother(smoother)
    if optimizer.config.registrations and not registers:
        optimizer = optimizer.with_registrations(0)
    return optimizer


def _without_loops(arguments: Arguments, domain: Domain, about: dict[str, Any], why: str) -> dict[str, float]:
    """Write an optimizer that returns the odometry: a fresh one of the paper's form."""
    print(f"no loops will be closed{' and nothing is smoothed' if arguments.smoothing else ''}: {why}")
    aggregation = config_of(arguments, domain, (1.0, 1.0, 1.0)).aggregation
    optimizer = NeuralGraphOptimizer(NeuralGraphOptimizerConfig.paper_form(aggregation, iterations=1))
    details = {NO_LOOPS: why, **about, "training": records.record("train_optimizer", arguments), "metrics": {}}
    path = arguments.out / domain.name / f"{OPTIMIZER}.safetensors"
    save_checkpoint(path, optimizer, OPTIMIZER, domain.name, details)
    return {}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
