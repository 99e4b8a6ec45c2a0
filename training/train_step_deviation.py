"""Train factors on the deviations of a lidar's steps, by likelihood where the poses are known.

    python -m training.train_step_deviation --logs belgioioso.log.gz edmonton.log.gz

Drives through simulated buildings, some without wheels, teach it; CARMEN logs that a mapper corrected may be added.
Their steps are stored under RUNS once. It ends with the weights written to OUT/scan/step_deviation.safetensors.
"""

import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.optim.lr_scheduler import OneCycleLR
from tqdm import tqdm

from ngo_estimator.frontend.lidar.lidar_odometry import LidarOdometryConfig
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.networks.step_deviation import StepDeviation
from ngo_estimator.networks.step_scaling import STEP_DEVIATION, StepDeviationConfig
from training.common import records
from training.common.command_line import run_command
from training.common.training import descend, save_weights
from training.data.lidar_steps import KeySteps, building_steps, key_steps
from training.data.step_windows import WINDOWS, StepWindows, figures, negative_log_likelihood, windows_of
from training.recordings.lidar_logs import read_drive

WORLD = "scan"
REFERENCE = (0.05, math.radians(0.25))
"""Deviations (m, rad) of a mapper's poses."""

LOG_WINDOWS = (16, 64)
"""Stretches of logs that count: over fewer steps the mapper's errors are larger than ours."""

_TRAIN_SEED, _VALIDATION_SEED = 1000, 5000
_BATCH = {1: 128, 4: 128, 16: 128, 64: 48}


@dataclass(frozen=True)
class Arguments:
    """Settings of a training of the deviations of a lidar's steps."""

    buildings: int = 10
    """Buildings to train on, and again so many with rooms that repeat; validation takes half of each number."""
    without_wheels: int = 5  # How many more of each are driven without wheels.
    length_m: float = 160.0  # Way in each building.
    logs: tuple[Path, ...] = ()  # CARMEN logs with a mapper's poses to train on, beside the buildings.
    log_share: int = 3  # How often a log's stretches count.
    steps: int = 1200  # Steps of the optimiser.
    learning_rate: float = 1e-2  # Highest learning rate.
    seed: int = 0  # Seed of initial weights and of the order of the data.
    out: Path = records.WEIGHTS  # Folder that gets scan/step_deviation.safetensors.
    runs: Path = records.ROOT / "runs"  # Folder of stored steps.


Data = dict[int, StepWindows]


def main(arguments: Arguments) -> dict[str, float]:
    """Train, write the weights, and return the validation metrics."""
    began = time.monotonic()
    half = arguments.buildings // 2, arguments.without_wheels // 2
    train = data_of(building_drives(arguments, _TRAIN_SEED, arguments.buildings, arguments.without_wheels))
    validation = data_of(building_drives(arguments, _VALIDATION_SEED, *half))
    logs = [
        _stored(arguments.runs, f"log-{path.name}-{_sha(path)}", partial(log_steps, path))
        for path in tqdm(arguments.logs, "logs")
    ]
    if logs:
        of_logs = data_of(logs, LOG_WINDOWS, REFERENCE)
        train |= {k: StepWindows.joined([train[k], *[of_logs[k]] * arguments.log_share]) for k in LOG_WINDOWS}
    network, loss = fitted(train, arguments)
    metrics = {"loss": loss}
    with torch.no_grad():
        for steps, windows in validation.items():
            for name, factors in (
                ("constant", 0.0 * network(windows.evidence)),
                ("learned", network(windows.evidence)),
            ):
                metrics |= {f"{name}_{steps}_{key}": value for key, value in figures(windows, factors).items()}
    details = {
        "training": {**records.record("train_step_deviation", arguments), "seconds": round(time.monotonic() - began)},
        "metrics": {"validation": metrics},
    }
    save_weights(arguments.out / WORLD, network, STEP_DEVIATION, details)
    print("validation", {name: round(value, 3) for name, value in metrics.items()})
    return metrics


def building_drives(arguments: Arguments, seed: int, with_wheels: int, without: int) -> list[KeySteps]:
    """Drives through normal and aliased buildings, the latter ones without wheels."""
    drives = []
    for k in tqdm(range(with_wheels + without), f"buildings from {seed}"):
        for aliased in (False, True):
            settings = (seed + k, arguments.length_m, aliased, k < with_wheels)
            name = "-".join(map(str, settings))
            drives.append(_stored(arguments.runs, f"building-{name}", partial(building_steps, *settings)))
    return drives


def log_steps(path: Path) -> KeySteps:
    """Steps along a log by the poses that a mapper wrote into it; raises ``RecordingError`` where it has none."""
    return key_steps(read_drive(path, with_relations=False))


def data_of(
    drives: Sequence[KeySteps], windows: Sequence[int] = WINDOWS, reference: tuple[float, float] = (0.0, 0.0)
) -> Data:
    """Stretches of all drives, by their number of steps."""
    graph = ScanGraphConfig()
    floor = (graph.step_m, math.radians(graph.step_deg))
    return {
        steps: StepWindows.joined([windows_of(drive, steps, floor, reference) for drive in drives]) for steps in windows
    }


def fitted(data: Data, arguments: Arguments) -> tuple[StepDeviation, float]:
    """A network that was trained on stretches, and the loss of its last tenth of steps."""
    torch.manual_seed(arguments.seed)
    random = np.random.default_rng(arguments.seed)
    network = StepDeviation(StepDeviationConfig())

    def loss_of(_: int) -> Tensor:
        loss = torch.zeros(())
        for steps, windows in data.items():
            some = windows[torch.from_numpy(random.permutation(len(windows))[: _BATCH[steps]])]
            loss = loss + negative_log_likelihood(some, network(some.evidence)).mean()
        return loss

    rate, steps = arguments.learning_rate, arguments.steps
    schedule = partial(OneCycleLR, max_lr=rate, total_steps=steps)
    losses = descend(network.parameters(), loss_of, steps, schedule, lr=rate, weight_decay=1e-3)
    return network, float(np.mean(losses[-max(1, steps // 10) :]))


def _stored(folder: Path, name: str, make: Callable[[], KeySteps]) -> KeySteps:
    """Steps of a drive, made once for each setting of the front end."""
    settings = hashlib.sha256(repr(LidarOdometryConfig()).encode()).hexdigest()[:8]
    path = folder / WORLD / f"steps-{settings}" / f"{name}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        make().save(path)
        tqdm.write(f"stored {path.name}")
    return KeySteps.load(path)


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:8]


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
