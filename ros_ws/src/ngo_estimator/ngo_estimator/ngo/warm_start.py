"""The warm start: an optimisation that takes what the network gave before, and may go on from an earlier solution."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from torch import Tensor

from ngo_estimator.ngo.loop_closing import LoopClosing
from ngo_estimator.ngo.meta_poses import Correction, GraphState, MetaSteps, OptimizedMetaPoses, Solution


class Remembered:
    """Stands for both phases where the network is not run: what it gave in another optimisation."""

    def __init__(self, corrections: Sequence[Correction]) -> None:
        self._corrections = iter(corrections)

    def optimise(self, state: GraphState, loops: Callable[[GraphState], Tensor]) -> tuple[GraphState, Tensor]:
        """The state with the adjustments of the next iteration, and its stiffness."""
        adjustment, stiffness = next(self._corrections)
        adjusted = state.adjusted.clone()
        adjusted[:, -adjustment.shape[1] :] += adjustment
        return replace(state, adjusted=adjusted), stiffness


def resumed(
    closing: LoopClosing,
    steps: MetaSteps,
    corrections: Sequence[Correction],
    solution: Solution,
    iterations: int,
) -> Iterator[OptimizedMetaPoses]:
    """The result that begins at an earlier solution.

    Loops that the solution does not know are judged as in the first iteration, which
    allows for the odometry's drift, and then as in the last of the ``iterations``. Others keep what judging all loops
    from the odometry on gave them.
    """
    adjusted, stiffness = steps.relative.clone(), corrections[-1].stiffness
    adjusted[:, steps.key_frames :] += sum(adjustment for adjustment, _ in corrections)
    adjusted, stiffness = steps.without_fixed(steps.relative, adjusted, stiffness)
    relative, step_std = closing.resume(adjusted, stiffness, solution.relative, (0, iterations - 1))
    yield closing.with_loops(OptimizedMetaPoses([relative.to(steps.relative.dtype)], step_std))
