"""The page and the figure of what makes frames of the 3D world hard, made whole from the JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from training.hard_steps import HARD_SHARE, QUANTITIES
from training.results_page import interval, markdown, number

_ODOMETRY = {
    "estimated": "every step as estimated",
    "hard_true": "hard steps true",
    "others_true": "as many other steps true, drawn at random",
}


def page(result: dict[str, Any]) -> str:
    """The page's text."""
    corridor, view = result["corridor_m"], result["field_of_view_deg"]
    parts = [
        f"<!-- Made by `{result['command']}`; changes belong into training/hard_frames_page.py. -->",
        "# Hard frames of maze3d",
        f"`{result['command']}` at revision `{result['revision']}`: {result['mazes']} validation mazes of "
        f"{result['frames']} frames each, driven by the planner. In brackets are 95 % bootstrap intervals over mazes. "
        "Walls in view are found by rays from the true pose through each column of the picture. Numbers in full are in "
        "[`training/results/maze3d_hard_frames.json`](../training/results/maze3d_hard_frames.json); what they mean is "
        "in [results.md](results.md#hard-frames-of-the-3d-world).",
        f"## Errors of steps in the shipped world: corridors of {corridor:g} m, {view} degrees",
        "Of the two pictures of a step the harder one counts. RMSE is that of single steps; shares of squared errors "
        "say how much of all error lies in a bin.",
    ]
    for one in QUANTITIES:
        header = [one.title, *_COLUMNS]
        rows = [[_range(entry), *_cells(entry)] for entry in result["bins"][one.key] if entry["steps"]]
        parts.append(markdown(header, rows))
    parts += [
        "### Near walls and turns apart",
        f"Hard: walls nearer than half a corridor in at least {HARD_SHARE:.0%} of the columns.",
        markdown(
            ["Turn of the step, deg", "Hard steps", "m", "deg", "Other steps", "m", "deg"],
            [[_range(entry), *_errors(entry["hard"]), *_errors(entry["others"])] for entry in result["turning"]],
        ),
        "### What hard steps do to the odometry",
        markdown(
            ["Odometry", "Final error, % of the path", "Heading RMSE, deg"],
            [
                [_ODOMETRY[name], interval(entry["final_percent"]), interval(entry["heading_rmse_deg"])]
                for name, entry in result["odometry"].items()
            ],
        ),
        "## Hard frames at other corridor widths and fields of view",
        f"Frames in which at least {HARD_SHARE:.0%} of the columns show a wall nearer than half of that corridor (and "
        "frames in which any column does); nearer "
        f"than {corridor / 2:g} m in any; or so near that it fills the column from top to bottom, for which it has to "
        "be nearer than the depth in the next column. The driver's way is the same in every field of view.",
        markdown(
            ["Corridor, m", "Field of view, deg", "Under half the corridor, %", "Anywhere, %",
             f"Under {corridor / 2:g} m, %", "Filled, %", "Filled under, m",
             "Pixels a degree", "Sides in view", "Turn a step, deg"],
            [_world(entry) for entry in result["worlds"]],
        ),
        "![Error of a step by the nearest wall, and hard frames by corridor and field of view]"
        "(images/hard_frames_maze3d.png)",
    ]  # fmt: skip
    return "\n\n".join(parts) + "\n"


def draw(result: dict[str, Any], path: Path) -> None:
    """Errors by the share of near columns, and hard frames over corridor widths, as a picture."""
    figure, (errors, counts) = plt.subplots(1, 2, figsize=(12.0, 4.4), layout="constrained")
    bins = [entry for entry in result["bins"]["near_share"] if entry["steps"]]
    places = range(len(bins))
    degrees = errors.twinx()
    for axes, unit, color, shift in ((errors, "m", "#1f6fd6", -0.08), (degrees, "deg", "#ff7f0e", 0.08)):
        means = [entry[f"rmse_{unit}"]["mean"] for entry in bins]
        low, high = zip(*(entry[f"rmse_{unit}"]["ci95"] for entry in bins), strict=True)
        bars = [[m - a for m, a in zip(means, low, strict=True)], [b - m for m, b in zip(means, high, strict=True)]]
        axes.errorbar([place + shift for place in places], means, bars, fmt="o-", color=color, capsize=3)
        axes.set_ylabel(f"RMSE of a step, {unit}", color=color)
        axes.set_ylim(bottom=0.0)
    errors.set_xticks(places, [f"{_range(entry)}\n{entry['share']['mean']:.1%}" for entry in bins], fontsize=8)
    errors.set_xlabel("share of columns nearer than half a corridor, and share of the steps")
    errors.set_title(f"corridors of {result['corridor_m']:g} m, {result['field_of_view_deg']} degrees")
    for view in sorted({entry["field_of_view_deg"] for entry in result["worlds"]}):
        chosen = [entry for entry in result["worlds"] if entry["field_of_view_deg"] == view]
        widths = [entry["corridor_m"] for entry in chosen]
        for key, style in (("near_shipped", "o-"), ("filled", "s--")):
            label = f"{view} deg" if key == "near_shipped" else None
            values = [100.0 * entry[key]["mean"] for entry in chosen]
            counts.plot(widths, values, style, color=plt.get_cmap("viridis")((view - 50) / 90), label=label)
    counts.set(xlabel="corridor, m", ylabel="hard frames, %")
    counts.set_title(f"solid: walls under {result['corridor_m'] / 2:g} m; dashed: columns filled", fontsize=10)
    counts.set_ylim(bottom=0.0)
    counts.grid(alpha=0.3)
    counts.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


_COLUMNS = ("Steps", "Share, %", "RMSE, m", "RMSE, deg", "Of squared m, %", "Of squared deg, %")


def _cells(entry: dict[str, Any]) -> list[str]:
    shares = (entry["share"], entry["squared_share_m"], entry["squared_share_deg"])
    share, metres, degrees = (number(100.0 * one["mean"]) if one else "" for one in shares)
    return [f"{entry['steps']}", share, interval(entry["rmse_m"]), interval(entry["rmse_deg"]), metres, degrees]


def _errors(entry: dict[str, Any]) -> list[str]:
    errors = [interval(entry[key]) if entry[key] else "" for key in ("rmse_m", "rmse_deg")]
    return [f"{entry['steps']}", *errors]


def _world(entry: dict[str, Any]) -> list[str]:
    return [
        f"{entry['corridor_m']:g}",
        f"{entry['field_of_view_deg']}",
        *(_percent(entry[key]) for key in ("near", "any_near", "near_shipped", "filled")),
        number(entry["filled_depth_m"]),
        number(entry["pixels_a_degree"]),
        number(entry["faces"]["mean"]),
        number(entry["turn_deg"]["mean"]),
    ]


def _percent(entry: dict[str, Any]) -> str:
    low, high = entry["ci95"]
    return interval({"mean": 100.0 * entry["mean"], "ci95": [100.0 * low, 100.0 * high]})


def _range(entry: dict[str, Any]) -> str:
    return f"from {entry['from']:g}" if entry["to"] is None else f"{entry['from']:g} to {entry['to']:g}"
