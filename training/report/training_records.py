"""Records and learning curves of the trainings behind the results."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from ngo_estimator.checkpoint import LOCAL, OPTIMIZER, PLACE, SMOOTHER
from ngo_estimator.data.weights_file import load_description
from training.baselines.deepvo import DEEPVO
from training.scoring.table_rows import ROWS, Sources, rows_of, trainings_of

_KEPT = ("command", "revision", "seconds", "datapoints_per_s", "peak_memory_mb", "peak_gpu_memory_mb", "processes")


def trainings_json(sources: Sources, seeds: int) -> dict[str, Any]:
    """Command, time, throughput and memory of each training, as far as the JSON beside the weights says."""
    name = sources.world.name
    result: dict[str, Any] = {}
    for kind in (LOCAL, PLACE, *((SMOOTHER,) if sources.world.smoothing else ())):
        result[kind] = _kept(load_description(sources.networks / f"{kind}.safetensors", kind, name))
    for row in rows_of(sources.world):
        for seed in range(trainings_of(row, seeds)):
            network = ROWS[row].odometry or OPTIMIZER
            own = ROWS[row].own_networks or ROWS[row].odometry is not None
            folder = sources.of_row(row, 0).networks if own else sources.row_folder(row, seed)
            result[f"{row}-seed{seed}"] = _kept(load_description(folder / f"{network}.safetensors", network, name))
    return result


def _kept(description: dict[str, Any]) -> dict[str, Any]:
    training = description.get("training")
    return {name: training[name] for name in _KEPT if name in training} if isinstance(training, dict) else {}


def run_folder(sources: Sources, row: str, seed: int) -> Path:
    """Folder of the checkpoints and logs of a row's training."""
    kind, folder = ROWS[row], sources.runs / sources.world.name
    if kind.own_networks:
        return folder / f"{row}-seed{seed}"
    if kind.odometry is not None:
        return folder / (DEEPVO if kind.odometry == DEEPVO else "local-no_action")
    return folder / f"optimizer-{kind.form}-{kind.iterations}-seed{seed}"


def learning_curve(run: Path) -> dict[str, np.ndarray]:
    """The columns ``(epochs,)`` of a run's ``metrics.csv``; none without one, NaN where nothing was logged."""
    path = run / "metrics.csv"
    if not path.exists():
        return {}
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    names = rows[0].keys() if rows else []
    return {name: np.array([float(row[name] or "nan") for row in rows]) for name in names}
