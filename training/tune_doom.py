"""Choose how ``world:=doom`` closes loops, and GTSAM's settings beside it, on the validation maps.

    python -m training.tune_doom

The optimizer is that of ``train_loop_judge``: a robust pose graph without a network, with a judge of loops. What is
chosen, on maps, drawn levels and mazes: how likely a loop must be, and how far deviations of steps and loops are
stretched. A choice with which the error on a map is larger than that of its odometry is out, whatever it gains. The
optimizer's covariance is then fitted to its errors. The command writes ``neural_graph_optimizer.safetensors`` and
``training/results/doom.gtsam.json``.
"""

import dataclasses
import itertools
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ngo_estimator.checkpoint import OPTIMIZER, load_optimizer, load_place, save_checkpoint
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.ngo.whole_trajectory import optimize_offline
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training import results_doom
from training.baselines.pose_graph import PoseGraphSettings
from training.common import records
from training.common.command_line import run_command
from training.data.doom_drives import MAZES, ROOMS, VALIDATION_MAPS, Map
from training.data.features import OPTIMIZER_INPUTS
from training.data.worlds import VALIDATION_SEEDS
from training.scoring.doom_rows import Features, gtsam_graph, local, ours
from training.scoring.metrics import WITHIN_DEVIATIONS, absolute_error_m, off_by
from training.scoring.online_estimate import with_origin

BELIEFS = (0.7, 0.8, 0.9)  # Least likelihood of a loop.
STEP_SCALES = ((0.25, 0.25, 0.5), (0.25, 0.25, 1.0))  # Factors of the deviations of steps (x, y, yaw).
LOOP_SCALES = (0.0, -0.5)
"""Stretch of the deviations of a loop's position: the information gets the factor exp(4 tanh(x / 2))."""
DRIFTS = ((0.0, 0.0), (0.06, 0.0075), (0.12, 0.0075))
"""What the odometry drifts in a step (m, rad) for GTSAM: how far away candidates may lie; (0, 0): anywhere."""
FIRST_MAZE, FEWER = 900, 12  # Of the validation seeds, the first that drives in a maze, and how many do.
WANTED = 0.97  # Share of the published poses within three deviations.
MOST_HARM = 1.05
"""Largest ratio of the mean error on a map to that of the odometry.

True loops may give a drive a larger error: where the odometry turned wrongly in one place, the correction is spread.
"""
HARM_BELOW_M = 0.2  # Errors that small do not count as harm.


@dataclass(frozen=True)
class Arguments:
    """Settings of the choice."""

    seeds: int = 5  # Drives of each validation map, and twice as many through generated levels.
    frames: int = 1000  # Frames of a drive.
    weights: Path = records.WEIGHTS  # Folder with doom/*.safetensors, which gets the optimizer.
    out: Path = records.ROOT / "training" / "results"  # Folder that gets doom.gtsam.json.
    runs: Path = records.ROOT / "runs"  # Folder of what is kept of each drive.


def main(arguments: Arguments) -> None:
    """Choose, print and write."""
    torch.set_num_threads(1)
    folder = arguments.weights / "doom"
    about = records.record("tune_doom", arguments)
    drives = results_doom.Drives(
        folder, results_doom.Arguments(weights=arguments.weights, runs=arguments.runs, frames=arguments.frames)
    )
    places = [(of, 10_000 + k) for of in VALIDATION_MAPS for k in range(arguments.seeds)]
    places += [(ROOMS, VALIDATION_SEEDS[k]) for k in range(2 * arguments.seeds)]
    places += [(MAZES, VALIDATION_SEEDS[FIRST_MAZE + k]) for k in range(FEWER)]
    features = [drives.features(*place) for place in places]
    odometry = np.array([error(local(one).poses, one) for one in features])
    pair_head = drives.place.pair_head
    best: tuple[float, NeuralGraphOptimizer] | None = None
    for belief, step, loop in itertools.product(BELIEFS, STEP_SCALES, LOOP_SCALES):
        optimizer = robust_graph(folder, belief, step, loop)
        corrected = np.array([error(corrected_poses(optimizer, pair_head, one), one) for one in features])
        ratios, harm = corrected / odometry, harmful(corrected, odometry, [of for of, _ in places])
        score = float(np.exp(np.log(ratios).mean()))
        print(f"belief {belief} steps {step} loops {loop}: {score:.3f}, worst {ratios.max():.3f}", flush=True)
        if not harm and (best is None or score < best[0]):
            best = score, optimizer
    chosen = robust_graph(folder, 0.999, (1.0, 1.0, 1.0), 0.0) if best is None else best[1]
    core = OnlineTrajectory(chosen.eval(), pair_head)
    scale = covariance_scale(core, features)
    # Where no loop is closed, no less than the odometry itself says.
    scale = max(scale, float(torch.exp(-2.0 * chosen.log_scale.detach()).max()))
    chosen.config = dataclasses.replace(chosen.config, covariance_scale=scale)
    validation = {"ate_ratio": None if best is None else best[0], "odometry_ate_m": float(odometry.mean())}
    place_sha256 = load_place(folder, "doom")[1]["sha256"]
    details = {"place_encoder_sha256": place_sha256, "training": about, "metrics": {"validation": validation}}
    save_checkpoint(folder / f"{OPTIMIZER}.safetensors", chosen, OPTIMIZER, "doom", details)
    print(f"ATE {validation['ate_ratio']} of the odometry's, covariance scale {scale:.2f}")
    write_pose_graph(arguments, features, odometry, drives)


def error(poses: np.ndarray, features: Features) -> float:
    """ATE (m) of poses ``(steps, 3)`` of a drive."""
    return absolute_error_m(with_origin(poses), with_origin(features["truth"]))


def covariance_scale(core: OnlineTrajectory, features: list[Features]) -> float:
    """The least factor of the covariance with which ``WANTED`` of all published poses are within three deviations."""
    needed = []
    for one in features:
        found = ours(core)(one)
        off = off_by(found.published, one["truth"])
        variances = np.diagonal(found.covariances, axis1=1, axis2=2)
        needed.append((np.square(off / WITHIN_DEVIATIONS) / variances).max(axis=1))
    return float(np.quantile(np.concatenate(needed), WANTED))


def harmful(corrected: np.ndarray, odometry: np.ndarray, maps: list[Map]) -> bool:
    """Whether errors ``(drives,)`` (m) are larger than the odometry's in the mean of one of ``maps``."""
    drives_of = [np.array([of == one for of in maps]) for one in set(maps)]
    return any(corrected[of].mean() > max(MOST_HARM * odometry[of].mean(), HARM_BELOW_M) for of in drives_of)


def robust_graph(
    folder: Path, belief: float, step_scale: tuple[float, float, float], loop_scale: float
) -> NeuralGraphOptimizer:
    """The optimizer with a judge in ``folder`` under other settings; arguments as of the grids above."""
    found, _ = load_optimizer(folder, "doom")
    search = dataclasses.replace(found.config.search, least_belief=belief)
    optimizer = NeuralGraphOptimizer(dataclasses.replace(found.config, search=search))
    optimizer.load_state_dict(found.state_dict())
    with torch.no_grad():
        optimizer.log_scale.copy_(torch.tensor(step_scale).log())
        optimizer.loop_gate.head.bias.copy_(torch.tensor([0.0, loop_scale, 0.0]))
    return optimizer.eval()


def corrected_poses(optimizer: NeuralGraphOptimizer, pair_head: torch.nn.Module, features: Features) -> np.ndarray:
    """The corrected poses ``(steps, 3)`` of a drive."""
    inputs = [torch.from_numpy(np.asarray(features[name], dtype=np.float32)) for name in OPTIMIZER_INPUTS]
    poses: np.ndarray = optimize_offline(optimizer, pair_head, *inputs).poses[0].numpy()  # type: ignore[arg-type]
    return poses


def write_pose_graph(
    arguments: Arguments, features: list[Features], odometry: np.ndarray, drives: results_doom.Drives
) -> None:
    """Choose GTSAM's settings by the same rule, and write them."""
    start = PoseGraphSettings(search=LoopSearch(per_pose=4, most=128, views=1))
    best, least = start, np.inf
    grid = itertools.product(DRIFTS, (2.0, 3.0), (0.25, 0.5, 1.0), (1.0, 3.0), (1.0,))
    for (drift_m, drift_rad), min_logit, step, loop, drift in grid:
        search = dataclasses.replace(start.search, drift_m=drift_m, drift_rad=drift_rad)
        settings = dataclasses.replace(
            start, search=search, min_logit=min_logit, odometry_position_scale=2.0 * step, odometry_heading_scale=step,
            loop_position_scale=loop, loop_heading_scale=loop, drift_m=drift,
        )  # fmt: skip
        estimator = gtsam_graph(settings, drives.place.pair_head)
        corrected = np.array([error(estimator(one).poses, one) for one in features])
        ratios = corrected / odometry
        score = float(np.exp(np.log(ratios).mean()))
        print(f"gtsam {drift_m} {min_logit} {step} {loop} {drift}: {score:.3f}, worst {ratios.max():.3f}", flush=True)
        if score < least:
            best, least = settings, score
    result = {
        "settings": dataclasses.asdict(best),
        "validation": {"ate_ratio": least},
        "tuning": records.record("tune_doom", arguments),
    }
    path = arguments.out / "doom.gtsam.json"
    path.write_text(json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
