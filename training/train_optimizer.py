"""Train the pose aggregation and the Neural Graph Optimizer on whole trajectories of the feature store.

    python -m training.train_optimizer --world maze2d
    python -m training.train_optimizer --data drive_1.mcap drive_2.mcap --name my_robot

The weights go into the package of the estimator. Training on recordings checks the optimizer on the validation part: if
it does not correct these trajectories, an optimizer that closes no loops is written instead. Run it again to continue
after a stop.
"""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn.functional import huber_loss

from ngo_estimator.checkpoint import OPTIMIZER, load_local, load_optimizer, load_place, load_smoother
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig
from ngo_estimator.ngo.loop_closing import OVERLAPS_AFTER
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer, NeuralGraphOptimizerConfig
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from training.common import records, runs
from training.common.command_line import run_command
from training.common.precision import Precision
from training.common.training import Figures, Training, save_weights
from training.data.batches import Batch
from training.data.data_source import Domain
from training.data.feature_store import training_stores
from training.data.trajectories import StoredTrajectories, correction_scale, loops_of, rmse_figures, stretch_data
from training.recordings.recording_source import NO_LOOPS, SourceArguments, open_source

HEADING_WEIGHT = 0.3
RELATIVE_WEIGHT = 0.05
_LEAST_GAIN = 0.1
"""Of loops on the validation part of recordings, which is small: less may be chance, and do harm on a longer way."""


@dataclass(frozen=True)
class Arguments(SourceArguments):
    """Settings of a training of the optimizer."""

    form: Literal["loops", "gauss_newton", "paper"] = "loops"
    """loops: attention, convolution and loop closures. gauss_newton: loop closures alone. paper: no loop closures."""
    iterations: int = 5  # Attend-optimise iterations.
    smoothing: bool | None = None
    """Whether the smoother of ``train_smoother`` smooths the odometry before loops are closed; none: the world's
    default, and no smoothing for recordings."""
    width: int = 64  # Channels of aggregation and optimizer.
    loops_per_pose: int | None = None  # Loop candidates of a meta-pose; none: the world's default.
    max_loops: int | None = None  # Loop candidates of a trajectory; none: the world's default.
    epochs: int | None = None  # Epochs, over which the learning rate falls to zero; none: the world's default.
    steps: int = 40  # Steps of the optimiser in an epoch; of recordings at most one for each stretch.
    batch_size: int = 8  # Trajectories in a step.
    learning_rate: float = 1e-3  # Highest learning rate.
    precision: Precision = field(default="32-true", kw_only=True)  # Of the network; loops are closed in float64.
    weights: Path = records.WEIGHTS  # Folder with NAME's other networks.


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


class OptimizerTraining(Training):
    """``trajectory_loss`` on stretches of trajectories; on the validation split, errors of whole ones."""

    weight_decay = 1e-3

    def __init__(
        self,
        arguments: Arguments,
        optimizer: NeuralGraphOptimizer,
        domain: Domain,
        registration: RegistrationConfig | None = None,
    ) -> None:
        super().__init__(arguments)
        self.optimizer, self.domain, self.registration = optimizer, domain, registration
        if optimizer.config.smoother is not None:
            optimizer.smoother.requires_grad_(False)  # it has learned what it can, at a rate of its own

    def forward(self, batch: Batch) -> Any:
        loops = loops_of(batch, self.registration)
        return self.optimizer(batch["relative"], batch["log_std"], batch["motion"], loops)

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        optimizer, scales = self.optimizer, (self.domain.loss_scale_m, self.domain.loss_scale_rad)
        truth = batch["truth"][:, optimizer.block - 1 :: optimizer.block]
        loss = trajectory_loss(self(batch).meta_relative, truth, optimizer.correction_std, *scales)
        return loss, {"loss": loss}

    def figures(self, batch: Batch) -> Figures:
        estimates = {"odometry": se2.r2g(batch["odometry"]), "corrected": self(batch).poses}
        if self.optimizer.config.smoother is not None:
            steps, _ = self.optimizer.smoother(batch["relative"], batch["log_std"], batch["motion"])
            estimates["smoothed"] = se2.r2g(steps)
        figures = [rmse_figures(name, poses, batch["truth"]) for name, poses in estimates.items()]
        return {name: value for of_one in figures for name, value in of_one.items()}

    def parameter_groups(self) -> list[dict[str, Any]]:
        rate = self.arguments.learning_rate
        learning = {name: p for name, p in self.optimizer.named_parameters() if p.requires_grad}
        fast = [learning.pop("place_gain")] if "place_gain" in learning else []  # a single number, from zero
        groups: list[dict[str, Any]] = [{"params": list(learning.values()), "lr": rate}]
        return [*groups, {"params": fast, "lr": 20.0 * rate, "weight_decay": 0.0}] if fast else groups


def with_choices(arguments: Arguments, domain: Domain) -> Arguments:
    """The given arguments, and the domain's defaults for all others."""
    defaults: dict[str, Any] = {
        "smoothing": domain.smoothing and arguments.form != "paper",
        "loops_per_pose": domain.loops_per_pose,
        "max_loops": domain.max_loops,
        "epochs": domain.optimizer_epochs,
    }
    missing = {name: value for name, value in defaults.items() if getattr(arguments, name) is None}
    return dataclasses.replace(arguments, **missing)


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
    chosen: Any = with_choices(arguments, domain)
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
        aggregation=aggregation, search=search, network=arguments.form == "loops", **changes
    )


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so)."""
    name, folder = arguments.name, arguments.weights / arguments.name
    local, of_local = load_local(folder, name)
    source = open_source(arguments, (local, of_local))
    domain = source.domain
    arguments = with_choices(arguments, domain)  # a run's record says what was trained
    place, of_place = load_place(folder, name)
    about = {"place_encoder_sha256": of_place["sha256"], **source.about}
    if NO_LOOPS in of_place:
        return _without_loops(arguments, domain, about, str(of_place[NO_LOOPS]))
    if arguments.smoothing and arguments.form != "paper" and place.config.registers_odometry:
        raise records.RunError(
            f"smoothing is asked for in {name}, whose odometry is registered; expected one of the two, as what "
            "smooths odometry learned from steps that are not"
        )
    features = arguments.runs / name / "features"
    stores = training_stores(features, domain.optimizer_stores, domain, of_local, of_place)
    smoother, smooths = None, {}
    if arguments.smoothing:
        smoother, of_smoother = load_smoother(folder, name)
        smooths = {"odometry_smoother_sha256": of_smoother["sha256"]}
    began = arguments.recordings.from_weights
    optimizer = None if began is None else begun_optimizer(began, smoother, place.config.registration is not None)
    made_of = None if smoother is None else smoother.config
    config = config_of(arguments, domain, (1.0, 1.0, 1.0), made_of) if optimizer is None else optimizer.config
    search = config.search if config.loops else None
    block = PoseAggregationConfig(1).block
    train, validation = (StoredTrajectories(some, search, place.pair_head, block) for some in stores)
    assert arguments.epochs is not None
    run = runs.Run(
        arguments.runs / name / f"optimizer-{arguments.form}-{arguments.iterations}-seed{arguments.seed}",
        "train_optimizer",
        arguments,
        arguments.epochs,
        best="corrected_m",
        data=source.sha256,
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
    few = source.recorded is not None
    data = stretch_data(train, validation, arguments.steps, arguments.batch_size, arguments.seed, few)
    run.fit(training, data)
    metrics = run.validate(training, data)
    if not run.is_first:
        return {}
    details = {**about, **smooths, **run.ended(metrics)}
    without = min(metrics[of] for of in ("odometry_m", "smoothed_m") if of in metrics)
    if few and metrics["corrected_m"] > (1.0 - _LEAST_GAIN) * without:
        why = (
            f"on the validation part the corrected path ({metrics['corrected_m']:.3f} m) is not {_LEAST_GAIN:.0%} "
            f"better than the odometry ({without:.3f} m): record more, with more places seen again"
        )
        return {**metrics, **_without_loops(arguments, domain, about, why)}
    save_weights(arguments.out / name, optimizer.cpu(), OPTIMIZER, details)
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
    save_weights(arguments.out / domain.name, optimizer, OPTIMIZER, details)
    return {}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
