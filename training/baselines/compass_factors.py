"""Compass readings for the classical pose graph: the same that our own optimizer gets."""

import numpy as np
import torch
from torch import Tensor

from ngo_estimator.optimizer.compass_closure import CompassFixes, compass_fixes


def found_fixes(
    readings: np.ndarray,
    log_scale: np.ndarray,
    relative: np.ndarray,
    log_std: np.ndarray,
    block: int,
    block_m: float,
) -> list[CompassFixes]:
    """What ``compass_fixes`` gives for each trajectory, a batch of one each.

    Args:
        readings, log_scale: of ``frames_to_read`` ``(trajectories, frames, 3)``, ``(trajectories, frames, 2)``.
        relative, log_std: the odometry ``(trajectories, steps, 3)``.
        block: steps in a meta-pose.
        block_m: side of the lattice's cells.
    """
    columns = [[_one(row) for row in array] for array in (readings, log_scale, relative, log_std)]
    return [compass_fixes(a, b, c, d, block, block_m) for a, b, c, d in zip(*columns, strict=True)]


def _one(row: np.ndarray) -> Tensor:
    return torch.from_numpy(np.array(row, dtype=np.float64)).unsqueeze(0)
