"""The warm start: an optimisation that takes what the network gave before, and may go on from an earlier solution."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from torch import Tensor

from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.ngo.loop_closing import judged
from ngo_estimator.ngo.loop_gates import RobustLoopGate, holds
from ngo_estimator.ngo.meta_poses import Correction, GraphState, Solution

_LEAST_WEIGHT = 1e-4
"""Of a loop that an earlier solution knew: one of less weight has no share in the equations."""


class Remembered:
    """Stands for both phases where the network is not run: what it gave in another optimisation."""

    def __init__(self, corrections: Sequence[Correction]) -> None:
        self._corrections: Iterator[Correction] = iter(corrections)

    def optimise(self, state: GraphState, loops: Callable[[GraphState], Tensor]) -> tuple[GraphState, Tensor]:
        """The state with the adjustments of the next iteration, and its stiffness."""
        adjustment, stiffness = next(self._corrections)
        adjusted = state.adjusted.clone()
        adjusted[:, -adjustment.shape[1] :] += adjustment
        return replace(state, adjusted=adjusted), stiffness


def resumed(
    gate: RobustLoopGate,
    iterations: Sequence[int],
    odometry: tuple[np.ndarray, np.ndarray],
    adjusted: np.ndarray,
    step_std: np.ndarray,
    loops: PlaceLoops,
    new_loops: Any,
    poses: np.ndarray,
) -> Solution:
    """The solution that begins at an earlier one, with a Gauss-Newton step for each of ``iterations``.

    Loops that are new to it are judged as in these. Others keep what judging all loops from the odometry on gave them.

    Args:
        odometry: relative poses and their deviations, both ``(poses, 3)``.
        adjusted, step_std: the same with what the network gave.
        loops: with the weights and the information of the earlier solution, both negative for new ones.
        new_loops: these, as arrays.
        poses: of the earlier solution ``(poses + 1, 3)``.
    """
    # The compiler's library takes 100 MB: only those pay for it that optimise.
    from ngo_estimator.graph.normal_equations import GraphStructure, NormalEquations, diagonal_information

    new, counts = np.flatnonzero(loops.information[:, 0] < 0.0), loops.weight >= _LEAST_WEIGHT
    weights, information = loops.weight.clip(0.0), loops.information.clip(0.0)
    if len(new):
        # Known loops were tested before.
        valid = new_loops.valid & holds(new_loops.nodes, new_loops.measured, *odometry)
        counts[new], new_loops = valid, replace(new_loops, valid=valid)
    used, chain = np.flatnonzero(counts), np.arange(len(adjusted))
    nodes = np.concatenate((np.stack((chain, chain + 1), axis=-1), loops.pairs[used]))
    structure, measured = GraphStructure(nodes, len(poses)), np.concatenate((adjusted, loops.relative[used]))
    believed = odometry[1]
    for iteration in iterations:
        if len(new):
            weights[new], information[new] = judged(gate, new_loops, poses, believed, iteration)
        of_edges = diagonal_information(np.concatenate((1.0 / step_std**2, information[used])))
        equations, believed = NormalEquations(structure, poses, measured, of_edges), step_std
        poses = poses + equations.solution()
    return Solution(poses, step_std, weights, information, equations.covariance([len(chain)]))
