"""Figures of exploration: coverage by path, and three ways through the same place side by side."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ngo_explorer.known_map import Floats
from training.report.pictures import panels, save
from training.scoring.table import Measured, Table, column

_SIDE_BY_SIDE = ("explore_lite", "ours", "known_tour")
_CELL_M = 0.05


def draw_figures(folder: Path, tables: Mapping[str, Table]) -> dict[str, str]:
    """Draw the figures of all kinds of places; their captions by file name."""
    drawn = {}
    for kind, table in tables.items():
        name = f"results_explore_{kind}_coverage.png"
        _draw_coverage(folder / name, table)
        drawn[name] = f"Mean share seen of what can be seen, by path, {kind}"
        place = next((rows for rows in table.values() if all(row in rows for row in _SIDE_BY_SIDE)), None)
        if place is not None:
            name = f"results_explore_{kind}_paths.png"
            _draw_paths(folder / name, place)
            drawn[name] = f"The same place by three rules, {kind}: a cross is where 95 % had been seen"
    return drawn


def _draw_coverage(path: Path, table: Table) -> None:
    figure, (axes,) = panels(1, 1, 7.0, 4.2)
    names = list(dict.fromkeys(row for rows in table.values() for row in rows))
    longest = max(found.drawn["path_m"][-1] for rows in table.values() for found in rows.values())
    along = np.linspace(0.0, longest, 400)
    for name in names:
        runs = [np.interp(along, run.drawn["path_m"], run.drawn["coverage"]) for run in column(table, name)]
        axes.plot(along, np.mean(runs, axis=0), label=name, linewidth=2.2 if name == "ours" else 1.2)
    axes.axhline(0.95, color="0.7", linewidth=0.8)
    axes.set(xlabel="path [m]", ylabel="share seen", ylim=(0.0, 1.02), xlim=(0.0, longest))
    axes.legend(fontsize=8, frameon=False)
    save(figure, path, dpi=110)


def _draw_paths(path: Path, place: Mapping[str, Measured]) -> None:
    figure, panel = panels(len(_SIDE_BY_SIDE), len(_SIDE_BY_SIDE), 5.0, 5.4)
    for axes, name in zip(panel, _SIDE_BY_SIDE, strict=True):
        run = place[name]
        drawn = run.drawn
        free = np.unpackbits(drawn["free"], axis=1, count=int(drawn["columns"])).astype(bool)
        left, bottom = drawn["corner"]
        extent = (left, left + free.shape[1] * _CELL_M, bottom, bottom + free.shape[0] * _CELL_M)
        axes.imshow(np.where(free, 1.0, 0.75), "gray", origin="lower", vmin=0.0, vmax=1.0, extent=extent)
        way: Floats = drawn["way"]
        axes.plot(way[:, 0], way[:, 1], linewidth=1.0, color="#1f6fd6")
        axes.plot(*way[0, :2], "o", color="black", markersize=5)
        title = f"{name}: {drawn['path_m'][-1]:.0f} m in all"
        if "path_to_95_m" in run.errors:
            to = float(run.errors["path_to_95_m"][0])
            walked = np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(way[:, :2], axis=0).T))))
            axes.plot(*way[min(int(np.searchsorted(walked, to)), len(way) - 1), :2], "x", color="red", markersize=9)
            title += f", {to:.0f} m to 95 %"
        axes.set_title(title, fontsize=10)
    save(figure, path, dpi=100)
