"""The page about training in varied looks in Markdown, made whole from the JSON."""

from typing import Any

from training.looks_scores import METRICS, Metric
from training.results_page import interval, markdown

_MEASURED = {
    "plain": "the look of the plain training, in mazes that nothing was trained in",
    "held_out": "the same mazes and the same ways through them, clad in textures that no training had",
    "held_out_varied": "these textures, with other lights, widths of corridors and decorations: the varied training's "
    "ranges of them",
}


def page(result: dict[str, Any]) -> str:
    """The page's text."""
    arguments = result["arguments"]
    parts = [
        f"<!-- Made by `{result['command']}`; changes belong into training/looks_page.py. -->",
        "# What training in varied looks is worth in maze3d",
        f"`{result['command']}` at revision `{result['revision']}`: a local network and a place encoder, each trained "
        f"twice on as much data, once in one look (`plain`) and once in many (`varied`). Neither saw the textures "
        f"`{result['held_out_textures']}`. {arguments['mazes']} validation mazes of {arguments['frames'] - 1} steps "
        f"for the local networks, {arguments['place_groups']} groups of mazes for the place encoders. In brackets are "
        "95 % bootstrap intervals over mazes, of places over groups; differences are of the same mazes, below 0 where "
        "`varied` has the smaller number. They hold for these trainings: their own spread, with other seeds, is not "
        "part of them. Numbers in full are in "
        "[`training/results/maze3d_looks.json`](../training/results/maze3d_looks.json).",
        "## The looks",
        markdown(
            ("Looks", "Used for", "Textures", "Light", "Width of corridors, m", "Decorations"),
            (
                *(_look(name, "training", look) for name, look in result["training_looks"].items()),
                *(_look(name, "measuring", look) for name, look in result["measured_looks"].items()),
            ),
        ),
        "A look is drawn from these ranges for each group of mazes.",
    ]
    for name, table in result["tables"].items():
        parts += [f"## Measured in `{name}`", f"{_MEASURED[name][0].upper()}{_MEASURED[name][1:]}.", _table(table)]
    parts += [
        "## Trainings",
        markdown(
            ("Training", "Time, s", "Throughput, datapoints/s", "Command"),
            (
                (f"`{name}`", f"{found['seconds']:.0f}", f"{found['datapoints_per_s']:.0f}", f"`{found['command']}`")
                for name, found in result["trainings"].items()
            ),
        ),
    ]
    return "\n\n".join(parts) + "\n"


def _look(name: str, use: str, look: dict[str, Any]) -> tuple[str, ...]:
    ranges = ("light_level", "block_m", "decorations")
    return (f"`{name}`", use, ", ".join(look["textures"]), *(_range(*look[key]) for key in ranges))


def _range(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def _table(table: dict[str, Any]) -> str:
    header = ("", "Unit", "`plain`", "`varied`", "Difference", "Difference, %")
    return markdown(header, (_row(METRICS[key], entry) for key, entry in table.items()))


def _row(metric: Metric, entry: dict[str, Any]) -> tuple[str, ...]:
    paired = entry["varied_vs_plain"]
    relative = interval(paired["relative_percent"]) if "relative_percent" in paired else "-"
    title = f"{metric.title}, {'less' if metric.is_error else 'more'} is better"
    return (
        title,
        metric.unit,
        interval(entry["plain"]),
        interval(entry["varied"]),
        interval(paired["difference"]),
        relative,
    )
