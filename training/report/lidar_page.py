"""The page of the lidar's results in Markdown, made whole from the JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

from training.scoring.lidar_bars import NETWORKS_POSITION_M

_TITLES = {
    "wheels": "wheels",
    "ours": "**ours**",
    "ours_without_wheels": "**ours, without wheels**",
    "gtsam_lm": "GTSAM, LM with Cauchy, on our steps and loops",
    "gtsam_gnc": "GTSAM, GNC, on our steps and loops",
    "kiss_icp": "KISS-ICP, z = 0",
    "icp_slam": "MRPT `icp-slam`",
    "rbpf_slam": "MRPT `rbpf-slam`",
    "cartographer_published": "Cartographer, as published (Hess et al. 2016), not run here",
}


def page(result: Mapping[str, Any], images: Mapping[str, str]) -> str:
    """The page's text; ``images`` are the names of files in ``images/`` with their captions."""
    settings, logs = result["settings"], result["logs"]
    with_relations = {name: rows for name, rows in logs.items() if "translation_m" in rows.get("ours", {})}
    with_mapper = {name: rows for name, rows in logs.items() if name not in with_relations}
    parts = [
        "<!-- Made by `python -m training.results --world scan`; changes belong into report/lidar_page.py. -->",
        "# Results of the lidar",
        f"`{result['command']}` at revision `{result['revision']}`. In brackets are 95 % bootstrap intervals: over the "
        "relations of a log, over the drives of a table. A number of one whole log has none. Odometry is what the "
        "correction was given: our front end's. Online is each pose as it was published. Speed is by computing time on "
        "one thread. Numbers in full are in [`training/results/scan.json`](../training/results/scan.json).",
        "## Bars",
        _bars(result["bars"]),
    ]
    if with_relations:
        parts += [
            "## Logs with relations",
            "Mean errors over relative poses that people checked (Kuemmerle et al. 2009). Far relations span more than "
            "30 s: there loops show.",
        ]
        for name, rows in with_relations.items():
            parts += [f"### {name}", _table(rows, _RELATION_COLUMNS)]
    if with_mapper:
        parts += [
            "## Logs with a mapper's poses",
            "ATE (m) after the best rigid alignment, against the poses of GMapping. They are good to some centimetres "
            "and not the truth.",
            _across(with_mapper, "ate_m"),
            "As published online:",
            _across(with_mapper, "online_ate_m"),
        ]
    for name, title in (("buildings", "Simulated buildings"), ("aliased", "Buildings whose rooms repeat")):
        parts += [
            f"## {title}",
            f"Up to {settings['buildings']} buildings that nothing was trained or chosen on, {settings['length_m']:g} "
            "m each or 20,000 scans, with drawn scanners and wheels. Rows of fewer drives have some of them.",
            _table(result["tables"][name], _BUILDING_COLUMNS),
            _against_ours(result["paired"][name]),
        ]
    parts += [
        "## Mazes, scanners of many qualities",
        f"Up to {settings['mazes']} validation mazes, {settings['frames']} scans each, no wheels; mean position RMSE "
        "(m), aligned at the first pose alone. The last column is the networks of version 0.1.0 on 8 mazes of 2000 "
        "scans.",
        _scanners(result),
        "`maze2d`, the simulator's own scanner:",
        _table(result["tables"]["maze2d"], _BUILDING_COLUMNS),
    ]
    if images:
        parts += ["## Figures", *(f"![{caption}](images/{name})\n\n{caption}" for name, caption in images.items())]
    for title, lines in (("Skipped", result["skipped"]), ("Failed", result["failed"])):
        if lines:
            parts += [f"## {title}", "\n".join(f"- {line}" for line in lines)]
    return "\n\n".join(parts) + "\n"


_RELATION_COLUMNS = {
    "translation_m": "m",
    "rotation_deg": "deg",
    "far_m": "far, m",
    "far_deg": "far, deg",
    "online_translation_m": "online, m",
    "online_far_m": "online far, m",
    "odometry_translation_m": "odometry, m",
    "scans_per_s": "scans/s",
}
_BUILDING_COLUMNS = {
    "ate_m": "ATE, m",
    "position_rmse_m": "first pose aligned, m",
    "heading_rmse_deg": "deg",
    "online_ate_m": "online ATE, m",
    "odometry_ate_m": "odometry ATE, m",
    "within_three_deviations": "truth within 3 deviations",
    "scans_per_s": "scans/s",
}


def _table(rows: Mapping[str, Any], columns: Mapping[str, str]) -> str:
    shown = {key: title for key, title in columns.items() if any(key in numbers for numbers in rows.values())}
    body = [[_TITLES.get(row, row), *(_number(numbers.get(key)) for key in shown)] for row, numbers in rows.items()]
    counts = [max((number.get("drives", 0) for number in numbers.values()), default=0) for numbers in rows.values()]
    if not any(counts):  # one log
        return _markdown(["", *shown.values()], body)
    counted = [[name, str(count), *numbers] for (name, *numbers), count in zip(body, counts, strict=True)]
    return _markdown(["", "drives", *shown.values()], counted)


def _across(logs: Mapping[str, Any], key: str) -> str:
    """One metric: a line a row, a column a log."""
    rows = list(dict.fromkeys(row for numbers in logs.values() for row in numbers if key in numbers[row]))
    body = [[_TITLES.get(row, row), *(_number(logs[log].get(row, {}).get(key)) for log in logs)] for row in rows]
    return _markdown(["", *logs], body)


def _against_ours(paired: Mapping[str, Any]) -> str:
    """How much larger each row's ATE is than ours, with its interval, in one line each."""
    body = []
    for row, numbers in paired.items():
        relative = numbers["ate_m"]["relative_percent"]
        low, high = relative["ci95"]
        body.append([_TITLES.get(row, row), f"{relative['mean']:+.1f} [{low:+.1f}, {high:+.1f}]"])
    return _markdown(["ATE against ours, same drives", "%"], body)


def _scanners(result: Mapping[str, Any]) -> str:
    tables = {**result["scanners"], "maze2d": result["tables"]["maze2d"]}
    body = [
        [name, _number(rows.get("ours_without_wheels", {}).get("position_rmse_m")), f"{NETWORKS_POSITION_M[name]:.2f}"]
        for name, rows in tables.items()
    ]
    return _markdown(["scanner", "ours, without wheels", "networks of 0.1.0"], body)


def _bars(found: Sequence[Mapping[str, Any]]) -> str:
    body = [
        [
            bar["name"],
            f"{bar['value']:.4g}",
            f"at most {bar['at_most']:.4g}" if "at_most" in bar else f"at least {bar['at_least']:.4g}",
            "yes" if bar["met"] else "**no**",
        ]
        for bar in found
    ]
    return _markdown(["", "value", "bar", "met"], body)


def _number(numbers: Mapping[str, Any] | None) -> str:
    if numbers is None or numbers["mean"] is None:
        return ""
    mean = _digits(numbers["mean"])
    return mean if numbers["ci95"] is None else f"{mean} [{_digits(numbers['ci95'][0])}, {_digits(numbers['ci95'][1])}]"


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}" if abs(value) >= 1.0 else f"{value:.4f}"


def _markdown(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
