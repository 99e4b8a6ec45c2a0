"""A small store of features, of a robot whose truth and odometry are known."""

from pathlib import Path

import numpy as np
import torch

from ngo_estimator.geometry import se2

SHAPES = {"relative": 3, "log_std": 3, "motion": 6, "codes": 12, "origin_code": 12, "truth": 3}


def write_store(folder: Path) -> None:
    """Ten trajectories of 40 steps, of a robot that turns round and round, and an odometry that turns too little."""
    rng = np.random.default_rng(0)
    truth_steps = torch.tensor([0.1, 0.0, 0.3], dtype=torch.float64).expand(10, 40, 3)
    truth = se2.r2g(truth_steps)
    truth[..., 2] = se2.wrap(truth[..., 2])
    arrays = {name: rng.random((10, 40, size)).astype(np.float16) for name, size in SHAPES.items()}
    arrays["relative"] = (truth_steps - torch.tensor([0.0, 0.0, 0.01])).numpy().astype(np.float32)
    arrays["truth"] = truth.numpy()
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    (folder / "done.0of2.json").write_text("[0]")
    (folder / "done.1of2.json").write_text("[8]")
