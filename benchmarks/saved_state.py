"""How long it takes to save and to load the state of a long trajectory, and how large it is.

    python -m benchmarks.saved_state

The trajectory is synthetic: random steps and place codes, or the scans of a few places over and over. It goes through
the real classes, paused, and ends with one optimisation. Loops are searched as little as settings allow: a search takes
long, and what a state keeps of loops is bounded. One thread. The last line is one JSON object; exit code 1 where one
takes 5 s or longer to load.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.pinned import in_process, two_cores
from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.data.relative_step import KeyScanStep, RelativeStep
from ngo_estimator.geometry.key_scan import KeyScan
from ngo_estimator.geometry.planar_motion import compose
from ngo_estimator.loops.scan_settings import ScanGraphConfig
from ngo_estimator.slam.corrected_trajectory import CorrectedTrajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_estimator.slam.saved_state import read_state, write_state
from ngo_estimator.slam.scan_trajectory import ScanTrajectory
from training.common.records import WEIGHTS

MOST_LOAD_S = 5.0

Result = TypeVar("Result")
_STEP = np.array([0.1, 0.0, 0.05])
_COVARIANCE = np.diag((1e-4, 1e-4, 1e-6))
_PERIOD_NS = 100_000_000
_STEPS_PER_KEY = 5
_RAYS, _POINTS = 360, 250


@dataclass(frozen=True)
class Arguments:
    """What to save."""

    worlds: tuple[str, ...] = ("maze2d", "maze3d", "scan")
    """Weights of these worlds."""
    frames: int = 100_000
    """Frames of the trajectory."""


def steps(count: int, motion: int, code: int, keys: bool) -> Iterator[RelativeStep]:
    """Steps round a circle that drifts, with random features, or with a key scan at every fifth frame."""
    generator, odom, last_key = np.random.default_rng(0), np.zeros(3), 0
    scans = [_scan(generator) for _ in range(16)]
    for k in range(1, count + 1):
        relative = _STEP + generator.normal(scale=0.01, size=3)
        odom, key = compose(odom, relative), None
        if keys and k % _STEPS_PER_KEY == 0:
            scan = replace(scans[k % len(scans)], stamp_ns=k * _PERIOD_NS)
            key = KeyScanStep(scan, last_key * _PERIOD_NS, relative, _COVARIANCE)
            last_key = k
        yield RelativeStep(
            stamp_ns=k * _PERIOD_NS,
            from_stamp_ns=(k - 1) * _PERIOD_NS,
            relative_xyyaw=relative,
            covariance=_COVARIANCE,
            origin_stamp_ns=0,
            odom_xyyaw=odom,
            motion_feature=generator.random(motion, np.float32),
            place_code=0.5 + generator.random(code, np.float32),
            key=key,
        )


def _scan(generator: np.random.Generator) -> KeyScan:
    angles = np.linspace(-math.pi, math.pi, _RAYS, endpoint=False)
    ranges = generator.uniform(2.0, 6.0, _RAYS)
    points = (ranges[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1))[:_POINTS]
    normals = -points / np.linalg.norm(points, axis=1, keepdims=True)
    return KeyScan(0, points, normals, np.zeros(3), angles, ranges, 10.0)


def trajectory(world: str, frames: int) -> CorrectedTrajectory:
    """A trajectory of so many frames, with the weights or the settings of a world."""
    if world == "scan":
        config = ScanGraphConfig()
        scans = ScanTrajectory(replace(config, loops=replace(config.loops, every=1000, most_per_key=0)))
        for step in tqdm(steps(frames, 0, 0, keys=True), desc=world, total=frames, unit="step"):
            scans.update(step, optimize=False)
        return scans
    optimizer, head = load_optimizer(WEIGHTS / world)[0], load_place(WEIGHTS / world)[0].pair_head
    search = replace(optimizer.config.search, per_pose=1, views=1, registrations=0, overlaps=0)
    optimizer.config = replace(optimizer.config, search=search)
    core, code = OnlineTrajectory(optimizer, head), head.config.code_length
    motion = optimizer.config.aggregation.motion_feature_size
    driven = tqdm(steps(frames, motion, code, keys=False), desc=world, total=frames, unit="step")
    for k, step in enumerate(driven, start=1):
        core.update(step, optimize=k == frames)
    return core


def measure(arguments: Arguments, world: str) -> dict[str, float]:
    """Times of saving and loading, and the size."""
    torch.set_num_threads(1)
    core = trajectory(world, arguments.frames)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "state")
        arrays, snapshot_s = _timed(core.state)
        _, write_s = _timed(lambda: write_state(path, core.identity, arrays))
        size = sum(file.stat().st_size for file in path.iterdir())
        loaded, load_s = _timed(lambda: core.restored(read_state(path, core.identity)))
    again = loaded.state()
    if any(not np.array_equal(again[name], array) for name, array in arrays.items()):
        raise AssertionError("what was loaded is not what was saved")
    return {
        "frames": loaded.newest().frames,
        "mb": size / 2**20,
        "snapshot_s": snapshot_s,
        "write_s": write_s,
        "load_s": load_s,
    }


def _timed(work: Callable[[], Result]) -> tuple[Result, float]:
    begin = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begin


def main(arguments: Arguments) -> int:
    """Measure each world on one core, print everything as one line of JSON; return the exit code."""
    found = {}
    for world in arguments.worlds:
        found[world] = in_process(two_cores()[0], measure, arguments, world)
        print(f"{world}: " + ", ".join(f"{name} {value:.4g}" for name, value in found[world].items()), flush=True)
    print(json.dumps(found))
    return 0 if all(one["load_s"] < MOST_LOAD_S for one in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, description=__doc__)))
