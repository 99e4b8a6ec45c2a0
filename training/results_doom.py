"""How good ``world:=doom`` is on maps that nobody trained on, map by map.

    python -m training.results --world doom

Each map is driven by the explorer with three seeds. The command writes ``training/results/doom.json``,
``docs/results_doom.md`` and its figures. It trains nothing but GTSAM's settings, which it chooses on validation maps
where ``training/results/doom.gtsam.json`` is missing. Run it again to continue after a stop.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from tqdm import tqdm

from ngo_estimator.checkpoint import FAMILIARITY, load_familiarity, load_local, load_place
from ngo_estimator.data.weights_file import load_description
from ngo_estimator.frontend.camera.familiarity_watch import FamiliarityWatch
from ngo_estimator.slam.online_trajectory import OnlineTrajectory
from ngo_sim.episodes import Episode
from training.baselines.graph_settings import load_settings
from training.common import records
from training.common.command_line import run_command
from training.common.records import write_at_once
from training.data.doom_drives import TEST_MAPS, TRAIN_MAPS, VALIDATION_MAPS, Map, map_drive
from training.data.episodes import images_of
from training.data.features import features_of
from training.data.worlds import world_named
from training.report.doom_levels import draw_levels
from training.report.doom_page import draw, page
from training.scoring.doom_rows import (
    METRICS,
    ROWS,
    ActionsFit,
    Estimate,
    Features,
    errors_of,
    gtsam_graph,
    local,
    ours,
    returning,
)
from training.scoring.statistics import mean_interval

_FIRST_SEED = {"validation": 10_000, "test": 20_000}
_MAPS = {"validation": VALIDATION_MAPS, "test": TEST_MAPS}
_FIT_SEED, _FIT_MAPS = 5_000, 12


@dataclass(frozen=True)
class Arguments:
    """Settings of the measurement."""

    world: Literal["doom"] = "doom"
    """World to measure in."""
    split: Literal["validation", "test"] = "test"
    """Maps to measure on. Settings are chosen on validation; the test maps are for the final table alone."""
    seeds: int = 3
    """Drives of each map."""
    frames: int = 1000
    """Frames of a drive."""
    maps: int = 0
    """Number of maps; 0: all."""
    weights: Path = records.WEIGHTS
    """Folder with doom/*.safetensors."""
    out: Path = records.ROOT / "training" / "results"
    """Folder that gets doom.json, and holds doom.gtsam.json."""
    docs: Path = records.ROOT / "docs"
    """Folder that gets results_doom.md and images/."""
    runs: Path = records.ROOT / "runs"
    """Folder of what is kept of each drive."""


def main(arguments: Arguments) -> dict[str, Any]:
    """Measure, write everything, and return the JSON's content."""
    torch.set_num_threads(1)
    folder = arguments.weights / arguments.world
    drives = Drives(folder, arguments)
    rows = row_estimators(arguments, drives)
    seeds = range(_FIRST_SEED[arguments.split], _FIRST_SEED[arguments.split] + arguments.seeds)
    maps = _MAPS[arguments.split][: arguments.maps or None]
    result: dict[str, Any] = {**records.record("results_doom", arguments), "path_m": {}, "returns": {}, "maps": {}}
    result.pop("arguments")
    tracks: dict[str, dict[str, np.ndarray]] = {}
    for of in tqdm(maps, desc=f"{arguments.world} {arguments.split}", unit="map"):
        found = [drives.scored(of, seed, rows) for seed in seeds]
        entry: dict[str, Any] = {
            row: {metric: mean_interval(np.array([one.errors[row][metric] for one in found])).as_json()
                  for metric in METRICS}
            for row in ROWS
        }  # fmt: skip
        result["path_m"][map_name(of)] = mean_interval(
            np.array([one.errors["local"]["path_m"] for one in found])
        ).as_json()
        result["returns"][map_name(of)] = float(np.mean([one.errors["local"]["returns"] for one in found]))
        result["maps"][map_name(of)] = entry
        tracks[map_name(of)] = found[0].tracks
    write_at_once(arguments.out / f"{arguments.world}.json", json.dumps(result, indent=2) + "\n")
    draw_levels(arguments.docs / "images" / "doom_levels.png")
    draw(arguments.docs / "images" / "results_doom_maps.png", tracks)
    write_at_once(arguments.docs / "results_doom.md", page(result, folder))
    return result


def map_name(of: Map) -> str:
    """The name of a map in the tables: that of the file, for freedoom's with the map's."""
    wad, name = of
    return f"freedoom2_{name}" if wad == "freedoom2.wad" else wad.removesuffix(".wad")


@dataclass(frozen=True)
class Scored:
    """The errors of each row on a drive, and their paths ``(steps, 2)`` with the true one, ``truth``."""

    errors: dict[str, dict[str, float]]
    tracks: dict[str, np.ndarray]


class Drives:
    """Drives and what was measured on them, kept in files."""

    def __init__(self, weights: Path, arguments: Arguments) -> None:
        self._folder = arguments.runs / arguments.world / "results"
        self._frames, self._weights = arguments.frames, weights
        self.local, described = load_local(weights, arguments.world)
        self.place, described_place = load_place(weights, arguments.world)
        familiarity = load_familiarity(weights, arguments.world)
        self._watch = None if familiarity is None else FamiliarityWatch(familiarity, self.place.encoder)
        self._networks = (described["sha256"], described_place["sha256"])
        self._world = world_named(arguments.world)

    def drive(self, of: Map, seed: int, drawn_start: bool = False) -> Episode:
        """A drive, which is simulated once."""
        start = "-drawn" if drawn_start else ""
        path = self._folder / "drives" / f"{map_name(of)}-{seed}-{self._frames}{start}.npz"
        if not path.exists():
            drive = map_drive(of, seed, self._frames, drawn_start=drawn_start)
            _save(path, observations=drive.observations, actions=drive.actions, poses=drive.poses_xyyaw)
        with np.load(path) as stored:
            return Episode(stored["observations"], stored["actions"], stored["poses"], self._world.period_s, None)

    def features(self, of: Map, seed: int, drawn_start: bool = False) -> Features:
        """What the networks make of a drive."""
        key = hashlib.sha256(json.dumps([self._networks, of, seed, self._frames, drawn_start]).encode()).hexdigest()
        path = self._folder / f"{map_name(of)}-{seed}-{key[:12]}.npz"
        if not path.exists():
            drive = self.drive(of, seed, drawn_start)
            features = features_of(self._world, drive, self._weights, (self.local, self.place))
            _save(path, actions=drive.actions, poses=drive.poses_xyyaw, **features)
        with np.load(path) as stored:
            return dict(stored)

    def judged(self, of: Map, seed: int, features: Features) -> Features:
        """The features with steps and deviations as ``local_node`` publishes them, and ``unlikeness`` ``(steps,)``."""
        if self._watch is None:
            return features
        drive = self.drive(of, seed)
        relative, log_std, motion = (torch.from_numpy(features[name]) for name in ("relative", "log_std", "motion"))
        steps = relative, torch.exp(2.0 * log_std.double()), motion
        found = self._watch.judge_drive(images_of(self._world, drive), drive.actions, steps)
        return {
            **features,
            "relative": np.stack([one.relative for one in found]).astype(np.float32),
            "log_std": 0.5 * np.log(np.stack([one.variance for one in found])),
            "unlikeness": np.array([one.unlikeness for one in found]),
        }

    def scored(self, of: Map, seed: int, rows: "Rows") -> Scored:
        """The errors of the rows on a drive."""
        key = hashlib.sha256(json.dumps([self._networks, rows.identity, self._frames]).encode()).hexdigest()
        path = self._folder / "scored" / f"{map_name(of)}-{seed}-{key[:12]}.json"
        if not path.exists():
            features = self.judged(of, seed, self.features(of, seed))
            estimates = {row: estimator(features) for row, estimator in rows.estimators.items()}
            errors = {row: errors_of(estimate, features["truth"]) for row, estimate in estimates.items()}
            radius_m, angle_rad = self._world.place_radius_m, self._world.heading_limit_rad
            errors["local"]["returns"] = returning(features["truth"], radius_m, angle_rad)
            tracks = {row: estimate.poses[:, :2].tolist() for row, estimate in estimates.items()}
            tracks["truth"] = features["truth"][:, :2].tolist()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_at_once(path, json.dumps({"errors": errors, "tracks": tracks}))
        stored = json.loads(path.read_text())
        return Scored(stored["errors"], {row: np.array(track) for row, track in stored["tracks"].items()})


@dataclass(frozen=True)
class Rows:
    """The estimators of all rows, and what identifies them beside the networks of the odometry and of places."""

    estimators: dict[str, Callable[[Features], Estimate]]
    identity: str


def _save(path: Path, **arrays: np.ndarray) -> None:
    """Write arrays as a file that is there as a whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part.npz")
    np.savez(partial, **arrays)  # type: ignore[arg-type]
    partial.rename(path)


def row_estimators(arguments: Arguments, drives: Drives) -> Rows:
    """The estimators of all rows."""
    fitted = [drives.features(of, _FIT_SEED, drawn_start=True) for of in TRAIN_MAPS[:_FIT_MAPS]]
    actions = ActionsFit.of([(one["actions"], one["poses"]) for one in fitted])
    settings = load_settings(arguments.out / f"{arguments.world}.gtsam.json")
    core = OnlineTrajectory.load(arguments.weights / arguments.world, world=arguments.world)
    known = arguments.weights / arguments.world / f"{FAMILIARITY}.safetensors"
    familiarity = load_description(known, FAMILIARITY)["sha256"] if known.exists() else None
    estimators = {
        "actions_only": actions.estimate,
        "local": local,
        "gtsam": gtsam_graph(settings, drives.place.pair_head),
        "ours": ours(core),
    }
    return Rows(estimators, json.dumps([core.identity, dataclasses.asdict(settings), familiarity]))


if __name__ == "__main__":
    run_command(main, Arguments, __doc__)
