"""The picture of a graph whose loops come online: which of them are believed, doubted and refused as blocks come."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from ngo_estimator.geometry.se2 import compose
from training.report.pictures import panels, save
from training.scoring.graph_problems import JudgedProblem, Online
from training.scoring.metrics import rigid_motion

CAPTION = (
    "Above: the corrected path (black) over the truth (grey) with its loops: refused (red), believed (blue), and "
    "doubted, whose verdict has changed since they came (orange). Below: which loops are right and which are believed, "
    "how many verdicts about known loops each block changes, and the error."
)
_BELIEVED, _REFUSED, _DOUBTED = "#1f6fd6", "#d62728", "#ff9f1c"
_COUNTED = {
    ("right", "believed"): _BELIEVED,
    ("wrong", "believed"): "#8e44ad",
    ("right", "refused"): "#7f2020",
    ("wrong", "refused"): "#f3b7b7",
}
_MAPS = 3
_OPAQUE = 300  # so many lines may be drawn full; more are the fainter


def draw(path: Path, blocks: list[JudgedProblem], online: Online) -> None:
    """Write a PNG of the solutions of a graph's blocks."""
    believed = [solution.loop_weights > 0.0 for solution in online.solutions]
    figure, axes = panels(2 * _MAPS, _MAPS, 4.4, 3.6)
    shown = np.linspace(0, len(blocks), _MAPS + 1).round().astype(int)[1:] - 1
    doubted, changes = np.zeros(0, bool), []
    for k, (block, verdicts) in enumerate(zip(blocks, believed, strict=True)):
        before = believed[max(k - 1, 0)]
        changed = np.append(verdicts[: len(before)] != before, np.zeros(len(verdicts) - len(before), bool))
        doubted = np.append(doubted, np.zeros(len(verdicts) - len(doubted), bool)) | changed
        changes.append(((changed & verdicts).sum(), -(changed & ~verdicts).sum()))
        if k in shown:
            of = {"refused": ~verdicts & ~doubted, "believed": verdicts & ~doubted, "doubted": doubted}
            _map(next(axes), block, online.solutions[k].poses, of)
    loops = np.array([len(each) for each in believed])
    counted = [
        [
            ((block.right == (right == "right")) & (kept == (said == "believed"))).sum()
            for block, kept in zip(blocks, believed, strict=True)
        ]
        for right, said in _COUNTED
    ]
    _below(axis := next(axes), "which loops are believed", "loops")
    axis.stackplot(loops, *counted, labels=map(", ".join, _COUNTED), colors=list(_COUNTED.values()))
    axis.legend(frameon=False, fontsize=8, loc="upper left")
    _below(axis := next(axes), f"{online.changed:.2%} of known verdicts change", "loops")
    for many, color, said in zip(np.transpose(changes), (_BELIEVED, _REFUSED), ("believed", "refused"), strict=True):
        axis.bar(loops, many, 0.8 * loops[0], color=color, label=f"now {said}")
    axis.legend(frameon=False, fontsize=8)
    _below(axis := next(axes), "error after the best alignment", "ATE, m")
    axis.set_yscale("log")
    corrected = [solution.poses for solution in online.solutions]
    for found, color, said in (([b.problem.poses for b in blocks], "0.6", "odometry"), (corrected, "0.2", "corrected")):
        axis.plot(loops, [b.ate_m(poses) for b, poses in zip(blocks, found, strict=True)], color=color, label=said)
    axis.legend(frameon=False, fontsize=8)
    save(figure, path, dpi=75)


def _map(axis: Axes, block: JudgedProblem, poses: np.ndarray, verdicts: dict[str, np.ndarray]) -> None:
    positions = compose(rigid_motion(poses[:, :2], block.truth), poses)[:, :2]
    axis.plot(*block.truth.T, color="0.75", linewidth=2.5)
    axis.plot(*positions.T, color="0.2", linewidth=0.7)
    for (said, which), color in zip(verdicts.items(), (_REFUSED, _BELIEVED, _DOUBTED), strict=True):
        alpha = min(1.0, max(0.05, _OPAQUE / max(which.sum(), 1)))
        lines = list(positions[block.problem.loops.nodes[which]])
        axis.add_collection(LineCollection(lines, colors=color, linewidths=0.7, alpha=alpha))
        axis.plot([], [], color=color, label=f"{which.sum()} {said}")
    axis.set(aspect="equal", title=f"after {len(block.right)} loops", xlabel="x, m", ylabel="y, m")
    axis.margins(y=0.2)
    axis.legend(frameon=False, fontsize=7, loc="upper center", ncols=3)


def _below(axis: Axes, title: str, unit: str) -> None:
    axis.set(title=title, xlabel="loops so far", ylabel=unit)
