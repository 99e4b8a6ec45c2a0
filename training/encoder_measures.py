"""What a local network costs and what it is worth: speed of its training and inference, errors on validation mazes."""

from __future__ import annotations

import time

import numpy as np
import torch

from ngo_estimator.local_pose_network import LocalPoseNetwork
from training import train_local
from training.curves import rows
from training.streams import PairStream, action_histories, images_of, loader, simulate
from training.worlds import TRAIN_SEEDS, VALIDATION_SEEDS, World

_WARM_UP = 4  # batches: the process that simulates has started
_LATENCIES, _UNTIMED = 200, 20


def pairs_a_second(arguments: train_local.Arguments, seconds: float) -> float:
    """Frame pairs a second of a training with these arguments, simulation included, measured for some seconds."""
    world = train_local.simulated_world(arguments)
    steps = train_local.SimulatedSteps(arguments, world)
    network = train_local.initial_network(arguments, world, steps)[0]
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4)
    endless = PairStream(world, TRAIN_SEEDS, 0, 10**8, arguments.batch_size)
    batches = iter(loader(endless, arguments.workers))
    count, started = 0, time.monotonic()
    for k, batch in enumerate(batches):
        if k == _WARM_UP:
            count, started = 0, time.monotonic()
        with torch.autocast("cpu", torch.bfloat16, enabled=arguments.precision == "bf16-mixed"):
            pose, likelihood = train_local.stretch_losses(network, batch, world.error_windows)
        optimizer.zero_grad()
        (pose + likelihood).backward()
        optimizer.step()
        count += rows(batch)
        if k >= _WARM_UP and time.monotonic() > started + seconds:
            break
    return count / (time.monotonic() - started)


@torch.inference_mode()
def inference_ms(network: LocalPoseNetwork, world: World) -> float:
    """Median time, ms, in which a network estimates one step on the present number of threads."""
    (episode,) = simulate(world, [VALIDATION_SEEDS[0]], 3)
    images = images_of(world, episode)
    step = images[:1], images[1:2], action_histories(episode.actions[:1])
    took = []
    for _ in range(_UNTIMED + _LATENCIES):
        started = time.perf_counter()
        network(*step)
        took.append(time.perf_counter() - started)
    return 1e3 * float(np.median(took[_UNTIMED:]))
