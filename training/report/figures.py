"""The figures of a world's results."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from ngo_sim.mazes import draw_maze
from training.baselines.deepvo import DEEPVO
from training.report.maze_views import in_maze, maze_and_start
from training.report.pictures import save
from training.report.training_records import learning_curve, run_folder
from training.scoring.row_estimators import Arrays
from training.scoring.scores import METRICS, Metric, in_sentence
from training.scoring.table import Measured
from training.scoring.table_rows import ROWS, Sources, rows_of

TRUTH, LOCAL_COLOR, CORRECTED = "#1f6fd6", "#2ca02c", "#ff7f0e"
COLORS = {
    "local": LOCAL_COLOR,
    "local_no_action": "#1b5e20",
    "deepvo": "#0097a7",
    "paper_1": "#c5a3d9",
    "paper_5": "#9467bd",
    "ngo_1": "#ffc38a",
    "ngo_5": CORRECTED,
    "gauss_newton": "#8c564b",
    "gtsam": "#444444",
    "registered": "#b8860b",
    "gtsam_registered": "#1a9988",
    "smoothed": "#b8860b",
    "gtsam_smoothed": "#1a9988",
    "end_to_end": "#e377c2",
}
MAIN_ROWS = (
    "local",
    "deepvo",
    "paper_5",
    "gtsam",
    "ngo_1",
    "registered",
    "gtsam_registered",
    "smoothed",
    "gtsam_smoothed",
    "ngo_5",
)
CORRECTED_ROW = "ngo_5"

Tables = dict[str, dict[str, list[Measured]]]


def draw_all(
    folder: Path, sources: Sources, split: str, stores: dict[str, Arrays], evaluations: Tables, result: dict[str, Any]
) -> dict[str, str]:
    """Write every figure into ``folder``; returns the name of each file and what it shows."""
    images: dict[str, str] = {}

    def add(kind: str, caption: str, figure: Figure | None) -> None:
        if figure is not None:
            name = f"results_{sources.world.name}_{kind}.png"
            save(figure, folder / name, dpi=130, tight=False)
            images[name] = caption

    metric = METRICS[sources.world.name][0]
    add(
        "trajectories",
        f"Trajectories with the median and the largest {in_sentence(metric.title)} of `{CORRECTED_ROW}` in each table: "
        "odometry green, corrected orange, truth blue; the first training seed.",
        trajectories(sources, split, stores, evaluations),
    )
    add(
        "error_by_frames",
        "Error against the number of frames that the estimator had seen; bands are 95 % intervals.",
        by_prefix(result, _absolute(sources.world.name), "frames", lambda _, steps: float(steps)),
    )
    add(
        "percent_by_distance",
        "Error as a ratio to the distance travelled.",
        by_prefix(
            result,
            _ratios(sources.world.name),
            "distance travelled, m",
            lambda table, steps: float(result["path_m"][table][str(steps)]),
        ),
    )
    add(
        "learning_curves",
        "Learning curves on validation: networks, and optimizers with the mean and range of the training seeds.",
        learning_curves(sources, len(result["seeds"])),
    )
    return images


def trajectories(sources: Sources, split: str, stores: dict[str, Arrays], evaluations: Tables) -> Figure:
    """For each table the trajectories with the median and the largest error of the corrected row."""
    metric = METRICS[sources.world.name][0]
    figure, panels = plt.subplots(
        len(stores), 2, figsize=(13.0, 6.8 * len(stores)), squeeze=False, layout="constrained"
    )
    for row, (table, arrays) in zip(panels, stores.items(), strict=True):
        found = evaluations[table]
        steps = arrays["truth"].shape[1]
        corrected, odometry = (found[name][0].errors[f"{steps}:{metric.key}"] for name in (CORRECTED_ROW, "local"))
        order = np.argsort(corrected)
        for axes, what, k in ((row[0], "median", int(order[len(order) // 2])), (row[1], "largest", int(order[-1]))):
            maze, start = maze_and_start(sources.world, table, split, k)
            draw_maze(axes, maze)
            for poses, color, label, width in (
                (np.asarray(arrays["truth"][k]), TRUTH, "truth", 2.4),
                (found["local"][0].drawn["poses"][k], LOCAL_COLOR, "local", 1.1),
                (found[CORRECTED_ROW][0].drawn["poses"][k], CORRECTED, f"corrected ({CORRECTED_ROW})", 1.1),
            ):
                xy = in_maze(start, poses)[:, :2]
                axes.plot(xy[:, 0], xy[:, 1], color=color, linewidth=width, label=label, alpha=0.9)
            axes.plot(*start[:2], "o", color="white", markeredgecolor="black", markersize=9, label="start", zorder=5)
            axes.set_title(
                f"{table}, {what} error of {len(order)}: local {odometry[k]:.2g}, corrected {corrected[k]:.2g}\n"
                f"({in_sentence(metric.title)}, {metric.unit})",
                fontsize=11,
            )
            axes.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    figure.legend(*panels[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _absolute(world: str) -> list[Metric]:
    """The first metric of a world that is no ratio to the path, and that of headings."""
    absolute = [one for one in METRICS[world] if "%" not in one.unit and "/" not in one.unit]
    return [absolute[0], next(one for one in absolute if one.unit == "deg")]


def _ratios(world: str) -> list[Metric]:
    """The first metric of a world in percent of the path and, where it has one, that in degrees a metre of it."""
    percent = next(one for one in METRICS[world] if "%" in one.unit)
    return [percent, *[one for one in METRICS[world] if "deg/m" in one.unit][:1]]


def by_prefix(
    result: dict[str, Any], metrics: Sequence[Metric], across: str, position: Callable[[str, int], float]
) -> Figure:
    """Metrics of the main rows over prefixes, one panel a metric and table.

    ``position`` places (table, steps) on the x axis.
    """
    tables = result["tables"]
    figure, panels = plt.subplots(
        len(metrics),
        len(tables),
        figsize=(6.6 * len(tables), 5.4 * len(metrics)),
        sharey="row",
        squeeze=False,
        layout="constrained",
    )
    for line, metric in zip(panels, metrics, strict=True):
        for axes, table in zip(line, tables, strict=True):
            _over_prefixes(axes, tables[table], metric.key, partial(position, table))
            title = f"{table}: {result['trajectories']} {result['split']} trajectories"
            axes.set(xlabel=across, title=title)
        line[0].set_ylabel(f"{metric.title}, {metric.unit}")
        line[-1].legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    return figure


def _over_prefixes(axes: Axes, rows: dict[str, Any], metric: str, position: Callable[[int], float]) -> None:
    for row in (name for name in MAIN_ROWS if name in rows):
        prefixes = rows[row]["prefixes"]
        x = [position(int(steps)) for steps in prefixes]
        values = [prefixes[steps][metric] for steps in prefixes]
        # The paper's form may lie on the odometry, so that only dashes show both.
        style = "o--" if ROWS[row].form == "paper" else "o-"
        axes.plot(x, [value["mean"] for value in values], style, color=COLORS[row], label=row, markersize=4)
        low, high = zip(*(value["ci95"] for value in values), strict=True)
        axes.fill_between(x, low, high, color=COLORS[row], alpha=0.15, linewidth=0)
    _log_scale(axes)


def learning_curves(sources: Sources, seeds: int) -> Figure | None:
    """Validation curves of the networks and the optimizers; None if no run has any."""
    folder = sources.runs / sources.world.name
    single = {
        "local network": (learning_curve(folder / "local"), {"validation_rmse_deg": "heading RMSE of a step, deg"}),
        "place encoder": (
            learning_curve(folder / "place"),
            {"validation_median_m": "median error of a pair, m", "median_m": "median error of a pair, m"},
        ),
        "DeepVO": (learning_curve(folder / DEEPVO), {"validation_rmse_deg": "heading RMSE of a step, deg"}),
    }
    optimizers = {
        row: [curve for seed in range(seeds) if (curve := learning_curve(run_folder(sources, row, seed)))]
        for row in rows_of(sources.world)
        if ROWS[row].form is not None
    }
    shown = {name: one for name, one in single.items() if any(column in one[0] for column in one[1])}
    count = len(shown) + any(optimizers.values())
    if count == 0:
        return None
    figure, panels = plt.subplots(1, count, figsize=(5.6 * count, 4.6), squeeze=False, layout="constrained")
    for axes, (name, (curve, columns)) in zip(panels[0], shown.items(), strict=False):
        column = next(column for column in columns if column in curve)
        logged = np.isfinite(curve[column])
        axes.plot(curve["epoch"][logged] + 1, curve[column][logged], ".-", color=TRUTH)
        _log_scale(axes)
        axes.set(title=name, ylabel=columns[column], xlabel="epoch")
    if any(optimizers.values()):
        _optimizer_curves(panels[0][-1], optimizers)
    return figure


def _optimizer_curves(axes: Axes, curves: dict[str, list[dict[str, np.ndarray]]]) -> None:
    odometry = None
    for row, found in curves.items():
        if not found:
            continue
        epochs = min(len(curve["epoch"]) for curve in found)
        values = np.stack([curve["corrected_m"][:epochs] for curve in found])
        x = found[0]["step"][:epochs]
        axes.plot(x, values.mean(axis=0), color=COLORS[row], label=row)
        axes.fill_between(x, values.min(axis=0), values.max(axis=0), color=COLORS[row], alpha=0.2, linewidth=0)
        odometry = float(found[0]["odometry_m"][-1])
    if odometry is not None:
        axes.axhline(odometry, color=LOCAL_COLOR, linestyle=":", label="local")
    _log_scale(axes)
    axes.set(title="optimizers", ylabel="position RMSE, m", xlabel="updates")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)


def _log_scale(axes: Axes) -> None:
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)
