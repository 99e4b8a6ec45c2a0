"""The page of the lidar's results in Markdown, made whole from the JSON."""

from collections.abc import Mapping
from typing import Any

from training.report.page import figures, markdown, signed, with_interval
from training.report.page import page as whole
from training.scoring.lidar_rows import ROWS

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
    with_mapper = {name: _unfed(rows) for name, rows in logs.items() if name not in with_relations}
    parts = [
        "<!-- Made by `python -m training.results --world scan`; changes belong into report/lidar_page.py. -->",
        "# Results of the lidar",
        f"`{result['command']}` at revision `{result['revision']}`. In brackets are 95 % bootstrap intervals: over the "
        "relations of a log, over the drives of a table. A number of one whole log has none. Odometry is what the "
        "correction was given: our front end's. Online is each pose as it was published. The negative log-likelihood "
        "of the truth (nats a pose) is lower for a covariance that fits better. Speed is by computing time on one "
        "thread. Numbers in full are in [`training/results/scan.json`](../training/results/scan.json).",
        *_earlier(result["earlier"]),
    ]
    if with_relations:
        parts += [
            "## Logs with relations",
            "Mean errors over relative poses that people checked (Kuemmerle et al. 2009). Far relations span more than "
            "30 s: there loops show.",
        ]
        for name, rows in with_relations.items():
            parts += [f"### {name}", _table(_unfed(rows), _RELATION_COLUMNS)]
    if with_mapper:
        parts += [
            "## Logs with a mapper's poses",
            "ATE (m) after the best rigid alignment, against the poses of GMapping. They are good to some centimetres "
            "and not the truth.",
            _across(with_mapper, "ate_m"),
            "As published online:",
            _across(with_mapper, "online_ate_m"),
        ]
    for name, title in _BUILDING_TITLES.items():
        parts += [
            f"## {title}",
            f"Up to {settings['buildings']} buildings that nothing was trained or chosen on, {settings['length_m']:g} "
            "m each or 20,000 scans, with drawn scanners and wheels. Rows of fewer drives have some of them.",
            _table(_unfed(result["tables"][name]), _BUILDING_COLUMNS),
            _against_ours(_unfed(result["paired"][name])),
        ]
    parts += _changed(result)
    parts += [
        "## Mazes",
        f"Up to {settings['mazes']} validation mazes of `maze2d`, {settings['frames']} scans each, no wheels.",
        _table(result["tables"]["maze2d"], _BUILDING_COLUMNS),
    ]
    parts += figures(images)
    for title, lines in (("Skipped", result["skipped"]), ("Failed", result["failed"])):
        if lines:
            parts += [f"## {title}", "\n".join(f"- {line}" for line in lines)]
    return whole(parts)


def _earlier(tables: Mapping[str, Any]) -> list[str]:
    names = []
    for name, of in tables.items():
        rows = of["measured"].items()
        later = "".join(f"; {_title(row).replace('*', '')}: `{revision}`" for row, revision in rows)
        names.append(f"{name} (`{of['revision']}`{later})")
    return [f"**Not measured anew, and so of an earlier revision: {', '.join(names)}.**"] if names else []


def _changed(result: Mapping[str, Any]) -> list[str]:
    parts = list[str]()
    if slip := result["tables"]["slip"]:
        parts += [
            "## Wheels that slip",
            "The first buildings again, but the wheels slip 300 times a km, each time for 0.3 to 1.5 s by up to 60 %.",
            _table(slip, _BUILDING_COLUMNS),
        ]
    tables = {**result["logs"], **{name: result["tables"][name] for name in _BUILDING_TITLES}}
    fed = {name: {row: rows[row] for row in _FED if row in rows} for name, rows in tables.items()}
    fed = {name: rows for name, rows in fed.items() if rows}
    if fed:
        parts += [
            "## Wrong loops fed in",
            "The first drives of each table, and all logs. Errors (m: ATE; of a log with relations the mean of these) "
            "where so many of all loops are wrong, all at once, from odometry. A wrong loop is a right one that took "
            "another place; five in a row agree with each other. Each number is the mean over three draws. Where the "
            "robot got lost, nobody measured the step: a stretch that no right loop reaches then goes "
            "where wrong ones put it.",
            _across({_counted(name, rows): rows for name, rows in fed.items()}, *_ERRORS),
        ]
    for name in _BUILDING_TITLES:
        paired = result["paired"][name]
        if ours := {row: paired[row] for row in paired if paired[row]["with"] == "ours_0_percent_wrong"}:
            parts += [f"Ours in `{name}` against none wrong, same drives:", _against_ours(ours)]
    return parts


_BUILDING_TITLES = {"buildings": "Simulated buildings", "aliased": "Buildings whose rooms repeat"}
_FED = [row for row in ROWS if row.endswith("percent_wrong")]
_ERRORS = ("ate_m", "translation_m")


def _unfed(rows: Mapping[str, Any]) -> dict[str, Any]:
    return {name: numbers for name, numbers in rows.items() if name not in _FED}


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
    "negative_log_likelihood": "negative log-likelihood",
    "scans_per_s": "scans/s",
}


def _table(rows: Mapping[str, Any], columns: Mapping[str, str]) -> str:
    shown = {key: title for key, title in columns.items() if any(key in numbers for numbers in rows.values())}
    body = [[_title(row), *(_cell(numbers, key) for key in shown)] for row, numbers in rows.items()]
    counts = [max((number.get("drives", 0) for number in numbers.values()), default=0) for numbers in rows.values()]
    if not any(counts):  # one log
        return markdown(["", *shown.values()], body)
    counted = [[name, str(count), *numbers] for (name, *numbers), count in zip(body, counts, strict=True)]
    return markdown(["", "drives", *shown.values()], counted)


def _across(logs: Mapping[str, Any], *keys: str) -> str:
    """One metric, the first of these that a row has: a line a row, a column a log."""

    def found(numbers: Mapping[str, Any]) -> str:
        return next((_cell(numbers, key) for key in keys if key in numbers), "")

    there = dict.fromkeys(row for numbers in logs.values() for row in numbers if found(numbers[row]))
    rows = sorted(there, key=lambda row: [*ROWS, row].index(row))
    body = [[_title(row), *(found(logs[log].get(row, {})) for log in logs)] for row in rows]
    return markdown(["", *logs], body)


def _counted(name: str, rows: Mapping[str, Any]) -> str:
    """A table's name with the number of its drives; a log's alone."""
    count = max((number.get("drives", 0) for numbers in rows.values() for number in numbers.values()), default=0)
    return f"{name}, {count} drives" if count else name


def _title(row: str) -> str:
    """A row's name in words; with wrong loops that of its solver with their share."""
    if row not in _FED:
        return _TITLES.get(row, row)
    *solver, percent, _, _ = row.split("_")
    return f"{_SOLVERS['_'.join(solver)]}, {percent} % wrong"


_SOLVERS = {
    "ours": "**ours**",
    "gtsam_lm": "GTSAM, LM with Cauchy",
    "gtsam_gnc": "GTSAM, GNC",
}


def _against_ours(paired: Mapping[str, Any]) -> str:
    """How much larger each row's ATE is than ours, with its interval, in one line each."""
    body = [
        [_title(row), with_interval(numbers["ate_m"]["relative_percent"], signed(1))]
        for row, numbers in paired.items()
        if "ate_m" in numbers
    ]
    return markdown(["ATE against ours, same drives", "%"], body)


def _cell(numbers: Mapping[str, Any], key: str) -> str:
    return with_interval(numbers.get(key), _digits)


def _digits(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}" if abs(value) >= 1.0 else f"{value:.4f}"
