"""Errors of steps by what the pictures on both sides of them show of the walls, and by how the robot moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ngo_sim.maze3d import Maze3DConfig
from training.statistics import mean_interval, ratio_interval, rms_interval
from training.validation_steps import odometry_error, step_errors, true_steps
from training.wall_view import WallView, filled_depth_m, wall_view

if TYPE_CHECKING:
    from ngo_sim.episodes import Episode

HARD_SHARE = 0.5
"""A frame is hard where walls that are near take at least this share of its columns."""


@dataclass(frozen=True)
class Quantity:
    """Something that may make steps hard, a field of ``Drive``, and the borders of its bins."""

    key: str
    title: str
    edges: tuple[float, ...]


QUANTITIES = (
    Quantity("nearest_m", "Nearest wall in the picture, m", (0.0, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, math.inf)),
    Quantity(
        "near_share",
        "Share of columns whose wall is nearer than half a corridor",
        (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, math.inf),
    ),
    Quantity(
        "filled_share",
        "Share of columns that a wall fills, without floor or ceiling",
        (0.0, 0.01, 0.25, 0.5, 0.75, 0.99, math.inf),
    ),
    Quantity("faces", "Sides of blocks in view", (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, math.inf)),
    Quantity("turn_deg", "Turn of the step, deg", (0.0, 1.0, 3.0, 5.0, 7.0, math.inf)),
    Quantity("travel_m", "Length of the step, m", (0.0, 0.05, 0.15, 0.25, 0.35, math.inf)),
)


@dataclass(frozen=True)
class HardFrames:
    """Which frames ``(frames,)`` are hard, by several measures.

    ``near``: at least ``HARD_SHARE`` of the columns show walls nearer than half of this corridor; ``any_near``: one
    column does; ``near_shipped``: as ``near``, with half of the shipped corridor; ``filled``: as many columns are
    filled by their walls.
    """

    near: np.ndarray
    any_near: np.ndarray
    near_shipped: np.ndarray
    filled: np.ndarray


@dataclass(frozen=True)
class Drive:
    """The steps of an episode: of the two pictures of each, what the harder one shows of the walls.

    ``nearest_m``, ``near_share``, ``filled_share``, ``faces``, ``turn_deg``, ``travel_m`` ``(steps,)`` as in
    ``QUANTITIES``; ``estimated`` and ``true`` ``(steps, 3)``.
    """

    nearest_m: np.ndarray
    near_share: np.ndarray
    filled_share: np.ndarray
    faces: np.ndarray
    turn_deg: np.ndarray
    travel_m: np.ndarray
    estimated: np.ndarray
    true: np.ndarray

    @property
    def hard(self) -> np.ndarray:
        """``(steps,)`` whether one of the two frames is hard."""
        return self.near_share >= HARD_SHARE

    @property
    def squared(self) -> np.ndarray:
        """``(steps, 2)`` squared errors, m^2 and deg^2."""
        return np.square(step_errors(self.estimated, self.true))


def hard_frames(view: WallView, camera: Maze3DConfig) -> HardFrames:
    """Which frames of a view are hard, by each of the measures."""
    near = near_share(view, camera.block_m)
    return HardFrames(
        near=near >= HARD_SHARE,
        any_near=near > 0.0,
        near_shipped=near_share(view, Maze3DConfig.block_m) >= HARD_SHARE,
        filled=filled_share(view, camera) >= HARD_SHARE,
    )


def near_share(view: WallView, corridor_m: float) -> np.ndarray:
    """``(frames,)`` share of the columns whose wall is nearer than half of a corridor."""
    share: np.ndarray = (view.distance_m < corridor_m / 2.0).mean(axis=1)
    return share


def filled_share(view: WallView, camera: Maze3DConfig) -> np.ndarray:
    """``(frames,)`` share of the columns that a wall fills, without floor or ceiling."""
    share: np.ndarray = (view.depth_m < filled_depth_m(camera)).mean(axis=1)
    return share


def drive_of(episode: Episode, estimated: np.ndarray, camera: Maze3DConfig) -> Drive:
    """The steps of an episode seen by a camera, with estimates ``(steps, 3)``."""
    assert episode.maze is not None  # worlds are mazes
    view, true = wall_view(episode.maze, episode.poses_xyyaw, camera), true_steps(episode)
    near, filled = near_share(view, camera.block_m), filled_share(view, camera)
    nearest = view.distance_m.min(axis=1)
    return Drive(
        nearest_m=np.minimum(nearest[:-1], nearest[1:]),
        near_share=np.maximum(near[:-1], near[1:]),
        filled_share=np.maximum(filled[:-1], filled[1:]),
        faces=np.minimum(view.faces[:-1], view.faces[1:]),
        turn_deg=turns_deg(true),
        travel_m=travels_m(true),
        estimated=estimated,
        true=true,
    )


def turns_deg(steps: np.ndarray) -> np.ndarray:
    """``(steps,)`` how far steps ``(steps, 3)`` turn, to either side."""
    return np.abs(np.degrees(steps[:, 2]))


def travels_m(steps: np.ndarray) -> np.ndarray:
    """``(steps,)`` how long steps ``(steps, 3)`` are."""
    return np.hypot(steps[:, 0], steps[:, 1])


def bins_json(drives: Sequence[Drive], quantity: Quantity) -> list[dict[str, Any]]:
    """For each bin of a quantity the steps in it, their errors, and their shares of the sum of all squared errors."""
    result = []
    for low, high in zip(quantity.edges[:-1], quantity.edges[1:], strict=True):
        chosen = [(low <= (value := getattr(drive, quantity.key))) & (value < high) for drive in drives]
        entry = {"from": low, "to": None if math.isinf(high) else high}
        result.append({**entry, **steps_json(drives, chosen)})
    return result


def turning_json(drives: Sequence[Drive]) -> list[dict[str, Any]]:
    """Errors of hard steps and of others by how fast the robot turns: walls are near where it turns."""
    edges = next(one.edges for one in QUANTITIES if one.key == "turn_deg")
    result = []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        turning = [(low <= drive.turn_deg) & (drive.turn_deg < high) for drive in drives]
        hard = [turn & drive.hard for turn, drive in zip(turning, drives, strict=True)]
        others = [turn & ~drive.hard for turn, drive in zip(turning, drives, strict=True)]
        entry = {"from": low, "to": None if math.isinf(high) else high}
        result.append({**entry, "hard": steps_json(drives, hard), "others": steps_json(drives, others)})
    return result


def steps_json(drives: Sequence[Drive], chosen: Sequence[np.ndarray]) -> dict[str, Any]:
    """``{steps, share, rmse_m, rmse_deg, squared_share_m, squared_share_deg}`` of chosen steps, errors None of none."""
    counts = np.array([mask.sum() for mask in chosen], dtype=np.float64)
    all_counts = np.array([len(drive.true) for drive in drives], dtype=np.float64)
    totals = np.array([drive.squared[mask].sum(axis=0) for drive, mask in zip(drives, chosen, strict=True)])
    all_totals = np.array([drive.squared.sum(axis=0) for drive in drives])
    entry: dict[str, Any] = {"steps": int(counts.sum()), "share": ratio_interval(counts, all_counts).as_json()}
    for column, unit in enumerate(("m", "deg")):
        entry[f"rmse_{unit}"] = rms_interval(totals[:, column], counts).as_json() if counts.any() else None
        whole = all_totals[:, column]
        entry[f"squared_share_{unit}"] = ratio_interval(totals[:, column], whole).as_json() if whole.any() else None
    return entry


def odometry_json(drives: Sequence[Drive]) -> dict[str, Any]:
    """Final error (%) and heading RMSE (deg) of the odometry, with its hard steps true, and as many others true."""
    rng = np.random.default_rng(0)
    rows: dict[str, list[Any]] = {"estimated": [], "hard_true": [], "others_true": []}
    for drive in drives:
        others = np.flatnonzero(~drive.hard)
        instead = np.zeros(len(drive.true), dtype=bool)
        instead[rng.permutation(others)[: int(drive.hard.sum())]] = True
        for name, mask in (("estimated", np.zeros_like(instead)), ("hard_true", drive.hard), ("others_true", instead)):
            rows[name].append(odometry_error(np.where(mask[:, None], drive.true, drive.estimated), drive.true))
    return {
        name: {
            key: mean_interval(np.array([getattr(error, key) for error in found])).as_json()
            for key in ("final_percent", "heading_rmse_deg")
        }
        for name, found in rows.items()
    }
