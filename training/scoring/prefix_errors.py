"""The errors of an estimator on whole trajectories and on prefixes of them."""

from collections.abc import Sequence

import numpy as np

from training.data.worlds import World
from training.scoring.row_estimators import Arrays, Estimator, prefix
from training.scoring.scores import scores
from training.scoring.table import Measured


def prefix_errors(estimator: Estimator, arrays: Arrays, prefixes: Sequence[int], world: World) -> Measured:
    """Run an estimator over whole trajectories ``(trajectories, steps, ...)`` and over prefixes of so many steps.

    Errors ``STEPS:METRIC`` ``(trajectories,)``, the estimator having seen these steps alone, as in use. Drawn are the
    ``poses`` ``(trajectories, steps, 3)`` of whole trajectories, float32.
    """
    steps = arrays["relative"].shape[1]
    lengths = sorted({*prefixes, steps})
    if lengths[0] < 1 or lengths[-1] > steps:
        raise ValueError(f"prefixes are {list(prefixes)}; expected 1 to {steps}, the steps of a trajectory")
    errors: dict[str, np.ndarray] = {}
    for length in lengths:
        seen = prefix(arrays, length)
        poses = estimator.poses(seen)
        found = scores(poses, np.asarray(seen["truth"], dtype=np.float64), world)
        errors |= {f"{length}:{key}": values for key, values in found.items()}
    return Measured(errors, {"poses": poses.astype(np.float32)})


def stacked(row: Sequence[Measured], steps: int, metric: str) -> np.ndarray:
    """A metric of a row, one measurement for each of its seeds, ``(seeds, trajectories)`` after so many steps."""
    return np.stack([measured.errors[f"{steps}:{metric}"] for measured in row])
