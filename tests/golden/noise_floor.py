"""How much a run through each stored drive changes with the rounding of its input: the noise floor of the net.

    python -m tests.golden.noise_floor                     # measures all; writes noise_floor.json and paths.npz
    python -m tests.golden.noise_floor --keep              # prints it beside what is stored, and writes nothing
    python -m tests.golden.noise_floor --keep scan_slips   # some drives: those whose names begin so

A refactoring stays within the floor. Another front end may leave it: the last line says to which side.
"""

from __future__ import annotations

import functools
import json
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from tests.golden.drives import GoldenDrive
from tests.golden.lidar_drives import GoldenLidarDrive
from tests.golden.net import STORED, Scores, save_arrays, scores_of

FLOOR, PATHS = (Path(__file__).parent / name for name in ("noise_floor.json", "paths.npz"))
COPIES = 5
SCORES = tuple(score.name for score in fields(Scores))

MULTIPLE = 2.0  # A score may be so many times as far from the stored drive's as that of the copy that is farthest.

LEAST = Scores(ate_m=2e-4, odometry_ate_m=2e-4, within=0.01, nll=0.02, moved_m=1e-3)
"""How far a score may be off where no copy is: one pose in a hundred, and covariances of which each is 1 % larger.

That is for other versions of libraries. Other processors need less: with AVX-512, AVX2 and neither, poses differ by up
to 4 um.
"""


@dataclass(frozen=True)
class Floor:
    """Scores of a stored drive, and of its copies."""

    stored: Scores
    copies: tuple[Scores, ...]

    def mean(self, score: str) -> float:
        """The mean of a score over all runs, which rounding changes least."""
        return float(np.mean([getattr(run, score) for run in (self.stored, *self.copies)]))

    def spread(self, score: str) -> float:
        """How far from the stored drive's the score of a copy is at most."""
        return max(abs(getattr(copy, score) - getattr(self.stored, score)) for copy in self.copies)

    def allowed(self, score: str) -> float:
        """How far from the stored drive's a score may be."""
        return max(MULTIPLE * self.spread(score), getattr(LEAST, score))

    def left_by(self, scores: Scores) -> dict[str, str]:
        """The scores that leave the floor, and how in words."""
        found = {}
        for score in SCORES:
            value, expected, allowed = getattr(scores, score), getattr(self.stored, score), self.allowed(score)
            if not abs(value - expected) <= allowed:
                found[score] = f"{score} is {value:.4f}; expected {expected:.4f} to within {allowed:.4f}"
        return found


def stored_names() -> list[str]:
    """Names of the stored drives."""
    return sorted(path.stem for path in STORED.glob("*.npz"))


def load(name: str) -> GoldenLidarDrive | GoldenDrive:
    """The stored drive of a name."""
    return GoldenLidarDrive.load(name) if name.startswith("scan_") else GoldenDrive.load(name)


@functools.cache
def floors() -> Mapping[str, Floor]:
    """The stored noise floor of each drive; nothing before the first was measured."""
    found = {}
    for name, values in json.loads(FLOOR.read_text())["drives"].items() if FLOOR.exists() else ():
        stored, *copies = (Scores(*run) for run in zip(*(values[score] for score in SCORES), strict=True))
        found[name] = Floor(stored, tuple(copies))
    return found


@functools.cache
def paths() -> Mapping[str, np.ndarray]:
    """The stored path ``(n, 3)`` of each drive; nothing before the first was measured."""
    if not PATHS.exists():
        return {}
    with np.load(PATHS) as stored:
        return {name: stored[name].astype(np.float64) for name in stored.files}


def measured(name: str, path: np.ndarray | None = None) -> tuple[Floor, np.ndarray]:
    """The noise floor of a drive as it is now, and its path; ``moved_m`` is from ``path``, by default its own."""
    drive = load(name)
    runs = [each.run() for each in (drive, *(drive.copy(seed) for seed in range(COPIES)))]
    own = runs[0].trajectory.poses_xyyaw
    stored, *copies = (scores_of(run, drive.true_poses, own if path is None else path) for run in runs)
    return Floor(stored, tuple(copies)), own


def write(found: Mapping[str, tuple[Floor, np.ndarray]]) -> None:
    """Write floors and paths; of drives that are not in ``found`` they stay."""
    revision = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=True)
    both = {name: (floor, paths()[name]) for name, floor in floors().items()} | dict(found)
    both = {name: both[name] for name in stored_names() if name in both}
    lines = []
    for name, (floor, _) in both.items():
        runs = (floor.stored, *floor.copies)
        values = {score: [round(getattr(run, score), 7) for run in runs] for score in SCORES}
        lines.append(f'  "{name}": {json.dumps(values)}')
    rows = ",\n".join(lines)
    FLOOR.write_text(f'{{"revision": "{revision.stdout.strip()}", "drives": {{\n{rows}\n}}}}\n')
    save_arrays(PATHS, {name: path.astype(np.float32) for name, (_, path) in both.items()})


SHOWN = ("odometry_ate_m", "ate_m", "within", "nll")
HEADING = "Means over a drive and its copies, as stored and now, +- the spread; * where the drive left the floor.\n"


def line_of(name: str, before: Floor, now: Floor) -> str:
    """A line of the table."""
    left = before.left_by(now.stored)

    def cell(score: str, values: str) -> str:
        return f"{values}{'*' if score in left else ' '}+-{before.spread(score):.4f}"

    cells = [cell(score, f"{before.mean(score):7.3f} {now.mean(score):7.3f}") for score in SHOWN]
    return f"{name:17}{'  '.join(cells)}  {cell('moved_m', f'{now.stored.moved_m:.4f}')}"


def summary_of(kind: str, before: list[Floor], now: list[Floor]) -> str:
    """A line about all drives of a kind: geometric means of the ratios of errors, and means of the other scores."""

    def ratio(score: str) -> str:
        logs = [np.log(new.mean(score) / old.mean(score)) for old, new in zip(before, now, strict=True)]
        return f"{score} x {np.exp(np.mean(logs)):.3f}"

    def means(score: str) -> str:
        old, new = (np.mean([floor.mean(score) for floor in floors]) for floors in (before, now))
        return f"{score} {old:.3f} -> {new:.3f}"

    return ", ".join((f"{kind}: {len(now)} drives", *map(ratio, SHOWN[:2]), *map(means, SHOWN[2:])))


def main(names: Annotated[tuple[str, ...], tyro.conf.Positional] = (), keep: bool = False) -> None:
    """Measure the noise floor of the drives whose names begin with one of ``names``; with ``keep`` write nothing."""
    torch.set_num_threads(1)
    wanted = [name for name in stored_names() if not names or name.startswith(names)]
    print(HEADING + " " * 17 + "".join(f"{score:27}" for score in SHOWN) + "moved_m")
    found = {}
    for name in wanted:
        now, path = measured(name, paths().get(name) if keep else None)
        found[name] = now, path
        print(line_of(name, floors().get(name, now), now), flush=True)
    for kind in sorted({name.partition("_")[0] for name in wanted}):
        of_kind = [name for name in wanted if name.partition("_")[0] == kind]
        before = [floors().get(name, found[name][0]) for name in of_kind]
        print(summary_of(kind, before, [found[name][0] for name in of_kind]))
    if not keep:
        write(found)


if __name__ == "__main__":
    tyro.cli(main)
