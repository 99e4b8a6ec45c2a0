"""Choose the settings of the classical pose graph on validation mazes, and write them beside the results.

    python -m training.tune_pose_graph --world maze2d

A coordinate search: each group of settings in turn takes the value of its grid with the smallest mean position RMSE,
until nothing gets better. Nothing is random.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tqdm import tqdm

from ngo_estimator.checkpoint import load_place, load_smoother
from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother
from ngo_estimator.networks.place_encoder import PairHead
from training.baselines.graph_settings import REGISTRATIONS, fit_calibration
from training.baselines.loop_factors import (
    LoopFactors,
    MoreLoops,
    Seen,
    found_loops,
    overlaps_of,
    registered_odometry,
    smoothed_odometry,
)
from training.baselines.pose_graph import PoseGraphSettings, optimize
from training.common import records
from training.common.command_line import run_command
from training.data.feature_store import open_store
from training.data.worlds import WorldName, world_named
from training.scoring.metrics import trajectory_error

GRID: tuple[tuple[dict[str, Any], ...], ...] = (
    tuple(
        {"kernel": kernel, "kernel_width": width}
        for kernel, widths in {
            "none": (1.0,),
            "huber": (0.5, 1.0, 2.0),
            "cauchy": (0.5, 1.0, 2.0, 4.0),
            "geman_mcclure": (1.0, 2.0, 4.0, 8.0),
            "dcs": (2.0, 3.5, 5.0, 10.0),
        }.items()
        for width in widths
    ),
    tuple({"drift_m": value} for value in (0.0, 0.2, 0.5, 1.0, 2.0)),
    tuple({"odometry_position_scale": value} for value in (0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 9.0)),
    tuple({"odometry_heading_scale": value} for value in (0.7, 1.0, 1.5, 2.0, 3.0, 4.0)),
    tuple({"loop_position_scale": value} for value in (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)),
    tuple({"loop_heading_scale": value} for value in (0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0)),
    tuple({"min_logit": value} for value in (-2.0, 0.0, 2.0, 4.0)),
    tuple(
        {"search": LoopSearch(per_pose=per_pose, most=most, views=views)}
        for per_pose, most, views in ((2, 96, 5), (2, 500, 1), (2, 500, 5), (4, 500, 1), (4, 500, 5), (4, 1000, 1))
    ),
)
"""The values of each group of settings, in the order in which they are tried."""

_ARRAYS = ("relative", "log_std", "codes", "origin_code", "truth")
FORMS = ("loops", "registered", "smoothed")
_SMALLEST_GAIN = 2e-3  # of the error: less is noise, and the value that was there first stays


@dataclass(frozen=True)
class Arguments:
    """Settings of the search."""

    world: WorldName  # World to tune for.
    trajectories: int = 0  # Validation trajectories of each table of results; 0 for all.
    form: Literal["loops", "registered", "smoothed"] = "loops"
    """Odometry of the graph: that of the local network, registered again, or as our optimizer smooths it."""
    passes: int = 2  # Largest number of passes over all groups.
    weights: Path = records.WEIGHTS
    """Folder with WORLD/place_encoder.safetensors, and the odometry smoother for what is smoothed."""
    out: Path = records.ROOT / "training" / "results"
    """Folder that gets WORLD.gtsam.json, of another form WORLD.gtsam_FORM.json."""
    runs: Path = records.ROOT / "runs"  # Folder of WORLD/features/.


class Objective:
    """Mean position RMSE (m) of the pose graph over trajectories, as a function of its settings.

    Args:
        arrays: ``relative``, ``log_std``, ``codes``, ``origin_code`` and ``truth`` of a feature store, and ``motion``
            for a smoother.
        registered: whether the graph's odometry is registered again.
        smoother: what smooths it, if anything.
    """

    def __init__(
        self,
        arrays: dict[str, np.ndarray],
        pair_head: PairHead,
        registered: bool = False,
        smoother: OdometrySmoother | None = None,
    ) -> None:
        self.arrays, self._pair_head, self._registered, self._smoother = arrays, pair_head, registered, smoother
        self._odometry: tuple[np.ndarray, np.ndarray] | None = None
        self._loops: dict[object, list[LoopFactors]] = {}

    def loops(self, settings: PoseGraphSettings) -> list[LoopFactors]:
        """The loops of each trajectory under these settings."""
        search = replace(settings.search, overlaps=0)  # which are looked for later
        key = (search, settings.block, settings.odometry_gain, settings.odometry_bias)
        if key not in self._loops:
            self._loops[key] = found_loops(self._pair_head, self._seen(settings), search, settings.block)
        return self._loops[key]

    def _seen(self, settings: PoseGraphSettings) -> Seen:
        arrays, relative = self.arrays, settings.calibrated(self.arrays["relative"])
        return Seen(relative, arrays["log_std"], arrays["codes"], arrays["origin_code"])

    def _steps(self, settings: PoseGraphSettings) -> tuple[np.ndarray, np.ndarray]:
        if self._odometry is None:  # nothing that is tuned for it changes it
            odometry = self.arrays["relative"], self.arrays["log_std"]
            if self._registered:
                odometry = registered_odometry(self._pair_head, self._seen(settings), settings.search, settings.block)
            if self._smoother is not None:
                odometry = smoothed_odometry(self._smoother, *odometry, self.arrays["motion"])
            self._odometry = odometry
        return self._odometry

    def __call__(self, settings: PoseGraphSettings) -> float:
        odometry, search = self._steps(settings), settings.search
        more: Sequence[MoreLoops | None] = [None] * len(self.arrays["relative"])
        if search.overlaps:
            steps = settings.calibrated(odometry[0])
            more = overlaps_of(self._pair_head, self.arrays["codes"], steps, search, settings.block)
        graphs = zip(*odometry, self.loops(settings), more, strict=True)
        return self.error(optimize(steps, std, loops, settings, more) for steps, std, loops, more in graphs)

    def error(self, poses: Iterable[np.ndarray]) -> float:
        """Mean position RMSE (m) of trajectories ``(steps, 3)``."""
        origin = np.zeros((1, 3))
        return float(
            np.mean(
                [
                    trajectory_error(np.concatenate((origin, one)), np.concatenate((origin, truth))).position_rmse_m
                    for one, truth in zip(poses, self.arrays["truth"], strict=True)
                ]
            )
        )


def tune(
    objective: Callable[[PoseGraphSettings], float],
    start: PoseGraphSettings,
    grid: Iterable[Iterable[dict[str, Any]]],
    passes: int,
) -> tuple[PoseGraphSettings, float]:
    """Coordinate search for the settings with the smallest ``objective``, from ``start``; returns both."""
    groups = [list(group) for group in grid]
    tried: dict[PoseGraphSettings, float] = {}
    best, least = start, objective(start)
    tried[best] = least
    with tqdm(total=passes * sum(map(len, groups)), desc="tune", unit="setting") as bar:
        for _ in range(passes):
            before = best
            for group in groups:
                for change in group:
                    candidate = replace(best, **change)
                    if candidate not in tried:
                        tried[candidate] = objective(candidate)
                    if tried[candidate] < least * (1.0 - _SMALLEST_GAIN):
                        best, least = candidate, tried[candidate]
                    bar.update()
                    bar.set_postfix(least=f"{least:.4f}")
            if best == before:
                break
    return best, least


def _searching(change: dict[str, Any], **how: int) -> dict[str, Any]:
    """The change; if it changes the search, with these common settings."""
    return {name: replace(value, **how) if name == "search" else value for name, value in change.items()}


def main(arguments: Arguments) -> PoseGraphSettings:
    """Search, print the best settings and write them."""
    torch.set_num_threads(1)
    world = world_named(arguments.world)
    features = arguments.runs / world.name / "features"
    stores = [open_store(features / f"validation_{table}") for table in world.unseen_tables]
    arrays = {
        name: np.concatenate([store[name][: arguments.trajectories or None] for store in stores])
        for name in (*_ARRAYS, *(("motion",) if arguments.form == "smoothed" else ()))
    }
    path = arguments.out / f"{world.name}.gtsam.json"
    place, described = load_place(arguments.weights / world.name, world.name)
    pair_head = place.pair_head
    registrations = 0 if pair_head.config.registration is None else REGISTRATIONS
    start = PoseGraphSettings()
    # Overlaps are looked for as in our optimizer; whether they help is one more thing to try, with each search.
    counts = dict.fromkeys((world.overlaps if registrations else 0, 0))
    searches = [{"registrations": registrations, "overlaps": count} for count in counts]
    start = replace(start, search=replace(start.search, **searches[0]))
    grid = [
        [_searching(change, **how) for change in group for how in (searches if "search" in change else searches[:1])]
        for group in GRID
    ]
    smoother: OdometrySmoother | None = None
    tuned_for = {"place_encoder_sha256": described["sha256"]}
    if arguments.form in ("registered", "smoothed"):
        path = arguments.out / f"{world.name}.gtsam_{arguments.form}.json"
        if arguments.form == "smoothed":
            smoother, smooths = load_smoother(arguments.weights / world.name, world.name)
            tuned_for["odometry_smoother_sha256"] = smooths["sha256"]
    else:
        grid.append([fit_calibration(arrays["relative"], arrays["truth"])])
    objective = Objective(arrays, pair_head, arguments.form == "registered", smoother)
    started = time.monotonic()
    best, least = tune(objective, start, grid, arguments.passes)
    odometry = objective.error(se2.r2g(torch.from_numpy(arrays["relative"]).double()).numpy())
    result = {
        "settings": dataclasses.asdict(best),
        **tuned_for,
        "validation": {
            "trajectories": len(arrays["truth"]),
            "position_rmse_m": least,
            "odometry_position_rmse_m": odometry,
        },
        "tuning": {**records.record("tune_pose_graph", arguments), "seconds": round(time.monotonic() - started)},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n")
    print(json.dumps(result["settings"]))
    print(f"position RMSE {least:.4f} m (odometry {odometry:.4f} m) over {len(arrays['truth'])} trajectories; {path}")
    return best


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
