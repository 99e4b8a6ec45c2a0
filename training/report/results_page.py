"""The page of a world's results in Markdown, made from the JSON alone."""

from collections.abc import Sequence
from typing import Any

from training.data.worlds import World
from training.report.page import figures, interval, joined, markdown, number, signed, with_interval
from training.report.page import page as whole
from training.scoring.scores import METRICS, Metric
from training.scoring.table_rows import ROWS


def page(result: dict[str, Any], images: dict[str, str], world: World) -> str:
    """The page's text; ``images`` are the names of files in ``images/`` with their captions."""
    metrics = METRICS[world.name]
    several = len(result["seeds"]) > 1
    parts = [
        f"<!-- Made by `{result['command']}`; changes belong into training/report/results_page.py. -->",
        f"# Results in {world.name}",
        f"`{result['command']}` at revision `{result['revision']}`: {result['trajectories']} trajectories of "
        f"{result['steps']} steps a table, {result['split']} split. In brackets are 95 % bootstrap intervals over "
        "trajectories. No trajectory is aligned with the truth but for its first pose. "
        + (
            f"Optimizers were trained with the seeds {joined(result['seeds'])}: their numbers are means over these, "
            "and the smallest and largest mean of a single seed stand beside them. "
            if several
            else ""
        )
        + "Numbers in full are in "
        f"[`training/results/{world.name}.json`](../training/results/{world.name}.json); what they mean is in "
        "[results.md](explanation/results.md).",
    ]
    for name, table in result["tables"].items():
        length = f"{result['path_m'][name][str(result['steps'])]:.0f} m driven on average"
        parts += [f"## Table `{name}`", f"{length}.", _table(table, metrics)]
        parts += ["### Differences on the same trajectories", _pairs(result["paired"][name], metrics[0])]
        parts += [
            f"### {metrics[0].title} ({metrics[0].unit}) after fewer steps",
            "The estimator has seen these steps alone, as in use.",
            _prefixes(table, metrics[0]),
        ]
    parts += [
        *figures(images),
        "## Trainings",
        "Time is what went into the weights; throughput and memory are of all processes together. Data are "
        "simulated while the networks train, so that throughput is of both.",
        _trainings(result["trainings"]),
    ]
    return whole(parts)


def _table(table: dict[str, Any], metrics: Sequence[Metric]) -> str:
    def cells(row: str, entry: dict[str, Any]) -> list[str]:
        texts = []
        for metric in metrics:
            value = entry[metric.key]
            seeds = value.get("seeds")
            spread = f" ({number(min(seeds))} to {number(max(seeds))})" if seeds else ""
            texts.append(interval(value) + spread)
        return [f"`{row}`", ROWS[row].title, *texts]

    header = ["Row", "", *(f"{metric.title}, {metric.unit}" for metric in metrics)]
    return markdown(header, (cells(row, entry) for row, entry in table.items()))


def _pairs(pairs: dict[str, Any], metric: Metric) -> str:
    def cells(name: str, entry: dict[str, Any]) -> list[str]:
        row, other = name.split("_vs_")
        difference, relative = entry[metric.key]["difference"], entry[metric.key]["relative_percent"]
        apart = "yes" if difference["ci95"][0] > 0 or difference["ci95"][1] < 0 else "no"
        change = with_interval(relative, signed(1)).replace(" [", " % [")
        return [f"`{row}`", f"`{other}`", change, interval(difference), apart]

    header = ["Row", "Against", f"{metric.title}, relative", f"Difference, {metric.unit}", "Interval excludes zero"]
    return markdown(header, (cells(name, entry) for name, entry in pairs.items()))


def _prefixes(table: dict[str, Any], metric: Metric) -> str:
    lengths = list(next(iter(table.values()))["prefixes"])
    rows = (
        [f"`{row}`", *(interval(entry["prefixes"][length][metric.key]) for length in lengths)]
        for row, entry in table.items()
    )
    return markdown(["Row", *(f"{length} steps" for length in lengths)], rows)


def _trainings(trainings: dict[str, Any]) -> str:
    def cells(name: str, entry: dict[str, Any]) -> list[str]:
        return [
            f"`{name}`",
            _unit(entry, "seconds", 1.0 / 60.0, "min"),
            _unit(entry, "datapoints_per_s", 1.0, "/s"),
            _unit(entry, "peak_memory_mb", 1.0 / 1024.0, "GiB"),
            f"`{entry['command']}`" if "command" in entry else "",
        ]

    header = ["Network", "Time", "Datapoints", "Peak memory", "Command"]
    return markdown(header, (cells(name, entry) for name, entry in trainings.items()))


def _unit(entry: dict[str, Any], key: str, factor: float, unit: str) -> str:
    return f"{number(factor * entry[key])} {unit}" if entry.get(key) else ""
