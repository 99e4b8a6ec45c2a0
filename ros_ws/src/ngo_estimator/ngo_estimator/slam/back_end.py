"""The back end of every sensor: a pose graph, the loops that join its nodes, and the work that a new node makes due."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ngo_estimator.data.relative_step import RelativeStep
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.loop_record import LoopRecord, rows
from ngo_estimator.slam.localisation import Localiser
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.trajectory_update import fault_of

WhichLoops = Callable[[np.ndarray], np.ndarray]
"""Chooses ``(n,)`` among loops, by the frames that they join ``(n, 2)``."""


@dataclass(frozen=True)
class ClosedLoops(LoopRecord):
    """The loops of the last optimisation, between frames.

    ``std`` ``(n, 3)`` are deviations of ``relative``, in which the ``weight`` ``(n,)``, zero to one, is accounted for.
    """

    std: np.ndarray = rows(np.float64, 3)
    weight: np.ndarray = rows(np.float64)


class LoopFinder(Protocol):
    """Finds loops of each new node, when its back end asks for them, and keeps those that were found."""

    @property
    def loops(self) -> LoopRecord:
        """All that are kept, between nodes."""

    def drop(self, chosen: np.ndarray) -> int:
        """Take out for good the loops of a mask ``(n,)``; returns how many of them the graph had."""


class BackEnd(ABC):
    """Follows frames by odometry; a node makes work due: the search for its loops, and an optimisation.

    Args:
        graph: owns all poses in ``map``.
    """

    _finder: LoopFinder | None

    def __init__(self, graph: PoseGraph) -> None:
        self.graph = graph
        self.closed = ClosedLoops.none()
        self._waiting = 0
        """Nodes since there is a loop that no optimisation has seen."""
        self.fault = ""
        """What failed in the last ``work`` or ``finish``, in words; empty where nothing did."""
        self.took_s = 0.0
        """Computing time of the last work that ended with an optimisation."""
        self.scales: tuple[float, float] | None = None
        """How many times as large as stated the last optimisation found the variances of steps and of loops; None
        before one measured them, as after loading."""

    @abstractmethod
    def checked(self, step: RelativeStep) -> RelativeStep:
        """The step as it is taken; raises ``RejectedStep`` for one that cannot be used."""

    @abstractmethod
    def begin_at(self, step: RelativeStep) -> None:
        """Take what is known of the first frame, before the step from it."""

    @abstractmethod
    def append(self, step: RelativeStep, joins: bool = False) -> None:
        """Take a step from the newest frame to the next one.

        ``joins``: another odometry goes on from there, and the motion was found in the map.
        """

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """Pose ``(3,)`` of the newest frame in the map, and its covariance ``(3, 3)`` as it is published."""
        return self.graph.newest()

    def may_join(self, step: RelativeStep) -> bool:
        """Whether another odometry may go on from this step's frame."""
        return True

    @abstractmethod
    def localiser(self, origin: MapOrigin) -> Localiser:
        """Localises in the graph as it is, which lies in ``map`` as ``origin`` says; raises ``ValueError``."""

    def work(self, optimize: bool = True) -> bool:
        """Do what the newest frame made due; returns whether it optimised.

        A fault costs what failed alone: loops, or an optimisation. Every node is then where it was.
        """
        self.fault = ""
        if not self._has_new_node:
            return False
        began = time.perf_counter()
        optimized = self._take_in() and optimize and self._guarded("an optimisation", self._optimise)
        if optimized:
            self.took_s = time.perf_counter() - began
        return optimized

    def _guarded(self, work: str, do: Callable[[], None]) -> bool:
        """Do it; returns whether it did not fail."""
        try:
            do()
        except Exception as error:  # numerics of a library, or a fault of ours: the trajectory goes on by odometry
            self.fault = fault_of(error, work)
            return False
        return True

    @property
    @abstractmethod
    def _has_new_node(self) -> bool:
        """Whether the newest frame completed a node that was not taken in."""

    @abstractmethod
    def _take_in(self) -> bool:
        """Take in the new node, and look for its loops; returns whether it is time to optimise."""

    @abstractmethod
    def _optimise(self) -> None:
        """Optimise all nodes, or leave all as they are and raise."""

    @property
    def unfinished(self) -> bool:
        """Whether there is anything left to optimise when ``work`` is done."""
        return self._waiting > 0

    def finish(self) -> bool:
        """Optimise what is left when no more frames come; returns whether there was anything, and it worked."""
        self.fault = ""
        return False

    def remove_loops(self, which: WhichLoops) -> int:
        """Take loops out for good, and optimise without them; returns how many there were."""
        self.fault = ""
        removed = self._drop_loops(which)
        if removed:
            self._guarded("an optimisation", self._optimise)
        return removed

    def _drop_loops(self, which: WhichLoops) -> int:
        """Forget the loops that ``which`` chooses; returns how many of them the graph used."""
        if self._finder is None:
            return 0
        removed = self._finder.drop(which(self._finder.loops.frames(self.graph.frames.nodes)))
        if removed:
            self._forget_solution()
        return removed

    @abstractmethod
    def _forget_solution(self) -> None:
        """Let the next optimisation begin without what the last one thought of loops."""

    @property
    def waiting_loops(self) -> int:
        """Loops that were found and that no optimisation has seen."""
        return 0

    @property
    def lost_since(self) -> int | None:
        """The frame from which on nobody knows where the newest is in the map; None where that is known."""
        return None

    @property
    def window_fill(self) -> float:
        """Share of the window that is in use; zero where all nodes are optimised together."""
        return 0.0


def require_sound(poses: np.ndarray, end: np.ndarray) -> None:
    """Raise ``ArithmeticError`` about poses ``(n, 3)``, or a covariance ``(3, 3)`` of the last, that are none."""
    if not (np.isfinite(poses).all() and np.isfinite(end).all() and (np.diagonal(end) > 0.0).all()):
        raise ArithmeticError("poses or their covariances came out as no numbers")
