"""A picture of the attention of one meta-pose, over the maze and over time, with its loops."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ngo_estimator.checkpoint import load_optimizer, load_place
from ngo_estimator.ngo.pose_aggregation import PoseAggregationConfig
from ngo_sim.mazes import draw_maze
from training.report.attention import ROWS, Attention, attention_of, revisits
from training.report.maze_views import in_maze, maze_and_start
from training.scoring.row_estimators import Arrays
from training.scoring.table_rows import Sources

_COLORS = "plasma_r"
_LOOP, _REVISIT, _QUERY = "#1f9e4a", "#a8c8f0", "#00b5d8"


def draw(sources: Sources, split: str, stores: dict[str, Arrays]) -> Figure | None:
    """The attention of one meta-pose of one trajectory in each table, one column an optimizer.

    The trajectory is the first one of the table that comes back to a place (None if no table has one); the meta-pose
    is, of its second half, the one with the most revisits.
    """
    shown = {table: k for table, arrays in stores.items() if (k := _first_with_revisits(arrays, sources)) is not None}
    if not shown:
        return None
    pair_head = load_place(sources.networks, sources.world.name)[0].pair_head
    figure, panels = plt.subplots(
        2 * len(shown),
        len(ROWS),
        figsize=(7.2 * len(ROWS), 8.2 * len(shown)),
        height_ratios=[3.4, 1.0] * len(shown),
        squeeze=False,
        layout="constrained",
    )
    for column, row in enumerate(ROWS):
        optimizer, _ = load_optimizer(sources.row_folder(row, 0), sources.world.name)
        for number, (table, k) in enumerate(shown.items()):
            one = {name: array[k : k + 1] for name, array in stores[table].items()}
            attention = next(attention_of(optimizer, pair_head, one, sources.world))
            maze, start = maze_and_start(sources.world, table, split, k)
            poses = in_maze(start, one["truth"][0])
            above, below = panels[2 * number, column], panels[2 * number + 1, column]
            draw_maze(above, maze)
            query = _query(attention)
            _over_maze(figure, above, attention, query, poses, optimizer.block)
            _over_time(below, attention, query, optimizer.block)
            mass, share = attention.revisit_mass[-1], attention.uniform_share
            above.set_title(
                f"{row}, {table}: last iteration; of all attention {100 * mass:.1f} % is on revisits "
                f"(uniform: {100 * share:.1f} %)",
                fontsize=10,
            )
    return figure


def _first_with_revisits(arrays: Arrays, sources: Sources) -> int | None:
    block = PoseAggregationConfig(1).block
    found = (k for k, truth in enumerate(arrays["truth"]) if revisits(truth[block - 1 :: block], sources.world).any())
    return next(found, None)


def _query(attention: Attention) -> int:
    half = len(attention.revisits) // 2
    return half + int(attention.revisits[half:].sum(axis=1).argmax())


def _relative(attention: Attention, query: int) -> np.ndarray:
    """Attention of a meta-pose ``(poses,)``; one: as much as if it looked everywhere alike."""
    weights = attention.weights[-1, query]
    return np.asarray(weights * len(weights))


def _over_maze(figure: Figure, axes: Axes, attention: Attention, query: int, path: np.ndarray, block: int) -> None:
    """Dots at the ends of the meta-steps; ``path`` ``(steps + 1, 3)`` are the true poses in the maze."""
    relative, meta = _relative(attention, query), path[block::block]
    order = np.argsort(relative)
    axes.plot(path[:, 0], path[:, 1], color="#b5b5b5", linewidth=0.8, zorder=2)
    dots = axes.scatter(
        meta[order, 0],
        meta[order, 1],
        s=np.clip(18.0 * relative[order], 3.0, 250.0),
        c=relative[order],
        cmap=_COLORS,
        vmin=0.0,
        vmax=max(2.0, relative.max()),
        zorder=3,
        edgecolors="none",
        alpha=0.8,
    )
    axes.plot(*meta[query, :2], "*", color=_QUERY, markeredgecolor="black", markersize=15, zorder=5)
    axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    figure.colorbar(dots, ax=axes, shrink=0.8, label="attention relative to uniform")


def _over_time(axes: Axes, attention: Attention, query: int, block: int) -> None:
    """The same attention over the frames of the trajectory, with revisits and with the loops of the meta-pose."""
    relative = _relative(attention, query)
    frames = block * np.arange(1, len(relative) + 1)
    for k in np.flatnonzero(attention.revisits[query]):
        label = "revisit" if k == np.flatnonzero(attention.revisits[query])[0] else None
        axes.axvspan(frames[k] - block, frames[k], color=_REVISIT, linewidth=0, label=label)
    axes.plot(frames, relative, color="#7a1fa2", linewidth=1.0, label="attention / uniform")
    axes.axvline(frames[query], color=_QUERY, linewidth=2.0, label="the meta-pose")
    axes.set(xlabel="frame", ylabel="attention / uniform", xlim=(0, frames[-1]))
    axes.set_ylim(0.0, max(2.0, 1.1 * relative.max()))
    loops, gates = attention.result.loops, attention.result.loop_weights
    if loops is not None and gates is not None:
        chosen = (loops.end[0] == query) & loops.valid[0]
        beside = axes.twinx()
        beside.plot(loops.frame[0][chosen].numpy() + 1, gates[0][chosen].numpy(), "v", color=_LOOP, markersize=7)
        beside.set_ylim(0.0, 1.1)
        beside.set_ylabel("gate of its loops", color=_LOOP)
        axes.plot([], [], "v", color=_LOOP, label="loop, at its gate")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 1.28), ncols=4, frameon=False, fontsize=8)
