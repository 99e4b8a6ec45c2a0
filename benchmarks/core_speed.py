"""The online core and its peers, step by step in one process: what an update costs, and what it consists of."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.drives import CACHE, Drive, drive_of, episodes, stamp_ns
from benchmarks.peers import INCREMENTAL, SETTINGS, Incremental, LevenbergMarquardt, Problem
from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.frontend.camera.local_odometry import LocalOdometry
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.ngo.meta_poses import MetaSteps
from ngo_estimator.nodes.path_message import PathWriter
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.baselines.graph_peers import xyyaw
from training.common.records import WEIGHTS
from training.data.episodes import images_of
from training.data.worlds import world_named
from training.scoring.metrics import position_rmse_m

Result = TypeVar("Result")


@dataclass
class Times:
    """Durations of one kind of work in ms, by the clock and of processor time."""

    wall_ms: list[float] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def take(self, action: Callable[..., Result], *arguments: Any) -> Result:
        """Call it, and remember how long that took."""
        cpu, wall = time.process_time(), time.perf_counter()
        result = action(*arguments)
        self.wall_ms.append(1e3 * (time.perf_counter() - wall))
        self.cpu_ms.append(1e3 * (time.process_time() - cpu))
        return result

    def mean(self, last: int) -> dict[str, float]:
        """Of the last of both: the network runs for each 32nd meta-pose, which a median would not see."""
        return {"ms": float(np.mean(self.wall_ms[-last:])), "cpu_ms": float(np.mean(self.cpu_ms[-last:]))}


class Watched:
    """An online core as the node runs it, of which the last problem, and how long each optimisation took, are known.

    An optimisation is its preparation, its iterations and what takes over the result; candidates, registrations and
    features come before it.
    """

    def __init__(self, world_name: str, window: int) -> None:
        weights = WEIGHTS / world_name
        optimizer, _ = load_optimizer(weights, world_name)
        pair_head = load_place(weights, world_name)[0].pair_head
        self.core = OnlineTrajectory(optimizer, pair_head, window, iterations_per_step=1)
        self.block = self.core.block
        self.optimisations = Times()
        self._given: tuple[MetaSteps, Loops] | None = None
        graph = self.core._back_end
        optimise, finder = graph._optimise, graph._finder
        assert finder is not None, "expected an optimizer with loops"

        def remembered() -> None:
            loops = finder.loops[finder.chosen()]
            self._given = graph._meta_steps(), finder.for_optimizer(loops, np.ones(len(loops), bool))
            self.optimisations.take(optimise)

        vars(graph)["_optimise"] = remembered

    def problem(self) -> Problem:
        """What the optimizer was given last."""
        assert self._given is not None, "nothing was optimised yet"
        return Problem.of(*self._given)


def core_speed(world_name: str, seed: int, window: int, live: int, repeats: int, cache: Path = CACHE) -> dict[str, Any]:
    """Drive ``window + live`` steps; compare with the peers at the last ``repeats`` meta-poses of the full window.

    ``core_ms`` lists, for each of the ``live`` steps, what the answer of the core and the path take in this process,
    ``correction_ms`` what the core does after it.
    """
    torch.set_num_threads(1)
    watched = Watched(world_name, window)
    block, core = watched.block, watched.core
    # The last meta-pose of the window is optimised before the next frame.
    drive = drive_of(world_name, seed, window + live + block, cache)
    lm, believed, steps, paths, corrections = Times(), Times(), Times(), Times(), Times()
    incremental = {name: Incremental(skip) for name, skip in INCREMENTAL.items()}
    isam = {name: Times() for name in INCREMENTAL}
    writer = PathWriter("map")
    result: dict[str, Any] = {}

    def path() -> bytes:
        trajectory = core.trajectory()
        assert trajectory is not None
        return writer.write(int(trajectory.stamps_ns[-1]), trajectory.stamps_ns, trajectory.poses_xyyaw)

    updates = Times()
    for number, step in enumerate(tqdm(drive.steps(), f"{world_name} core", len(drive)), 1):
        if number == window + block:
            path()  # the node has published paths all the way: its compiled functions are loaded
        if number > window + block:
            steps.take(core.update, step)
            paths.take(path)
            corrections.take(core.correct)
            continue
        optimized = updates.take(core.update, step).optimized
        if number == window + block:
            core.correct()  # as the node does from here on
        if not optimized or number > window + block - 1:
            continue
        problem = watched.problem()
        blocks = len(problem.relative)
        estimates = {}
        for name, peer in incremental.items():
            estimates[name] = isam[name].take(peer.update, *peer.prepare(problem))
            peer.keep(estimates[name])
        if blocks > window // block - repeats:
            batch = lm.take(LevenbergMarquardt(problem).solve)
            likely = problem.where(problem.logit >= SETTINGS.min_logit)
            believed.take(LevenbergMarquardt(likely).solve)
        if blocks == window // block:
            ours = core.trajectory()
            assert ours is not None
            result["rmse_m"] = {
                "odometry": rmse_m(drive.odometry()[block - 1 : window : block], drive, block),
                "ours": rmse_m(ours.poses_xyyaw[block : window + 1 : block], drive, block),
                "gtsam_lm": rmse_m(xyyaw(batch)[1:], drive, block),
                **{name: rmse_m(xyyaw(estimate)[1:], drive, block) for name, estimate in estimates.items()},
            }
            result["loops"] = len(problem.nodes)
            result |= {"optimize": watched.optimisations.mean(repeats)}
            # All of the steps that the last meta-poses took, the one for the next excepted.
            each = updates.mean(repeats * block)
            result["update"] = {name: block * value for name, value in each.items()}
    result |= {name: times.mean(repeats) for name, times in isam.items()}
    result |= {"gtsam_lm": lm.mean(repeats), "gtsam_lm_believed": believed.mean(repeats)}
    result["core_ms"] = (np.array(steps.wall_ms) + np.array(paths.wall_ms)).tolist()
    result["core_cpu_ms"] = (np.array(steps.cpu_ms) + np.array(paths.cpu_ms)).tolist()
    result |= {"correction_ms": corrections.wall_ms, "correction_cpu_ms": corrections.cpu_ms}
    result["path_ms"] = float(np.median(paths.wall_ms)) if live else 0.0
    return result


def local_core_ms(world_name: str, seed: int, frames: int) -> list[float]:
    """What the local odometry takes for each of ``frames`` steps in this process."""
    torch.set_num_threads(1)
    core, times = LocalOdometry.load(WEIGHTS / world_name, world_name), Times()
    (episode,) = episodes(world_name, seed, frames, frames)
    images = images_of(world_named(world_name), episode).numpy()
    core.update(stamp_ns(0), images[0], None)
    for number, action in enumerate(tqdm(episode.actions.tolist(), f"{world_name} local odometry"), 1):
        times.take(core.update, stamp_ns(number), images[number], action)
    return times.wall_ms


def rmse_m(nodes: np.ndarray, drive: Drive, block: int) -> float:
    """Error of the positions ``(blocks, 3)`` after each meta-pose."""
    return position_rmse_m(nodes, drive.truth[block - 1 : len(nodes) * block : block])
