"""Long drives in one maze, turned once into what the online core takes, in memory-mapped files."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from ngo_estimator.checkpoint import load_local, load_place
from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.geometry import se2
from ngo_sim.driver_choice import driver_generator, make_driver
from ngo_sim.episodes import Episode
from training.common.records import ROOT, WEIGHTS
from training.data.batches import seen_from_first
from training.data.features import features_of
from training.data.worlds import MazeSize, world_named

SIZES = {"maze2d": MazeSize(7, 8), "maze3d": MazeSize()}  # The mazes that are driven through.

PERIOD_NS = 28_571_429  # Time between two stamps: 35 Hz.

CACHE = ROOT / "runs" / "benchmarks"
_CHUNK = 1000
_NAMES = ("relative", "log_std", "motion", "codes", "origin_code", "truth")


@dataclass(frozen=True)
class Drive:
    """A drive of ``n`` steps, as ``training.featurise`` has them: arrays ``(n, ...)`` that may lie in files.

    ``relative`` and ``log_std`` ``(n, 3)`` (m, m, rad), ``motion`` and ``codes``, the code ``(1, code_length)`` of the
    first frame, and the true poses ``(n, 3)`` after each step, seen from it.
    """

    relative: np.ndarray
    log_std: np.ndarray
    motion: np.ndarray
    codes: np.ndarray
    origin_code: np.ndarray
    truth: np.ndarray

    def __len__(self) -> int:
        return len(self.relative)

    def odometry(self) -> np.ndarray:
        """Poses ``(n, 3)`` after each step by odometry, yaw within half a turn."""
        poses = se2.r2g(torch.from_numpy(np.asarray(self.relative, dtype=np.float64)))
        poses[:, 2] = se2.wrap(poses[:, 2])
        return poses.numpy()

    def steps(self) -> Iterator[RelativeStep]:
        """What the core takes, step by step."""
        for index, odom in enumerate(self.odometry()):
            yield RelativeStep(
                stamp_ns=stamp_ns(index + 1),
                from_stamp_ns=stamp_ns(index),
                relative_xyyaw=self.relative[index].astype(np.float64),
                covariance=np.diag(np.exp(2.0 * self.log_std[index].astype(np.float64))),
                origin_stamp_ns=stamp_ns(0),
                odom_xyyaw=odom,
                motion_feature=self.motion[index].astype(np.float32),
                place_code=self.codes[index].astype(np.float32),
                from_place_code=None if index else self.origin_code[0].astype(np.float32),
            )


def stamp_ns(frame: int) -> int:
    """The stamp of a frame; frame 0 is the first."""
    return 1_000_000_000 + frame * PERIOD_NS


def episodes(world_name: str, seed: int, steps: int, chunk: int = _CHUNK) -> Iterator[Episode]:
    """One drive of ``steps`` steps, in parts that follow each other: the last frame of one is the first of the next."""
    world = world_named(world_name)
    size = SIZES[world_name]
    env: Any = world.make(size.rows, size.extra_openings)
    try:
        observation, info = env.reset(seed=seed)
        maze = env.unwrapped.maze
        driver = make_driver(world.driver, maze, driver_generator(seed))
        for first in range(0, steps, chunk):
            count = min(chunk, steps - first)
            # Images are copied at once: an environment may hand out its own buffer.
            images, poses, actions = [np.array(observation)], [info["pose_xyyaw"]], []
            for _ in range(count):
                actions.append(int(driver.action(info["pose_xyyaw"], observation)))
                observation, _, _, _, info = env.step(actions[-1])
                images.append(np.array(observation))
                poses.append(info["pose_xyyaw"])
            yield Episode(np.stack(images), np.array(actions, np.uint8), np.array(poses), env.unwrapped.period_s, maze)
    finally:
        env.close()


def drive_of(world_name: str, seed: int, steps: int, cache: Path = CACHE) -> Drive:
    """A drive of ``steps`` steps in the maze of ``seed``; made at most once for each pair of networks."""
    world, weights = world_named(world_name), WEIGHTS / world_name
    (local, local_description), (place, place_description) = load_local(weights), load_place(weights)
    made_with = [
        description[key] for description in (local_description, place_description) for key in ("sha256", "config")
    ]
    networks = hashlib.sha256(json.dumps(made_with).encode()).hexdigest()[:8]
    folder = cache / f"{world_name}_{seed}_{steps}_{networks}"
    if not folder.exists():
        cache.mkdir(parents=True, exist_ok=True)
        # Under its name only once it is whole.
        unfinished = Path(tempfile.mkdtemp(prefix="unfinished_", dir=cache))
        arrays: dict[str, np.ndarray] = {}
        done, first_pose = 0, np.zeros(0)
        bar = tqdm(total=steps, desc=f"{world_name} drive")
        for episode in episodes(world_name, seed, steps):
            parts = features_of(world, episode, weights, (local, place))
            first_pose = first_pose if done else episode.poses_xyyaw[:1]
            parts["truth"] = seen_from_first(np.concatenate((first_pose, episode.poses_xyyaw[1:])))[1:]
            origin_code = parts.pop("origin_code")
            if not done:
                np.save(unfinished / "origin_code.npy", origin_code)
            for name, part in parts.items():
                if not done:
                    shape = (steps, *part.shape[1:])
                    arrays[name] = np.lib.format.open_memmap(unfinished / f"{name}.npy", "w+", part.dtype, shape)
                arrays[name][done : done + len(part)] = part
            done += len(parts["relative"])
            bar.update(len(parts["relative"]))
        bar.close()
        for array in arrays.values():
            assert isinstance(array, np.memmap)
            array.flush()
        os.rename(unfinished, folder)
    return Drive(**{name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in _NAMES})
