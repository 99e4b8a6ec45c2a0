"""The work on a new block before the graph is optimised: features, smoothing, and searches for loops."""

from collections.abc import Callable

from ngo_estimator.graph.meta_nodes import MetaNodes
from ngo_estimator.graph.solved_graph import SolvedGraph
from ngo_estimator.loops.online_loops import OnlineLoops
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.slam.odometry_blocks import OdometryBlocks
from ngo_estimator.slam.trajectory_update import fault_of

_FRESH = 2
"""Blocks since the last optimisation up to which poses say what frames share."""

_AGAIN = 8
"""Blocks after which what shares a frame's walls is looked for once more: its pose knows of loops that came later."""


class BlockIntake:
    """Takes in the newest block.

    Args:
        loops: takes the loops that are found by place codes; None: no loops are closed.
        overlaps: whether loops are found by shared walls as well.
        scale: factor of the graph's variances.
    """

    SAVED = ("solved",)

    def __init__(
        self, odometry: OdometryBlocks, nodes: MetaNodes, loops: OnlineLoops | None, overlaps: bool, scale: float
    ) -> None:
        self._odometry, self._nodes, self._loops = odometry, nodes, loops
        self._overlaps, self._scale = overlaps, scale
        self.solved = SolvedGraph.none()
        """The last optimisation, set by its owner: it limits the drift of loops, and says whether poses are fresh."""

    def take(self) -> str:
        """Take in the newest block; returns a fault in words, or nothing. A fault costs loops or features alone."""
        works: list[tuple[str, Callable[[int], None]]] = [("taking in a meta-pose", self._odometry.aggregate)]
        if self._loops is not None:
            searches = [self._look_for_places, self._measure_places]
            if self._overlaps:
                searches = [self._find_again, *searches, self._find_shared]
            works += [("the search for loops", search) for search in searches]
        fault = ""
        for name, work in works:
            try:
                work(self._nodes.blocks - 1)
            except Exception as error:  # numerics of a library, or a fault of ours
                fault = fault_of(error, name)
        return fault

    @property
    def _fresh(self) -> bool:
        """Whether poses say what frames share."""
        return self._nodes.blocks - self.solved.last <= _FRESH

    def _find_again(self, block: int) -> None:
        """Look once more for overlaps of a slightly older block."""
        nodes = self._nodes
        if self._loops is not None and self._fresh and block - _AGAIN >= nodes.first:
            self._loops.find_overlaps(block - _AGAIN, nodes.first, nodes.poses)

    def _look_for_places(self, block: int) -> None:
        """Look for frames like those of the newest block."""
        if self._loops is not None:
            self._loops.look(block, self._nodes.first, self._nodes.keys)

    def _measure_places(self, block: int) -> None:
        """Measure the loops to these frames."""
        if self._loops is not None:
            self._limit_drift(self._loops.measure())

    def _find_shared(self, block: int) -> None:
        """Look for overlaps of the newest block."""
        nodes = self._nodes
        if self._loops is not None and self._fresh:
            self._limit_drift(self._loops.find_overlaps(block, nodes.first, nodes.poses, nodes.keys))

    def _limit_drift(self, found: PlaceLoops) -> None:
        nodes, std = self._nodes, self._odometry.std
        if self._loops is not None and len(nodes.keys) and len(found):
            limits = self.solved.most_drift(found.start, nodes.first, nodes.poses, std, self._scale)
            self._loops.limit_drift(found, limits)
