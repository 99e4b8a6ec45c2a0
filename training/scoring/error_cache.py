"""The errors of a row's trajectories on every prefix, kept on disk so that nothing is computed twice."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import ngo_estimator
import training
from ngo_common.files import written_whole
from training.data.worlds import World
from training.scoring.row_estimators import Arrays, Estimator, prefix
from training.scoring.scores import scores

_MADE_BY = ("baselines", "data", "scoring")


@dataclass(frozen=True)
class Evaluation:
    """Poses and scores of one estimator on the trajectories of a table.

    ``poses`` ``(trajectories, steps, 3)``, float32, of whole trajectories; ``scores``: for each number of steps the
    metrics ``(trajectories,)`` by their key, the estimator having seen these steps alone, as in use.
    """

    poses: np.ndarray
    scores: dict[int, dict[str, np.ndarray]]


def evaluate_row(
    estimator: Estimator, arrays: Arrays, data: str, prefixes: Sequence[int], world: World, cache: Path
) -> Evaluation:
    """Run an estimator over whole trajectories and over prefixes of them, or read what came out last time.

    Args:
        arrays: ``(trajectories, steps, ...)``; data: what identifies them.
        prefixes: numbers of steps.
        cache: a file ``.npz``, used if estimator, data and the code that computes are those of today.
    """
    trajectories, steps = arrays["relative"].shape[:2]
    lengths = sorted({*prefixes, steps})
    if lengths[0] < 1 or lengths[-1] > steps:
        raise ValueError(f"prefixes are {list(prefixes)}; expected 1 to {steps}, the steps of a trajectory")
    identity = json.dumps([estimator.identity, data, trajectories, lengths, _code()])
    if (stored := _read(cache, identity)) is not None:
        return stored
    found: dict[int, dict[str, np.ndarray]] = {}
    for length in lengths:
        seen = prefix(arrays, length)
        poses = estimator.poses(seen)
        found[length] = scores(poses, np.asarray(seen["truth"], dtype=np.float64), world)
    evaluation = Evaluation(poses.astype(np.float32), found)
    _write(cache, identity, evaluation)
    return evaluation


def _code() -> str:
    """A hash of the modules that the estimates come from."""
    folders = [Path(folder) / name for folder in training.__path__ for name in _MADE_BY]
    folders += map(Path, ngo_estimator.__path__)
    files = [path for folder in folders for path in sorted(folder.rglob("*.py"))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


def _read(cache: Path, identity: str) -> Evaluation | None:
    if not cache.exists():
        return None
    with np.load(cache) as file:
        if str(file["identity"]) != identity:
            return None
        found: dict[int, dict[str, np.ndarray]] = {}
        for name in file.files:
            length, _, metric = name.partition(":")
            if metric:
                found.setdefault(int(length), {})[metric] = file[name]
        return Evaluation(file["poses"], found)


def _write(cache: Path, identity: str, evaluation: Evaluation) -> None:
    cache.parent.mkdir(parents=True, exist_ok=True)
    columns = {f"{length}:{name}": v for length, values in evaluation.scores.items() for name, v in values.items()}
    with written_whole(cache) as file:
        np.savez(file, identity=np.array(identity), poses=evaluation.poses, **columns)  # type: ignore[arg-type]
