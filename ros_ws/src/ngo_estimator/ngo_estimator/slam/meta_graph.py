"""The graph of meta-poses behind the online trajectory: key frames, a window, and loops between any of them.

Counted in blocks: node ``b`` is the pose after ``b`` blocks of frames, node 0 the first frame, the origin of ``map``.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from ngo_estimator.data.state_arrays import require, require_ascending
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import chained
from ngo_estimator.graph.key_frames import KeyFrame
from ngo_estimator.graph.meta_nodes import MetaNodes
from ngo_estimator.graph.solved_graph import SolvedGraph
from ngo_estimator.loops.loop_closure import Loops
from ngo_estimator.loops.online_loops import OnlineLoops
from ngo_estimator.loops.place_map import PlaceMap
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.meta_poses import MetaSteps, OptimizedMetaPoses, Solution
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.slam.blind_stretches import shrunk_corrections, summed_variances
from ngo_estimator.slam.block_intake import BlockIntake
from ngo_estimator.slam.network_corrections import NetworkCorrections
from ngo_estimator.slam.odometry_blocks import OdometryBlocks
from ngo_estimator.slam.pose_graph import ClosedLoops, PoseGraph, WhichLoops, require_sound
from ngo_estimator.slam.step_log import StepLog

_SHRUNK = 1e-5
"""By less (m or rad) are poses those of the solution: a hundredth of what corrections are good to."""

_LEAST_INFORMATION = 1e-12
"""Of a loop, 1/m^2 or 1/rad^2: with less it might as well not be there."""


class MetaGraph(PoseGraph):
    """Takes frames, keeps nodes, and optimises those of the window together with the key frames before it.

    The network runs for each ``network_every``-th block; between, what it gave is taken again. For each
    ``anneal_every``-th block all loops are judged from the odometry on; between, only new ones.
    """

    _nodes: MetaNodes

    def __init__(
        self,
        optimizer: NeuralGraphOptimizer,
        pair_head: PairHead | None,
        window: int,
        key_frames: int,
        network_every: int = 1,
        anneal_every: int = 1,
        log: Callable[[], StepLog] = StepLog,
    ) -> None:
        super().__init__(MetaNodes(key_frames))
        self._optimizer = optimizer
        self._block, self._window = optimizer.block, window
        self._scale = optimizer.config.covariance_scale
        self._log = log  # of the steps as they came
        self._odometry = OdometryBlocks(optimizer, pair_head, window, log, self._nodes.frames)
        self._loops: OnlineLoops | None = None
        self._origin_code = np.zeros(0, np.float32)  # none
        if optimizer.config.loops:
            assert pair_head is not None
            self._loops = OnlineLoops(pair_head, optimizer.config.search, self._block, window, self._nodes.frames)
        overlaps = optimizer.config.search.overlaps > 0
        self._intake = BlockIntake(self._odometry, self._nodes, self._loops, overlaps, self._scale)
        self._network_every, self._anneal_every = network_every, anneal_every
        self._shrunk = False  # whether corrections of the last result were shrunk
        self._annealed = 0  # blocks when all loops were judged last
        self._corrections = NetworkCorrections.none()

    @property
    def window_fill(self) -> float:
        """Share of the window that is in use."""
        return min(1.0, self._odometry.steps / (self._window * self._block))

    def begin_at(self, origin_code: np.ndarray | None) -> None:
        """Take the place code of the first frame, where it is known, before the first step."""
        if origin_code is not None:
            self._origin_code = origin_code

    def append(
        self,
        relative: np.ndarray,
        variance: np.ndarray,
        motion: np.ndarray,
        code: np.ndarray,
        joins: bool = False,
        familiar: bool = True,
    ) -> None:
        """Take a step ``(3,)`` with its variances, motion feature and place code; ``work`` does what it makes due.

        With ``joins`` the step is where another odometry goes on, in another place.
        A frame that is not ``familiar`` closes no loops, and networks leave the odometry around it as it is. Its
        variances are honest, so that ``covariance_scale`` is not for them. The first one recalls those before it.
        """
        if not familiar:
            code, variance = np.zeros_like(code), variance / self._scale
            if self._odometry.is_familiar:
                self._recall()
        self._nodes.append(relative.astype(np.float64), np.diag(variance.astype(np.float64)), joins)
        self._odometry.append(relative, variance, motion, familiar)
        if self._loops is not None:
            self._loops.append(code)

    @property
    def _has_new_node(self) -> bool:
        return self._odometry.steps >= (self._nodes.blocks + 1) * self._block

    @torch.inference_mode()
    def work(self, optimize: bool = True) -> bool:
        """Take in the block that is complete, if there is one, and optimise; see ``PoseGraph.work``."""
        return super().work(optimize)

    def _take_in(self) -> bool:
        self._guarded("the registration of steps", lambda: self._register(self._nodes.blocks * self._block))
        self._odometry.complete()
        self._nodes.add_node()
        self.fault = self._intake.take() or self.fault
        self._make_room()
        return True

    def _register(self, first: int) -> None:
        """Measure the newest block again, which begins with the step of number ``first``."""
        if self._loops is None or self._odometry.registrations == 0:
            return
        before = self._origin_code if first == 0 else self._loops.codes(first - 1)[0]
        self._odometry.register(self._loops.codes(first), before if len(before) else None)

    @torch.inference_mode()
    def _recall(self) -> None:
        """Take the newest frames back, which were taken for familiar: their loops, and what was registered by them."""
        first = self._odometry.recall()
        if self._loops is not None:
            self._loops.recall(first)

    def _make_room(self) -> None:
        """Let the window slide, and some key frames go."""
        while self._nodes.blocks - self._nodes.first > self._window:
            self._nodes.leave(self._key_frame(self._nodes.first))
            if self._loops is not None:
                self._loops.leave(self._nodes.first)
        if self._nodes.keys.crowded:
            thinned = self._nodes.thin()
            if self._loops is not None:
                self._loops.reattach(*thinned)

    def _key_frame(self, node: int) -> KeyFrame:
        """The key frame that the window's first node becomes."""
        relative = self._nodes.step()
        variance = self._odometry.optimized_std.slice(node, node + 1)[0] ** 2
        if self._loops is not None:
            return self._loops.key_frame(node, relative, variance)
        nothing = np.zeros((self._block, 0), np.float32)
        return KeyFrame(node, relative, variance, nothing, nothing, np.zeros((self._block, 3)))

    def _optimise(self) -> None:
        """Optimise all nodes of the window and the key frames before it."""
        odometry, keys, first, blocks = self._odometry, self._nodes.keys, self._nodes.first, self._nodes.blocks
        relative = np.concatenate((keys.relative, odometry.relative.slice(first))).astype(np.float32)
        std = np.concatenate((np.sqrt(keys.variance), odometry.std.slice(first))).astype(np.float32)
        known = None if self._network_is_due else self._corrections
        runs_network = self._optimizer.config.network and known is None
        features = None
        if runs_network:
            features = torch.from_numpy(odometry.features.slice(first)).unsqueeze(0)
        steps = MetaSteps(
            torch.from_numpy(relative).unsqueeze(0), torch.from_numpy(std).unsqueeze(0), features, blocks - first
        )
        if (fixed := odometry.fixed.slice(first)).any():
            steps = replace(steps, fixed=torch.from_numpy(fixed.copy()).unsqueeze(0))
        loops, numbers, solution = None, np.zeros(0, np.int64), None
        if self._loops is not None:
            loops, numbers = self._loops.loops(keys.nodes, first, blocks)
            loops = self._verified(loops)
            if not self._annealing_is_due:
                solution = Solution(torch.from_numpy(self._nodes.relative).unsqueeze(0), *self._loops.weighed(numbers))
        corrections = None if known is None else known.for_blocks(first, blocks)
        *_, result = self._optimizer.iterate(steps, loops, corrections, solution)
        end = self._scale * result.end_covariance()[0].numpy()
        require_sound(result.meta_relative[-1].numpy(), end)
        self._apply(result, numbers, end)
        if solution is None:
            self._annealed = blocks
        if runs_network and self._network_every > 1:
            self._corrections = NetworkCorrections.of(first, result.corrections)

    def _verified(self, loops: Loops) -> Loops:
        """The same loops; none across a blind stretch where place codes alone show them.

        Nothing limits the motion within it, so that each place that looks alike would do.
        """
        search = self._optimizer.config.search
        if search.registrations or search.least_belief or not self._odometry.blind.any():
            return loops
        blind = (summed_variances(self._odometry.blind, self._nodes.active) > 0.0).any(axis=1)
        before = torch.from_numpy(np.concatenate(([0], blind.cumsum())))
        return replace(loops, valid=loops.valid & (before[loops.end + 1] == before[loops.start]))

    @property
    def _network_is_due(self) -> bool:
        """Whether what the network gave is too old."""
        known = self._corrections
        return not known.last or is_due(self._nodes.blocks - known.last, known.last - known.first, self._network_every)

    @property
    def _annealing_is_due(self) -> bool:
        """Whether all loops are to be judged anew, from the odometry on."""
        first = self._nodes.first
        # Across blind stretches the poses are not those of the solution, even where the window has left them behind.
        if self._shrunk or self._odometry.blind[first:].any() or self._network_is_due:
            return True
        return is_due(self._nodes.blocks - self._annealed, self._annealed - first, self._anneal_every)

    def _apply(self, result: OptimizedMetaPoses, numbers: np.ndarray, end: np.ndarray) -> None:
        """Take the result; how far the last node is from it adds to its covariance ``end``."""
        if self._loops is not None and result.loop_weights is not None and result.loop_information is not None:
            weight, information = (of[0].double().numpy() for of in (result.loop_weights, result.loop_information))
            std = 1.0 / np.sqrt(np.maximum(information, _LEAST_INFORMATION))
            self.closed = ClosedLoops(*self._loops.edges(numbers), std, weight)
            self._loops.weigh(numbers, weight, information)
        solution = chained(result.meta_relative[-1][0].double().numpy())
        poses = self._shrink(solution)
        moved = poses[-1] - solution[-1]
        self._nodes.move(self._nodes.active, poses, end + np.outer(moved, moved))
        keys, first = self._nodes.keys.nodes, self._nodes.first
        self._odometry.optimized_std.replace(first, result.step_std[0, len(keys) :].double().numpy())
        self._intake.solved = SolvedGraph(keys, first, self._nodes.blocks, end, result.equations)

    def _shrink(self, solution: np.ndarray) -> np.ndarray:
        """Poses of the active nodes ``(n, 3)``, whose corrections are shrunk across blind stretches."""
        self._shrunk = False
        blind = self._odometry.blind
        if not blind.any():
            return solution
        active, log = self._nodes.active, self._log().odometry.values
        odometry = se2.between(torch.from_numpy(log[0]), torch.from_numpy(log[active * self._block])).numpy()
        ties = self._loops.ties() if self._loops is not None else (np.zeros((0, 2), np.int64), np.zeros(0))
        joined = np.searchsorted(active, ties[0])
        shrunk = shrunk_corrections(solution, odometry, summed_variances(blind, active), joined, ties[1])
        self._shrunk = bool(np.abs(shrunk - solution).max() > _SHRUNK)
        return shrunk

    def _drop_loops(self, which: WhichLoops) -> int:
        removed = 0 if self._loops is None else self._loops.drop(which)
        if removed:
            self._annealed, self._corrections = 0, NetworkCorrections.none()
        return removed

    @torch.inference_mode()
    def remove_loops(self, which: WhichLoops) -> int:
        """See ``PoseGraph.remove_loops``."""
        return super().remove_loops(which)

    def places(self) -> PlaceMap:
        """The frames whose place codes are kept; raises ``ValueError`` where none are."""
        if self._loops is None:
            raise ValueError("the optimizer closes no loops, and keeps no place codes; expected one with loops")
        return self._loops.places(self._nodes.first * self._block, self._nodes.keys, self.frame_poses())

    SAVED = (
        "_nodes", "_odometry", "_loops", "_intake", "_annealed", "_shrunk", "_corrections", "_origin_code", "closed",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        frames, blocks, joined = self._odometry.steps, self._nodes.blocks, self.closed.pairs
        require(blocks == self._odometry.blocks, f"{frames} steps and {blocks} meta-poses do not belong together")
        require(bool(((joined >= 0) & (joined <= frames)).all()), "loops join frames that are not there")
        given, solved = self._corrections, self._intake.solved
        shape = self._optimizer.config.iterations if given.last else 0, given.last - given.first
        require(
            0 <= given.first <= given.last <= blocks
            and given.adjustment.shape[:2] == given.stiffness.shape[:2] == shape,
            f"corrections of the blocks {given.first} to {given.last} are given",
        )
        require(0 <= solved.first <= solved.last <= blocks, "an optimisation is of nodes that are not there")
        require_ascending(solved.keys, "keys", blocks + 1)
        require(0 <= self._annealed <= blocks, f"loops were judged at meta-pose {self._annealed} of {blocks}")


def is_due(since: int, seen: int, every: int) -> bool:
    """Whether to repeat work that saw ``seen`` blocks, ``since`` blocks ago, and is due for each ``every``-th block.

    A short trajectory changes a lot with each block.
    """
    return since >= min(every, 1 + seen // 8)
