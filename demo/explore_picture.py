"""The picture of an exploration: the true map with the way, the map half way and at the end, the share seen by time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from geometry_msgs.msg import PoseStamped
from matplotlib.transforms import Affine2D
from nav_msgs.msg import Path as RosPath
from visualization_msgs.msg import MarkerArray

from ngo_estimator.mapping.occupancy_grid import OccupancyMap

UNDER_WAY = 0.5  # share seen at which the map is kept for the picture
_UNKNOWN_GREY = 0.75
_ORANGE = "#e07b00"

Grid = tuple[np.ndarray, float, np.ndarray]
"""Values of a map, its resolution (m) and its lower left corner."""


@dataclass(frozen=True, eq=False)
class UnderWay:
    """A map while the robot explores: frontiers ``(n, 2)`` by colour, goal ``(2,)`` and path ``(n, 2)``."""

    grid: Grid
    frontiers: list[tuple[tuple[float, float, float], np.ndarray]]
    goal: np.ndarray
    path: np.ndarray


@dataclass(frozen=True, eq=False)
class Pictured:
    """What is drawn: true poses ``(n, 3)``, the map found from the first of them on, and rows of time, path, share."""

    result: dict[str, Any]
    whole: OccupancyMap
    truth: np.ndarray
    grid: Grid
    under_way: UnderWay | None
    rows: np.ndarray


def draw(path: Path, seen: Pictured) -> None:
    """Draw all into a file."""
    figure, ((true, found), (half, curve)) = plt.subplots(2, 2, figsize=(15.0, 12.0))
    truth, whole, result = seen.truth, seen.whole, seen.result
    _show_map(true, (whole.values, whole.resolution_m, whole.origin_xy))
    true.plot(truth[:, 0], truth[:, 1], color="#1f6fd6", linewidth=1.0)
    true.plot(*truth[0, :2], "o", color="black")
    true.set_title("what can be seen, and the way of the robot")
    limits = {"xlim": true.get_xlim(), "ylim": true.get_ylim()}
    _show_map(found, seen.grid, truth[0])
    found.set(**limits, title="the map that it made, laid on its first true pose")
    if seen.under_way is not None:
        _show_map(half, seen.under_way.grid, truth[0])
        _show_plan(half, seen.under_way, truth[0])
        title = f"{100 * UNDER_WAY:.0f} % seen: frontiers (blue, the goal's green), goal and planned path"
        half.set(**limits, title=title)
    times, _, share = seen.rows.T
    curve.plot(times - times[0], 100.0 * share)
    curve.axhline(95.0, color="0.7", linewidth=0.8)
    curve.set(xlabel="simulated time [s]", ylabel="seen of what can be seen [%]", ylim=(0.0, 101.0))
    title = f"building, seed {result['seed']}: {100 * result['coverage']:.1f} % seen on {result['path_m']:.0f} m"
    figure.suptitle(f"{title} in {result['time_s']:.0f} s; {result['ended']}")
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def in_frame_of(points: np.ndarray, pose_xyyaw: np.ndarray) -> np.ndarray:
    """Points ``(n, 2)`` as a robot at a pose sees them."""
    cos, sin = np.cos(pose_xyyaw[2]), np.sin(pose_xyyaw[2])
    away = points - pose_xyyaw[:2]
    return np.stack((cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]), axis=1)


def in_frame_above(points: np.ndarray, pose_xyyaw: np.ndarray) -> np.ndarray:
    """Points ``(n, 2)`` that a robot at a pose sees, in the frame of the pose."""
    cos, sin = np.cos(pose_xyyaw[2]), np.sin(pose_xyyaw[2])
    return pose_xyyaw[:2] + points @ np.array(((cos, sin), (-sin, cos)))


def under_way(grid: Grid, told: dict[type, Any]) -> UnderWay:
    """What the picture needs of the newest messages."""
    frontiers = []
    for marker in told[MarkerArray].markers:
        color = marker.color.r, marker.color.g, marker.color.b
        if marker.points:
            frontiers.append((color, np.array([(point.x, point.y) for point in marker.points])))
    at = told[PoseStamped].pose.position
    path = [(placed.pose.position.x, placed.pose.position.y) for placed in told[RosPath].poses]
    return UnderWay(grid, frontiers, np.array((at.x, at.y)), np.array(path).reshape(-1, 2))


def _show_plan(axes: Any, plan: UnderWay, first_xyyaw: np.ndarray) -> None:
    """Draw frontiers, goal and path of a map that begins at a true pose."""
    for color, points in plan.frontiers:
        axes.plot(*in_frame_above(points, first_xyyaw).T, ".", color=color, markersize=2.5)
    axes.plot(*in_frame_above(plan.path, first_xyyaw).T, color=_ORANGE, linewidth=1.5)
    axes.plot(*in_frame_above(plan.goal[None], first_xyyaw).T, "*", color=_ORANGE, markersize=11)


def _show_map(axes: Any, grid: Grid, first_xyyaw: np.ndarray | None = None) -> None:
    """Draw a map, turned and moved to where its first pose truly is."""
    values, resolution, corner = grid
    first = np.zeros(3) if first_xyyaw is None else first_xyyaw
    shown = np.select([values == 0, values == 100], [1.0, 0.0], _UNKNOWN_GREY)
    left, bottom = corner
    extent = (left, left + values.shape[1] * resolution, bottom, bottom + values.shape[0] * resolution)
    image = axes.imshow(shown, "gray", origin="lower", vmin=0.0, vmax=1.0, extent=extent, interpolation="nearest")
    image.set_transform(Affine2D().rotate(first[2]).translate(*first[:2]) + axes.transData)
    known = in_frame_above(corner + (np.argwhere(values != -1)[:, ::-1] + 0.5) * resolution, first)
    low, high = known.min(axis=0) - 0.5, known.max(axis=0) + 0.5
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set_facecolor(str(_UNKNOWN_GREY))
