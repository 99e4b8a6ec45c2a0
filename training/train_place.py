"""Train the place encoder and its pair head on pairs of frames of one place, well apart in time.

    python -m training.train_place --world maze2d
    python -m training.train_place --data drive_1.mcap drive_2.mcap --name my_robot

The weights go into the package of the estimator. Recordings in which the robot returns to too few places teach nothing
about places: the command says so, writes an untrained encoder, and the optimizer closes no loops. Run it again to
continue after a stop.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy
from torch.utils.data import IterableDataset

from ngo_estimator.checkpoint import PLACE, PlaceNetworks, load_place
from ngo_estimator.geometry import se2
from ngo_estimator.networks.place_encoder import PlaceConfig
from training.common import records, runs
from training.common.command_line import run_command
from training.common.training import Figures, Training, save_weights
from training.data.batches import Batch, Share
from training.data.data_module import StreamedData
from training.data.data_source import Domain
from training.data.streams import PlaceStream
from training.data.worlds import TRAIN_SEEDS, VALIDATION_SEEDS, World
from training.recordings.recording_source import NO_LOOPS, SourceArguments, open_source, trained_local
from training.recordings.recording_streams import RecordedPlaces


@dataclass(frozen=True)
class Arguments(SourceArguments):
    """Settings of a training of the place encoder."""

    width: float = 0.19  # Channels of the convolutions, as a fraction of FlowNetS's.
    epochs: int = 10  # Passes of new data.
    batches: int = 256  # Batches in an epoch, of all processes; of recordings with few places less.
    pairs_a_maze: int = 24  # Pairs of frames from each of the 8 mazes of a batch; 8 times as many from one recording.
    learning_rate: float = 1.5e-3  # Highest learning rate of the one-cycle schedule.
    validation_batches: int = 16  # Batches of the validation split that each epoch is measured on.
    workers: int = 1  # Processes that simulate for each one that trains.


class PlaceTraining(Training):
    """Symmetric InfoNCE between the two frames of each place, and the pair head's likelihood and same-place loss.

    Frames of a maze that lie near each other without being a pair count neither for nor against. Where codes hold
    ranges that are seen in pictures, their likelihood counts as well.
    """

    BRIGHTNESS = 0.15
    weight_decay = 1e-3

    def __init__(self, arguments: Arguments, domain: Domain, networks: PlaceNetworks) -> None:
        super().__init__(arguments)
        self.domain, self.networks, self.seed = domain, networks, arguments.seed
        self.log_temperature = nn.Parameter(torch.tensor(2.5))

    def forward(self, batch: Batch, augment: bool) -> dict[str, Tensor]:
        """Losses and retrieval figures of a batch."""
        images = torch.cat((batch["a"], batch["b"]))
        if augment and images.dtype == torch.uint8:
            gain = 1.0 + self.BRIGHTNESS * (2.0 * torch.rand(len(images), 1, 1, 1, device=images.device) - 1.0)
            images = (images * gain).clamp(0, 255).to(torch.uint8)
        codes, seen = self.networks.encoder.see(images)
        code_a, code_b = codes.chunk(2)
        embedding_a, embedding_b = self.networks.pair_head.embed(codes).float().chunk(2)
        similarity = embedding_a @ embedding_b.mT
        pose_a, pose_b = batch["poses"].unbind(1)
        ambiguous = (
            (batch["maze"][:, None] == batch["maze"])
            & (torch.cdist(pose_a[:, :2], pose_b[:, :2]) < 2.0 * self.domain.place_radius_m)
            & ~torch.eye(len(pose_a), dtype=torch.bool, device=pose_a.device)
        )
        logits = (similarity * self.log_temperature.clamp(max=4.0).exp()).masked_fill(ambiguous, -1e4)
        target = torch.arange(len(pose_a), device=pose_a.device)
        contrast = 0.5 * (cross_entropy(logits, target) + cross_entropy(logits.mT, target))

        truth = se2.between(pose_a, pose_b)
        measured, log_scale, same = self.networks.pair_head(code_a, code_b)
        position_error = (measured[:, :2] - truth[:, :2]).norm(dim=1)
        heading_error = se2.wrap(measured[:, 2] - truth[:, 2]).abs()
        regression = (
            position_error * torch.exp(-log_scale[:, 0]) + 2.0 * log_scale[:, 0]
            + heading_error * torch.exp(-log_scale[:, 1]) + log_scale[:, 1]
        ).mean()  # fmt: skip
        # The hardest wrong partners, which retrieval will offer, are what the same-place belief has to tell apart.
        wrong = similarity.detach().masked_fill(ambiguous, -2.0).fill_diagonal_(-2.0).topk(2, dim=1).indices.T.flatten()
        _, _, other = self.networks.pair_head(code_a.repeat(2, 1), code_b[wrong])
        belief = binary_cross_entropy_with_logits(same, torch.ones_like(same)) + binary_cross_entropy_with_logits(
            other, torch.zeros_like(other)
        )
        figures = {"loss": contrast + regression + 0.5 * belief}
        if seen is not None:
            truth_log = batch["ranges"].transpose(0, 1).flatten(0, 1).log()
            error = (seen.log_range - truth_log).abs()
            figures["loss"] = figures["loss"] + (error * torch.exp(-seen.log_scale) + seen.log_scale).mean()
            figures["median_range_percent"] = 100.0 * error.median()
        return {
            **figures,
            "contrast": contrast,
            "precision_at_1": (logits.argmax(1) == target).float().mean(),
            "median_m": position_error.median(),
            "median_deg": heading_error.median().rad2deg(),
            "same_recall": (same > 0).float().mean(),
            "other_rejected": (other < 0).float().mean(),
        }

    def on_train_epoch_start(self) -> None:
        # The brightness of the pictures is random: a resumed training must draw what an unbroken one would have drawn.
        torch.manual_seed((self.seed * 1_000_003 + self.current_epoch) * 1_009 + self.global_rank)

    def losses(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        figures = self(batch, augment=True)
        return figures["loss"], figures

    def figures(self, batch: Batch) -> Figures:
        return {f"validation_{name}": value for name, value in self(batch, augment=False).items()}


class SimulatedPlaces:
    """Pairs from the mazes of a world, in the form of ``RecordedPlaces``."""

    def __init__(self, arguments: Arguments, world: World) -> None:
        self.arguments, self.world = arguments, world

    def pairs(self, epoch: int, share: Share) -> IterableDataset[Batch]:
        # A stream of its own: the local network's mazes come from the front of the range.
        seeds = TRAIN_SEEDS[len(TRAIN_SEEDS) // 2 :]
        return PlaceStream(self.world, seeds, epoch, self.arguments.batches, self.arguments.pairs_a_maze, share)

    def validation(self) -> list[Batch]:
        a = self.arguments
        return list(PlaceStream(self.world, VALIDATION_SEEDS, 0, a.validation_batches, a.pairs_a_maze))


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics (in the first process, which does so).

    There are none where recordings hold too few places.
    """
    source = open_source(arguments, None if arguments.world else trained_local(arguments.out, arguments.name))
    domain, out = source.domain, arguments.out / arguments.name
    settings: dict[str, Any] | None = None
    places: SimulatedPlaces | RecordedPlaces
    if isinstance(domain, World):
        places, settings = SimulatedPlaces(arguments, domain), settings_of(domain)
    elif source.recorded is not None:
        a = arguments
        places = RecordedPlaces(source.recorded, a.batches, 8 * a.pairs_a_maze, a.validation_batches)
        if places.too_few is not None:
            # The encoder as it was, which the estimator needs to run, and which tells the optimizer to close no loops.
            print(f"places are not learned: {places.too_few}")
            networks, begun = initial_networks(arguments, domain)
            entries = {"training": {**records.record("train_place", arguments), **begun}, "metrics": {}}
            save_weights(out, networks, PLACE, {NO_LOOPS: places.too_few, **entries, **source.about})
            return {}
    run = runs.Run(
        arguments.runs / domain.name / "place",
        "train_place",
        arguments,
        arguments.epochs,
        best="validation_loss",
        data=source.sha256,
        settings=settings,
    )
    networks, begun = initial_networks(arguments, domain)
    training = PlaceTraining(arguments, domain, networks)
    data = StreamedData(places.pairs, places.validation, arguments.workers)
    run.fit(training, data)
    if not run.is_first:
        return {}
    training.cpu().eval()
    with torch.no_grad():
        figures = [training(batch, augment=False) for batch in data.validation]
    metrics = {name: float(torch.stack([f[name] for f in figures]).mean()) for name in figures[0]} if figures else {}
    save_weights(out, networks, PLACE, {**run.ended(metrics, begun), **source.about})
    return metrics


def settings_of(world: World) -> dict[str, Any]:
    """Settings of the world that a training depends on, for its record."""
    settings = world.stream_settings
    if world.sees_ranges and world.registration is not None:
        settings["registration"] = dataclasses.asdict(world.registration)
    return settings


def initial_networks(arguments: Arguments, domain: Domain) -> tuple[PlaceNetworks, dict[str, str]]:
    """Fresh networks, or those of the weights to begin with, and what is to be said of them in the JSON.

    Ranges that the weights see in pictures are left out where there are none to learn from. Raises ``RunError`` where a
    world is registered in another way than the weights.
    """
    if arguments.recordings.from_weights is None:
        config = PlaceConfig(
            image=domain.image,
            width=arguments.width,
            offset_scale_m=domain.place_radius_m,
            registration=domain.registration,
        )
        return PlaceNetworks(config), {}
    networks, description = load_place(arguments.recordings.from_weights)
    if networks.config.sees_ranges and domain.registration is None:
        print(f"ranges that {arguments.recordings.from_weights} sees in pictures are left out: recordings hold none")
        networks = networks.without_ranges()
    if (networks.config.sees_ranges or domain.sees_ranges) and networks.config.registration != domain.registration:
        raise records.RunError(
            f"{arguments.recordings.from_weights} has the registration {networks.config.registration}; expected "
            f"{domain.registration}, that of {domain.name}"
        )
    return networks.requires_grad_(True).train(), {"began_with_sha256": description["sha256"]}


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
