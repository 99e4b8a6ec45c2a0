"""What makes frames of the 3D world hard, and how many are hard at other corridor widths and fields of view.

    python -m training.hard_frames --mazes 24 --frames 1000

The shipped local network estimates the steps of the world's driver in validation mazes. From the true poses, rays
through the picture's columns find the walls in view, and the errors of the steps are put in bins by them. Then the
driver drives in corridors of other widths, and rays through other fields of view count the hard frames, without a
network. The last line is the result as JSON; it goes to training/results/ as well, its tables and a figure to docs/.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from ngo_estimator.checkpoint import load_local
from ngo_sim.episodes import Episode
from ngo_sim.maze3d import Maze3DConfig
from training import runs
from training.curves import write_at_once
from training.hard_frames_page import draw, page
from training.hard_steps import (
    QUANTITIES,
    bins_json,
    drive_of,
    hard_frames,
    odometry_json,
    travels_m,
    turning_json,
    turns_deg,
)
from training.statistics import mean_interval, ratio_interval
from training.validation_steps import estimated_steps, true_steps, validation_episodes
from training.wall_view import filled_depth_m, wall_view
from training.worlds import world_named

NAME = "hard_frames"
_WORLD = "maze3d"


@dataclass(frozen=True)
class Arguments:
    """What to measure."""

    mazes: int = 24
    """Validation mazes, each driven through once, of the shipped world and of each corridor width."""
    frames: int = 1000
    """Length of an episode."""
    corridors_m: tuple[float, ...] = (2.0, 3.0, 4.0, 5.0)
    """Corridor widths."""
    fields_of_view_deg: tuple[int, ...] = (60, 90, 108, 130)
    """Fields of view."""
    weights: Path = runs.WEIGHTS
    """Folder with maze3d/local_pose_network.safetensors."""
    out: Path = runs.ROOT / "training" / "results"
    """Folder that gets maze3d_hard_frames.json."""
    docs: Path = runs.ROOT / "docs"
    """Folder that gets hard_frames_maze3d.md, and images/hard_frames_maze3d.png."""

    def __post_init__(self) -> None:
        if self.mazes < 2 or self.frames < 3:
            raise ValueError(f"mazes, frames are {self.mazes}, {self.frames}; expected at least 2 and 3")
        if not self.corridors_m or not self.fields_of_view_deg:
            raise ValueError("corridors_m or fields_of_view_deg is empty; expected one of each at least")


def main(arguments: Arguments) -> dict[str, object]:
    """Measure, write JSON, page and figure, print the tables and return what the JSON holds."""
    world = world_named(_WORLD)
    network, description = load_local(arguments.weights / _WORLD, _WORLD)
    camera = Maze3DConfig()
    drives, driven = [], []
    for episode in validation_episodes(world, arguments.mazes, arguments.frames):
        drives.append(drive_of(episode, estimated_steps(network, world, episode), camera))
        driven.append(replace(episode, observations=episode.observations[:0]))
    result: dict[str, object] = {
        **json.loads(json.dumps(runs.record(NAME, arguments))),
        "network_sha256": description["sha256"],
        "mazes": arguments.mazes,
        "frames": arguments.frames,
        "corridor_m": camera.block_m,
        "field_of_view_deg": camera.field_of_view_deg,
        "bins": {one.key: bins_json(drives, one) for one in QUANTITIES},
        "turning": turning_json(drives),
        "odometry": odometry_json(drives),
        "worlds": [
            one
            for block_m in arguments.corridors_m
            for one in corridors_json(block_m, driven if block_m == world.block_m else None, arguments)
        ],
    }
    text = page(result)
    write_at_once(arguments.out / f"{_WORLD}_{NAME}.json", json.dumps(result, indent=2) + "\n")
    write_at_once(arguments.docs / f"{NAME}_{_WORLD}.md", text)
    draw(result, arguments.docs / "images" / f"{NAME}_{_WORLD}.png")
    print(text)
    print(json.dumps(result))
    return result


def corridors_json(block_m: float, driven: Iterable[Episode] | None, arguments: Arguments) -> list[dict[str, object]]:
    """The share of hard frames in each field of view along the same episodes, driven now where they are not given."""
    if driven is None:
        world = world_named(_WORLD).with_corridors(block_m)
        driven = validation_episodes(world, arguments.mazes, arguments.frames)
    cameras = [Maze3DConfig(block_m=block_m, field_of_view_deg=view) for view in arguments.fields_of_view_deg]
    counts: list[list[tuple[float, ...]]] = [[] for _ in cameras]
    turns, travels = [], []
    for episode in driven:
        assert episode.maze is not None  # worlds are mazes
        steps = true_steps(episode)
        turns.append(float(turns_deg(steps).mean()))
        travels.append(float(travels_m(steps).mean()))
        for found, camera in zip(counts, cameras, strict=True):
            view = wall_view(episode.maze, episode.poses_xyyaw, camera)
            hard = hard_frames(view, camera)
            found.append((*(float(values.sum()) for values in asdict(hard).values()), float(view.faces.sum())))
    result = []
    for camera, found in zip(cameras, counts, strict=True):
        near, any_near, near_shipped, filled, faces = np.array(found).T
        frames = np.full(len(near), float(arguments.frames))
        result.append(
            {
                "corridor_m": camera.block_m,
                "field_of_view_deg": camera.field_of_view_deg,
                "filled_depth_m": filled_depth_m(camera),
                "pixels_a_degree": camera.width / camera.field_of_view_deg,
                "near": ratio_interval(near, frames).as_json(),
                "any_near": ratio_interval(any_near, frames).as_json(),
                "near_shipped": ratio_interval(near_shipped, frames).as_json(),
                "filled": ratio_interval(filled, frames).as_json(),
                "faces": ratio_interval(faces, frames).as_json(),
                "turn_deg": mean_interval(np.array(turns)).as_json(),
                "travel_m": mean_interval(np.array(travels)).as_json(),
            }
        )
    return result


if __name__ == "__main__":
    main(tyro.cli(Arguments, description=__doc__))
