"""The faster arithmetic for the device of a run: bfloat16 where it pays, float32 otherwise."""

import time
from typing import Literal

import torch
from torch import nn

Precision = Literal["auto", "bf16-mixed", "32-true"]
Resolved = Literal["bf16-mixed", "32-true"]

GAIN = 1.25  # How many times faster bfloat16 has to be: it also rounds.
_ROUNDS = 3


def resolved(accelerator: str, devices: str, num_nodes: int) -> tuple[Resolved, str]:
    """The better precision for a device by Lightning's name, and why, in words.

    A GPU says what it can. A CPU is measured: many have instructions for bfloat16 and still lose time on conversions.
    Processes that train together on CPUs get float32, as their measurements could differ.
    """
    if accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available():
        if torch.cuda.is_bf16_supported(including_emulation=False):
            return "bf16-mixed", "the GPU calculates in bfloat16"
        return "32-true", "the GPU has no bfloat16"
    if accelerator not in ("auto", "cpu"):
        return "32-true", f"bfloat16 is not tried on {accelerator}"
    if num_nodes > 1 or devices not in ("auto", "1"):
        return "32-true", "several processes train on CPUs"
    gain = cpu_gain()
    why = f"on this CPU bfloat16 has {gain:.2f} times the speed of float32"
    return ("bf16-mixed" if gain >= GAIN else "32-true"), why


def cpu_gain() -> float:
    """Speed of a training step in bfloat16 by that in float32, of convolutions as of our encoders, in this process."""
    with torch.random.fork_rng(devices=[]):
        first, second, third = nn.Conv2d(6, 16, 7, 2, 3), nn.Conv2d(16, 32, 5, 2, 2), nn.Conv2d(32, 64, 5, 2, 2)
        network, pictures = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), third), torch.rand(16, 6, 60, 80)

    def step_s(bfloat16: bool) -> float:
        started_s = time.perf_counter()
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            loss = network(pictures).float().square().mean()
        loss.backward()
        return time.perf_counter() - started_s

    step_s(True), step_s(False)  # the first ones choose and compile their kernels
    times = [(step_s(True), step_s(False)) for _ in range(_ROUNDS)]
    return min(float32 for _, float32 in times) / min(bfloat16 for bfloat16, _ in times)
