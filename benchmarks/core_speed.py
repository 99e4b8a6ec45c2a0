"""The online core and its peers, step by step in one process: what an update costs, and what it consists of."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from benchmarks.drives import CACHE, Drive, drive_of, episodes, stamp_ns
from benchmarks.peers import SETTINGS, Incremental, LevenbergMarquardt, Problem, xyyaw
from benchmarks.roofline import counted, measured_peak
from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.nodes.path_message import PathWriter
from ngo_estimator.odometry.local_odometry import LocalOdometry
from ngo_estimator.online.online_trajectory import OnlineTrajectory
from ngo_estimator.optimizer.loop_closure import Loops
from ngo_estimator.optimizer.meta_poses import MetaSteps
from training.common.runs import WEIGHTS
from training.data.episodes import images_of
from training.data.worlds import world_named

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

    def median(self) -> dict[str, float]:
        """Of both."""
        return {"ms": float(np.median(self.wall_ms)), "cpu_ms": float(np.median(self.cpu_ms))}


class Watched:
    """An online core of which the last problem, and how long each optimisation took, are known."""

    def __init__(self, world_name: str, window: int) -> None:
        weights = WEIGHTS / world_name
        optimizer, _ = load_optimizer(weights, world_name)
        self.core = OnlineTrajectory(optimizer, load_place(weights, world_name)[0].pair_head, window)
        self.block = self.core.block
        self.optimisations = Times()
        self._given: tuple[MetaSteps, Loops] | None = None
        self._begun = Times()
        iterate, graph = optimizer.iterate, self.core._graph
        begin, advance = graph.begin, graph.advance

        def remembered(steps: MetaSteps, loops: Loops | None = None, *others: Any) -> Any:
            assert loops is not None, "expected an optimizer with loops"
            self._given = (steps, loops)
            return iterate(steps, loops, *others)

        def beginning() -> None:
            self._begun = Times()
            self._begun.take(begin)

        def advancing(iterations: int) -> bool:
            done = self._begun.take(advance, iterations)
            if done:
                self.optimisations.wall_ms.append(sum(self._begun.wall_ms))
                self.optimisations.cpu_ms.append(sum(self._begun.cpu_ms))
            return done

        vars(optimizer)["iterate"] = remembered
        vars(graph).update(begin=beginning, advance=advancing)

    def problem(self) -> Problem:
        """What the optimizer was given last."""
        assert self._given is not None, "nothing was optimised yet"
        return Problem.of(*self._given)


def core_speed(world_name: str, seed: int, window: int, live: int, repeats: int, cache: Path = CACHE) -> dict[str, Any]:
    """Drive ``window + live`` steps; compare with the peers at the last ``repeats`` meta-poses of the full window.

    ``core_ms`` lists, for each of the ``live`` steps, what the core and the path take in this process.
    """
    torch.set_num_threads(1)
    drive = drive_of(world_name, seed, window + live, cache)
    watched = Watched(world_name, window)
    block, core = watched.block, watched.core
    blocks = window // block
    incremental, lm, believed, isam, updates = Incremental(), Times(), Times(), Times(), Times()
    paths, steps = Times(), Times()
    writer = PathWriter("map")
    result: dict[str, Any] = {}

    def path() -> bytes:
        trajectory = core.trajectory()
        assert trajectory is not None
        return writer.write(int(trajectory.stamps_ns[-1]), trajectory.stamps_ns, trajectory.poses_xyyaw)

    for number, step in enumerate(tqdm(drive.steps(), f"{world_name} core", window + live), 1):
        if number > window:
            steps.take(core.update, step)
            paths.take(path)
            continue
        if number < window:
            (updates if number % block == 0 else Times()).take(core.update, step)
        else:
            with counted() as work:
                core.update(step)
            # Under the counter nothing runs at its own pace.
            del watched.optimisations.wall_ms[-1], watched.optimisations.cpu_ms[-1]
        if number % block == 0:
            problem = watched.problem()
            estimate = isam.take(incremental.update, *incremental.prepare(problem))
            incremental.keep(estimate)
            if number // block > blocks - repeats:
                batch = lm.take(LevenbergMarquardt(problem).solve)
                likely = problem.where(problem.logit >= SETTINGS.min_logit)
                believed.take(LevenbergMarquardt(likely).solve)
        if number == window:
            ours = core.trajectory()
            assert ours is not None
            result["rmse_m"] = {
                "odometry": _rmse_m(drive.odometry()[block - 1 : window : block], drive, block),
                "ours": _rmse_m(ours.poses_xyyaw[block::block], drive, block),
                "gtsam_lm": _rmse_m(xyyaw(batch)[1:], drive, block),
                "isam2": _rmse_m(xyyaw(estimate)[1:], drive, block),
            }
            result["loops"] = len(problem.nodes)
            peak = measured_peak()
            result["work"] = {**asdict(work), "flops": work.flops, "bound_ms": work.bound_ms(peak), **vars(peak)}
    for times in (watched.optimisations, updates, isam):
        # Of the window; iSAM2 took part in the last one, which was counted and not timed, too.
        last = blocks if times is isam else blocks - 1
        times.wall_ms, times.cpu_ms = (values[last - repeats : last] for values in (times.wall_ms, times.cpu_ms))
    result |= {"optimize": watched.optimisations.median(), "update": updates.median()}
    result |= {"gtsam_lm": lm.median(), "gtsam_lm_believed": believed.median(), "isam2": isam.median()}
    result["core_ms"] = (np.array(steps.wall_ms) + np.array(paths.wall_ms)).tolist()
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


def _rmse_m(nodes: np.ndarray, drive: Drive, block: int) -> float:
    """Error of the positions ``(blocks, 3)`` after each meta-pose."""
    error = nodes[:, :2] - drive.truth[block - 1 : len(nodes) * block : block, :2]
    return float(np.sqrt((error**2).sum(axis=1).mean()))
