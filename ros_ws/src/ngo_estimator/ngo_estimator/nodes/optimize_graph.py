"""Correct a planar pose graph in which many loops may be wrong, and say which ones are believed.

    ros2 run ngo_estimator optimize_graph graph.g2o --out corrected.g2o
    python -m ngo_estimator.nodes.optimize_graph graph.g2o --out corrected.g2o

GRAPH is a g2o file of VERTEX_SE2, EDGE_SE2 and FIX. An edge between neighbours, by their ids, is a step of the
odometry; all others are loops, and so is an edge that ends in '# loop'. OUT gets the corrected vertices, and all edges
as they were, each loop marked with how much it is believed: '# loop 1.0' or '# loop 0.0'. Beside it are a picture
(OUT.png) and a list of all loops (OUT.json).
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from ngo_common.files import write_together
from ngo_estimator.graph.corrector import CorrectedGraph
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.graph.robust import Robust
from ngo_estimator.nodes.command import run_command
from ngo_estimator.trajectory.chained_graph import ChainedGraph, chained
from ngo_estimator.trajectory.g2o import GRAPH_ENDING, PlanarGraph, read_g2o, write_g2o

NAME = "optimize_graph"


@dataclass(frozen=True)
class Arguments:
    """The graph, and where its correction goes."""

    graph: Annotated[Path, tyro.conf.Positional]
    """g2o file of a planar pose graph; it may be packed (.g2o.gz)."""
    out: Path
    """g2o file to write; a picture and a list of all loops lie beside it."""
    picture: bool = True
    """Whether to draw the picture."""
    overwrite: bool = False
    """Whether files that are there already may be replaced."""

    def check(self) -> None:
        """Raise ``ValueError`` for a place where nothing is to be written."""
        if self.out.suffix != GRAPH_ENDING:
            raise ValueError(f"--out is '{self.out}'; expected a name that ends in {GRAPH_ENDING}")
        if not self.out.parent.is_dir():
            raise ValueError(f"--out is '{self.out}', whose folder is not there")
        there = [path for path in self.files if path.exists()]
        if there and not self.overwrite:
            raise ValueError(f"{there[0]} is there already; give another --out, or --overwrite")

    @property
    def files(self) -> list[Path]:
        """The files that are written."""
        endings = (GRAPH_ENDING, ".json", *((".png",) if self.picture else ()))
        return [self.out.with_suffix(ending) for ending in endings]


def run(arguments: Arguments, console: Console) -> dict[str, Any]:
    """Correct the graph, write the files, print a summary, and return the content of OUT.json.

    Raises:
        ValueError, OSError: with one line about a file that cannot be read, used or written.
    """
    arguments.check()
    read = read_g2o(arguments.graph)
    try:
        graph = chained(read)
    except ValueError as error:
        raise ValueError(f"{arguments.graph}: {error}") from None
    for line in _findings(read, graph):
        console.print(line)
    began = time.monotonic()
    screen = Console(stderr=True)
    with screen.status("") as status:
        try:
            solution = Robust(lambda words: status.update(f"{words}, {time.monotonic() - began:.0f} s")).correct(
                graph.problem
            )
        except (ArithmeticError, MemoryError) as error:
            raise ValueError(f"{arguments.graph} cannot be solved: {error or type(error).__name__}") from None
    corrected = graph.corrected(solution)
    report = _report(arguments, graph, solution, time.monotonic() - began)
    for line in _summary(report):
        console.print(line)
    write_g2o(arguments.out, corrected)
    write_together({arguments.out.with_suffix(".json"): json.dumps(report, indent=1) + "\n"})
    if arguments.picture:
        from ngo_estimator.trajectory.graph_plot import save_graph_plot  # matplotlib takes a second

        loops, believed = graph.problem.loops.nodes, solution.loop_weights > BELIEVED
        path = arguments.out.with_suffix(".png")
        save_graph_plot(path, arguments.graph.name, graph.problem.poses, corrected.poses, loops, believed)
    return report


def _findings(read: PlanarGraph, graph: ChainedGraph) -> list[str]:
    """What is particular about a graph."""
    problem, lines = graph.problem, list(read.remarks)
    lines.append(
        f"{len(problem.poses)} vertices, {len(problem.steps) - graph.breaks} steps between neighbours, "
        f"{len(problem.loops)} loops"
    )
    if missing := len(problem.poses) - len(read.ids):
        lines.append(f"{missing} vertices have no line: they begin where the steps put them")
    if graph.breaks:
        lines.append(f"{graph.breaks} neighbours are joined by no step: loops alone say how they lie")
    if graph.components > 1:
        lines.append(f"{graph.components} parts are joined by no edge: each lies about where the file has it")
    return lines


def _report(arguments: Arguments, graph: ChainedGraph, solution: CorrectedGraph, seconds: float) -> dict[str, Any]:
    ids = graph.graph.ids[graph.problem.loops.nodes]
    believed = solution.loop_weights > BELIEVED
    moved = np.hypot(*(graph.corrected(solution).poses - graph.problem.poses)[:, :2].T)
    loops = zip(ids.tolist(), believed.tolist(), graph.misfit(solution).tolist(), strict=True)
    return {
        "graph": str(arguments.graph),
        "vertices": len(graph.problem.poses),
        "steps": len(graph.problem.steps) - graph.breaks,
        "components": graph.components,
        "loops_believed": int(believed.sum()),
        "loops_refused": int((~believed).sum()),
        "steps_refused": int((solution.step_weights < BELIEVED).sum()),
        "largest_move_m": float(moved.max()),
        "step_variance_scale": solution.step_scale,
        "loop_variance_scale": solution.loop_scale,
        "seconds": seconds,
        # A squared residual by the one that a right loop stays below: a loop with more than 1 is refused.
        "loops": [
            {"from": first, "to": second, "believed": kept, "misfit": misfit} for (first, second), kept, misfit in loops
        ],
    }


def _summary(report: dict[str, Any]) -> list[str]:
    believed, refused = report["loops_believed"], report["loops_refused"]
    lines = [
        f"{believed} loops are believed, {refused} refused; vertices moved by up to {report['largest_move_m']:.3g} m "
        f"({report['seconds']:.1f} s)"
    ]
    if report["steps_refused"]:
        lines.append(f"{report['steps_refused']} steps do not fit and are refused, too")
    for what in ("step", "loop"):
        if (scale := report[f"{what}_variance_scale"]) != 1.0:
            lines.append(f"the variances of {what}s are {scale:.3g} times as large as the file says")
    return lines


def main() -> None:
    """Run with the command line's arguments."""
    run_command(NAME, Arguments, __doc__, run)


if __name__ == "__main__":
    main()
