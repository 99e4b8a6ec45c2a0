"""How good ``world:=doom`` is on maps that nobody trained on, map by map.

    python -m training.results --world doom

Each map is driven by the explorer with three seeds. The command writes ``training/results/doom.json``,
``docs/results_doom.md`` and its figures. It trains nothing but GTSAM's settings, which it chooses on validation maps
where ``training/results/doom.gtsam.json`` is missing. Run it again to continue after a stop.
"""

import dataclasses
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from ngo_estimator.checkpoint import FAMILIARITY, load_familiarity, load_local, load_place
from ngo_estimator.data.weights_file import load_description
from ngo_estimator.frontend.camera.familiarity_watch import FamiliarityWatch
from ngo_estimator.slam import online_trajectory
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from training.baselines.graph_settings import load_settings
from training.common.command_line import check_at_least, run_command
from training.data.doom_drives import TEST_MAPS, VALIDATION_MAPS, Map, map_drive
from training.data.episodes import images_of
from training.data.features import features_of
from training.data.worlds import World, world_named
from training.report.doom_levels import draw_levels
from training.report.doom_page import draw, page
from training.report.folders import Folders
from training.scoring import doom_rows
from training.scoring.doom_rows import (
    ROWS,
    Estimate,
    Features,
    errors_of,
    gtsam_graph,
    local,
    ours,
    returning,
)
from training.scoring.metrics import path_length_m
from training.scoring.online_estimate import with_origin
from training.scoring.table import Drive, Measured, Row, column, intervals, kept, means_over_samples, measure

_FIRST_SEED = {"validation": 10_000, "test": 20_000}
_MAPS = {"validation": VALIDATION_MAPS, "test": TEST_MAPS}
_TRUTH = "truth"
_WORLD = "doom"


@dataclass(frozen=True)
class Arguments(Folders):
    """Settings of the measurement."""

    split: Literal["validation", "test"] = "test"
    """Maps to measure on. Settings are chosen on validation; the test maps are for the final table alone."""
    seeds: int = 3  # Drives of each map.
    frames: int = 1000  # Frames of a drive.
    maps: int = 0  # Number of maps; 0: all.

    def __post_init__(self) -> None:
        check_at_least(self, seeds=2, frames=2, maps=0)


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    torch.set_num_threads(1)
    folder = arguments.weights / _WORLD
    drives = Drives(folder, arguments)
    rows = table_rows(arguments, drives)
    seeds = range(_FIRST_SEED[arguments.split], _FIRST_SEED[arguments.split] + arguments.seeds)
    result: dict[str, Any] = {**arguments.made("doom"), "path_m": {}, "returns": {}, "maps": {}}
    tracks: dict[str, dict[str, np.ndarray]] = {}
    for of in _MAPS[arguments.split][: arguments.maps or None]:
        name = map_name(of)
        table = measure([(drives.of_table(of, seed), rows) for seed in seeds], drives.folder / "scored", name)
        means = {row: means_over_samples(column(table, row)) for row in rows}
        result["path_m"][name] = intervals(means[_TRUTH])["path_m"]
        result["returns"][name] = float(means[_TRUTH]["returns"].mean())
        result["maps"][name] = {row: intervals(means[row]) for row in ROWS}
        first = next(iter(table.values()))
        tracks[name] = {row: measured.drawn["track"] for row, measured in first.items()}
    draw_levels(arguments.images / "doom_levels.png")
    draw(arguments.images / "results_doom_maps.png", tracks)
    return arguments.publish(_WORLD, result, page(result, folder))


def map_name(of: Map) -> str:
    """The name of a map in the tables: that of the file, for freedoom's with the map's."""
    wad, name = of
    return f"freedoom2_{name}" if wad == "freedoom2.wad" else wad.removesuffix(".wad")


class Drives:
    """Drives as ``local_node`` publishes them, each made once and kept in a file below ``folder``."""

    def __init__(self, weights: Path, arguments: Arguments) -> None:
        self.folder = arguments.runs / _WORLD / "results"
        self._frames, self._weights = arguments.frames, weights
        self.local, described = load_local(weights, _WORLD)
        self.place, described_place = load_place(weights, _WORLD)
        familiarity = load_familiarity(weights, _WORLD)
        self._watch = None if familiarity is None else FamiliarityWatch(familiarity, self.place.encoder)
        known = weights / f"{FAMILIARITY}.safetensors"
        watch = load_description(known, FAMILIARITY)["sha256"] if known.exists() else None
        self._identity = f"{json.dumps([described['sha256'], described_place['sha256']])} {watch}"

    def features(self, of: Map, seed: int) -> Features:
        """What the networks make of a drive."""

        def made() -> Features:
            world, drive = world_named(_WORLD), map_drive(of, seed, self._frames)
            features = features_of(world, drive, self._weights, (self.local, self.place))
            if self._watch is None:
                return features
            return judged(self._watch, images_of(world, drive), drive.actions, features)

        name = self._name(of, seed)
        return kept(self.folder / f"{name}.npz", f"{name} {self._identity}", made)

    def _name(self, of: Map, seed: int) -> str:
        return f"{map_name(of)}-{seed}-{self._frames}"

    def of_table(self, of: Map, seed: int) -> Drive:
        """A drive of the table."""
        name = self._name(of, seed)
        return Drive(name, f"{name} {self._identity}", partial(self.features, of, seed))


def judged(watch: FamiliarityWatch, images: torch.Tensor, actions: np.ndarray, features: Features) -> Features:
    """The features with steps and deviations of frames that are judged, and ``unlikeness`` ``(steps,)``."""
    relative, log_std, motion = (torch.from_numpy(features[name]) for name in ("relative", "log_std", "motion"))
    found = watch.judge_drive(images, actions, (relative, torch.exp(2.0 * log_std.double()), motion))
    return {
        **features,
        "relative": np.stack([one.relative for one in found]).astype(np.float32),
        "log_std": 0.5 * np.log(np.stack([one.variance for one in found])),
        "unlikeness": np.array([one.unlikeness for one in found]),
    }


def table_rows(arguments: Arguments, drives: Drives) -> dict[str, Row]:
    """The rows of the table, and one of the drives themselves."""
    settings = load_settings(arguments.out / f"{_WORLD}.gtsam.json")
    core = OnlineTrajectory.load(arguments.weights / _WORLD, world=_WORLD)
    estimators = {
        "local": (local, ""),
        "gtsam": (gtsam_graph(settings, drives.place.pair_head), json.dumps(dataclasses.asdict(settings))),
        "ours": (ours(core), str(core.identity)),
    }

    def scored(features: Features, row: str) -> Measured:
        estimate: Estimate = estimators[row][0](features)
        return Measured.of(errors_of(estimate, features["truth"]), track=estimate.poses[:, :2])

    world, code = world_named(_WORLD), (doom_rows, online_trajectory)
    rows = {row: Row(partial(scored, row=row), identity, code) for row, (_, identity) in estimators.items()}
    return {**rows, _TRUTH: Row(partial(_truth, world=world), "", (doom_rows,))}


def _truth(features: Features, world: World) -> Measured:
    """Length of the path, and the share of it that returns."""
    truth = features["truth"]
    returns = returning(truth, world.place_radius_m, world.heading_limit_rad)
    return Measured.of({"path_m": path_length_m(with_origin(truth)), "returns": returns}, track=truth[:, :2])


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
