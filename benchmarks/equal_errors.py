"""Errors of the online core and its peers on the same drives: is what is faster as good?

    python -m benchmarks.equal_errors
    python -m benchmarks.equal_errors --worlds maze3d --drives 4

For each validation maze: odometry, ours as the node runs it, ours with all of an update at once and the network at each
meta-pose, GTSAM's Levenberg-Marquardt and iSAM2. The last line is one JSON object.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from tqdm import tqdm

from benchmarks.core_speed import Watched, rmse_m
from benchmarks.drives import CACHE, drive_of
from benchmarks.peers import INCREMENTAL, Incremental, LevenbergMarquardt, xyyaw

FIRST_SEED = 10_000


@dataclass(frozen=True)
class Arguments:
    """What to compare."""

    worlds: tuple[Literal["maze2d", "maze3d"], ...] = ("maze2d", "maze3d")
    """Worlds to drive in."""
    drives: int = 20
    """Validation mazes, from seed 10000 on."""
    frames: int = 1000
    """Frames of a drive, a whole number of meta-poses (8 frames)."""
    out: Path = CACHE
    """Folder for drives, which are made once."""


def errors(world: str, seed: int, frames: int, cache: Path = CACHE) -> dict[str, float]:
    """Position RMSE (m) of the meta-poses of one drive, by estimator, and by how much ours differ at most (m)."""
    torch.set_num_threads(1)
    shipped, at_once = Watched(world, frames), Watched(world, frames, 0)
    drive, block = drive_of(world, seed, frames, cache), shipped.block
    peers = {name: Incremental(skip) for name, skip in INCREMENTAL.items()}
    for number, step in enumerate(drive.steps(), 1):
        shipped.core.update(step)
        at_once.core.update(step)
        if number % block == 0:
            for peer in peers.values():
                last = peer.update(*peer.prepare(at_once.problem()))
                peer.keep(last)
    shipped.core.finish()
    ours, whole = shipped.core.trajectory(), at_once.core.trajectory()
    assert ours is not None and whole is not None
    poses = {
        "odometry": drive.odometry()[block - 1 :: block],
        "ours": ours.poses_xyyaw[block::block],
        "at_once": whole.poses_xyyaw[block::block],
        "gtsam_lm": xyyaw(LevenbergMarquardt(at_once.problem()).solve())[1:],
        **{name: xyyaw(peer.estimate())[1:] for name, peer in peers.items()},
    }
    differences = np.linalg.norm((ours.poses_xyyaw - whole.poses_xyyaw)[:, :2], axis=1)
    return {
        **{name: rmse_m(nodes, drive, block) for name, nodes in poses.items()},
        "difference": float(differences.max()),
    }


def main(arguments: Arguments) -> dict[str, Any]:
    """Compare, print means and, last, everything as one line of JSON."""
    results: dict[str, Any] = {}
    for world in arguments.worlds:
        seeds = range(FIRST_SEED, FIRST_SEED + arguments.drives)
        rows = [errors(world, seed, arguments.frames, arguments.out) for seed in tqdm(seeds, world)]
        results[world] = {name: [row[name] for row in rows] for name in rows[0]}
        for name, values in results[world].items():
            print(f"{world} {name}: mean {np.mean(values):.5f} m, median {np.median(values):.5f} m")
    print(json.dumps(results))
    return results


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
