"""A figure of the levels that ``world:=doom`` learns from: their plans, and what a robot sees there."""

import re
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from ngo_sim.doom_map import UNITS_PER_M
from ngo_sim.episodes import record_episode
from ngo_sim.maze3d import Maze3D, Maze3DConfig
from ngo_sim.mazes import draw_maze
from ngo_sim.rooms_level import rooms_textmap
from training.report.pictures import panels, save

_LEVELS = {
    **{f"rooms, seed {seed}": (Maze3DConfig(level="rooms", width=160, height=120), seed) for seed in (7, 8, 11, 12)},
    "freedoom2, MAP01": (Maze3DConfig(wad="freedoom2.wad", map="MAP01", width=160, height=120), 7),
    "maze, seed 7": (Maze3DConfig(width=160, height=120), 7),
}
_FRAMES = (0, 150, 300, 450, 599)


def draw_levels(path: Path) -> None:
    """Draw each kind of level: its plan with a drive, where there is one, and pictures of the drive."""
    figure, axes = panels(len(_LEVELS) * (1 + len(_FRAMES)), 1 + len(_FRAMES), 3.0, 2.4)
    for title, (config, seed) in _LEVELS.items():
        env, plan = Maze3D(config), next(axes)
        drive = record_episode(env, env.default_driver, _FRAMES[-1] + 1, seed)
        env.close()
        if drive.maze is not None:
            draw_maze(plan, drive.maze)
        elif config.level == "rooms":
            draw_plan(plan, rooms_textmap(*(np.random.default_rng(_sequence(seed, stream)) for stream in (7, 4))))
        plan.plot(*drive.poses_xyyaw[:, :2].T, color="tab:blue", linewidth=0.8)
        plan.set_title(title, fontsize=9)
        plan.set_aspect("equal")
        plan.axis("off")
        for frame, axis in zip(_FRAMES, axes, strict=False):
            axis.imshow(drive.observations[frame])
            axis.axis("off")
    save(figure, path, dpi=50)


def draw_plan(axes: Axes, text: str) -> None:
    """Draw the lines of UDMF text, m: walls black, steps grey, doors red."""
    vertices = np.array(re.findall(r"^vertex\{x=([-\d.]+);y=([-\d.]+)", text, re.MULTILINE), dtype=float) / UNITS_PER_M
    for first, last, rest in re.findall(r"^linedef\{v1=(\d+);v2=(\d+);(.*)\}$", text, re.MULTILINE):
        colour = "black" if "twosided" not in rest else "tab:red" if "special" in rest else "0.7"
        axes.plot(*vertices[[int(first), int(last)]].T, color=colour, linewidth=0.8)


def _sequence(seed: int, stream: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(stream,))
