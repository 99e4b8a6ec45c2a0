"""Arguments that all trainings have in common. Without the framework, for commands that only read what was trained."""

from dataclasses import dataclass
from pathlib import Path

from training.common import records
from training.common.precision import Precision


@dataclass(frozen=True, kw_only=True)
class TrainerArguments:
    """Device, processes, machines, precision, seed and folders of a training."""

    accelerator: str = "auto"  # Kind of device by Lightning's name, such as cpu or gpu; auto: a GPU where there is one.
    devices: str = "auto"  # Processes that train together on a machine, each on own batches; auto: one, or one a GPU.
    num_nodes: int = 1  # Machines that train together, each started by torchrun, with one shared ``runs`` folder.
    strategy: str = "auto"  # How processes work together, by Lightning's name; auto: ddp if there are several.
    precision: Precision = "auto"  # Arithmetic of the networks; auto: the faster one here, which the run prints.
    seed: int = 0  # Seed of initial weights and of whatever else is drawn at random.
    out: Path = records.WEIGHTS  # Folder that gets NAME/ with the weights.
    runs: Path = records.ROOT / "runs"  # Folder of checkpoints, logs and feature stores.
