"""Arguments that all trainings have in common. Without the framework, for commands that only read what was trained."""

from dataclasses import dataclass

from training.common.precision import Precision


@dataclass(frozen=True, kw_only=True)
class TrainerArguments:
    """Device, processes, machines and precision of a training."""

    accelerator: str = "auto"
    """Kind of device by Lightning's name, such as cpu or gpu; auto: a GPU where there is one."""
    devices: str = "auto"
    """Processes that train together on a machine, each on batches of its own; auto: one, or one a GPU."""
    num_nodes: int = 1
    """Machines that train together, each started by torchrun, with one ``runs`` folder that all of them share."""
    strategy: str = "auto"
    """How processes work together, by Lightning's name, such as ddp; auto: ddp if there are several."""
    precision: Precision = "auto"
    """Arithmetic of the networks; auto: the faster one on this device, which the run prints when it begins."""
