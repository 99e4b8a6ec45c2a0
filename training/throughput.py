"""Measure how fast the training data of a world is made, without any training.

    python -m training.throughput --world maze2d

The speed of a real training is in the JSON beside its weights, as ``training.datapoints_per_s``.
"""

import json
import time
from dataclasses import dataclass
from typing import Literal

import tyro
from torch.utils.data import IterableDataset
from tqdm import tqdm

from training.common.curves import batch_size, memory_mb
from training.data.batches import Batch
from training.data.streams import PairStream, PlaceStream, TrajectoryStream, loader
from training.data.worlds import TRAIN_SEEDS, world_named

_WARM_UP = 16  # batches: the processes have started, the simulator is compiled, and none lies ready


@dataclass(frozen=True)
class Arguments:
    """Settings of a measurement."""

    world: Literal["maze2d", "maze3d"]  # World to measure.
    workers: int = 1  # Processes that simulate; 0: this one.
    seconds: float = 10.0  # How long to measure each stream.


def main(arguments: Arguments) -> dict[str, float]:
    """Measure, print one line of JSON, and return what it holds: datapoints a second of each stream, and the memory.

    A datapoint is a pair of consecutive frames for the local network and for whole trajectories, and a pair of frames
    of one place for the place encoder. Mazes, drivers, rendering and the way to the training process are in it.
    """
    world = world_named(arguments.world)
    endless = 100_000
    streams: dict[str, tuple[IterableDataset[Batch], int]] = {
        "local": (PairStream(world, TRAIN_SEEDS, 0, 400 * endless, 256), 1),
        "place": (PlaceStream(world, TRAIN_SEEDS, 0, endless, 24), 1),
        "trajectories": (TrajectoryStream(world, TRAIN_SEEDS, 0, endless, 2, 512), 512),
    }
    table: dict[str, float] = {}
    memory = 0.0
    for name, (stream, datapoints_a_row) in tqdm(streams.items(), unit="stream"):
        batches = iter(loader(stream, arguments.workers))
        for _ in range(_WARM_UP):
            next(batches)
        count, started = 0, time.monotonic()
        while time.monotonic() < started + arguments.seconds:
            count += batch_size(next(batches)) * datapoints_a_row
        table[f"{name}_datapoints_per_s"] = round(count / (time.monotonic() - started), 1)
        memory = max(memory, memory_mb())
        del batches
    result = {"workers": arguments.workers, **table, "peak_memory_mb": round(memory)}
    print(json.dumps({"world": world.name, **result}))
    return result


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
