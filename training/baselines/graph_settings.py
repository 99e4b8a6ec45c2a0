"""Settings of the classical pose graph: read from their file, and the calibration of its odometry."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ngo_estimator.geometry import se2
from ngo_estimator.loops.loop_closure import LoopSearch
from training.baselines.pose_graph import PoseGraphSettings

REGISTRATIONS = 5
"""Steps of each registration for the pose graph, where ranges are registered: as many as for our optimizer."""


def fit_calibration(relative: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Gain and bias of each component of a step that fit the true steps best, by least squares.

    Args:
        relative: steps ``(trajectories, steps, 3)``; truth: true poses after each of them.
    """
    true_steps = se2.g2r(torch.from_numpy(np.array(truth))).numpy()
    fits = []
    for k in range(3):
        steps = np.ravel(relative[..., k]).astype(np.float64)
        design = np.column_stack((steps, np.ones_like(steps)))
        fits.append(np.linalg.lstsq(design, np.ravel(true_steps[..., k]))[0].tolist())
    gain, bias = zip(*fits, strict=True)
    return {"odometry_gain": gain, "odometry_bias": bias}


def load_settings(path: Path) -> PoseGraphSettings:
    """The settings in a file that this script wrote; raises ``ValueError`` naming what is wrong with it."""
    try:
        values = dict(json.loads(path.read_text())["settings"])
        search = LoopSearch(**values.pop("search"))
        lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
        return PoseGraphSettings(**{**values, **lists, "search": search})
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}; expected what `python -m training.tune_pose_graph` writes") from error
