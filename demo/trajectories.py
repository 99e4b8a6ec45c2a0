"""What a run recorded as trajectories over the same frames, and how far the estimates are from the truth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from training.scoring.metrics import path_length_m, trajectory_error

Poses = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Trajectories:
    """Three trajectories, each (frames, 3) x, y, yaw (m, m, rad), of the frames at stamps_ns (frames,).

    truth is in the maze's frame. odometry and corrected start at the identity in the first frame. frames_published is
    how many frames the simulator sent: more than there are here if some were lost on the way.
    """

    stamps_ns: npt.NDArray[np.int64]
    truth: Poses
    odometry: Poses
    corrected: Poses
    frames_published: int

    def in_maze(self, estimate: Poses) -> Poses:
        """An estimate (frames, 3) placed at the first true pose."""
        x, y, yaw = self.truth[0]
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.stack(
            [
                x + cos * estimate[:, 0] - sin * estimate[:, 1],
                y + sin * estimate[:, 0] + cos * estimate[:, 1],
                np.remainder(yaw + estimate[:, 2] + np.pi, 2 * np.pi) - np.pi,
            ],
            axis=-1,
        )


def match(truth: dict[int, Poses], odometry: dict[int, Poses], corrected: dict[int, Poses]) -> Trajectories:
    """Put poses (3,) by stamp together, for the stamps of the corrected path.

    Odometry has no message for the first frame, where it is the identity by definition. Raises ValueError where a
    pose of the path is not of a frame, or has no odometry.
    """
    if not corrected:
        raise ValueError("the corrected path has no poses; expected one for each frame")
    stamps = sorted(corrected)
    odometry = {stamps[0]: np.zeros(3)} | odometry
    for name, poses in (("ground truth", truth), ("odometry", odometry)):
        if missing := [stamp for stamp in stamps if stamp not in poses]:
            raise ValueError(
                f"{len(missing)} of the corrected path's {len(stamps)} poses have no {name}, "
                f"first the one stamped {missing[0] / 1e9:.9f} s"
            )
    return Trajectories(
        stamps_ns=np.array(stamps, dtype=np.int64),
        truth=np.array([truth[stamp] for stamp in stamps]),
        odometry=np.array([odometry[stamp] for stamp in stamps]),
        corrected=np.array([corrected[stamp] for stamp in stamps]),
        frames_published=len(truth),
    )


def evaluate(world: str, seed: int, trajectories: Trajectories) -> dict[str, Any]:
    """The demo's result: errors of both estimates against the truth, both seen from their first pose, not aligned."""
    truth = trajectories.truth
    return {
        "world": world,
        "seed": seed,
        "frames": len(truth),
        "path_m": round(path_length_m(truth), 3),
        **{
            name: {key: round(value, 4) for key, value in dataclasses.asdict(trajectory_error(poses, truth)).items()}
            for name, poses in (("odometry", trajectories.odometry), ("corrected", trajectories.corrected))
        },
    }


def summarise(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Many mazes in one object: wins are mazes where the corrected path has the lower position RMSE."""
    odometry = np.array([result["odometry"]["position_rmse_m"] for result in results])
    corrected = np.array([result["corrected"]["position_rmse_m"] for result in results])
    medians = float(np.median(odometry)), float(np.median(corrected))
    return {
        "world": results[0]["world"],
        "mazes": len(results),
        "seeds": [result["seed"] for result in results],
        "frames": results[0]["frames"],
        "wins": int((corrected < odometry).sum()),
        "median_position_rmse_m": {"odometry": round(medians[0], 4), "corrected": round(medians[1], 4)},
        "reduction_of_median_percent": round(100 * (1 - medians[1] / medians[0]), 2),
        "median_reduction_percent": round(float(np.median(100 * (1 - corrected / odometry))), 2),
        "results": results,
    }
