"""The back end of pictures: a graph of meta-poses, key frames and a window of them, with loops between any of them.

Its nodes are the poses before blocks of frames: those of the key frames, and then those of the window.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from ngo_estimator.data.relative_step import UNFAMILIAR, RelativeStep, check_step
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry import se2
from ngo_estimator.geometry.planar_motion import all_between
from ngo_estimator.graph.key_frames import KeyFrame, KeyFrames
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.loops.place_loop_finder import PlaceLoopFinder
from ngo_estimator.loops.place_loops import PlaceLoops
from ngo_estimator.networks.place_encoder import PairHead
from ngo_estimator.ngo.meta_poses import MetaSteps, OptimizedMetaPoses, Solution
from ngo_estimator.ngo.neural_graph_optimizer import NeuralGraphOptimizer
from ngo_estimator.slam.back_end import BackEnd, ClosedLoops, require_sound
from ngo_estimator.slam.blind_stretches import shrunk_corrections, summed_variances
from ngo_estimator.slam.localisation import Localiser
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.network_corrections import NetworkCorrections
from ngo_estimator.slam.odometry_blocks import OdometryBlocks
from ngo_estimator.slam.place_matcher import PlaceMatcher
from ngo_estimator.slam.step_log import StepLog

_VARIANCES = (1e-12, 1e4)
"""What lies below or above is exact or unknown, and float32 has no room for it."""

_SHRUNK = 1e-5
"""By less (m or rad) are poses those of the solution: a hundredth of what corrections are good to."""

_LEAST_INFORMATION = 1e-12
"""Of a loop, 1/m^2 or 1/rad^2: with less it might as well not be there."""

_FRESH = 2
"""Blocks since the last optimisation up to which poses say what frames share."""


class PlaceBackEnd(BackEnd):
    """Takes frames, keeps nodes, and optimises those of the window together with the key frames before it.

    The network runs for each ``network_every``-th block; between, what it gave is taken again. For each
    ``anneal_every``-th block all loops are judged from the odometry on; between, only new ones.
    """

    _finder: PlaceLoopFinder | None

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
        super().__init__(PoseGraph())
        self._keys = KeyFrames(key_frames)
        self._optimizer, self._pair_head = optimizer, pair_head
        self._block, self._window = optimizer.block, window
        self._scale = optimizer.config.covariance_scale
        self._log = log  # of the steps as they came
        self._odometry = OdometryBlocks(optimizer, pair_head, window, log, self.graph, self._keys)
        self._finder = None
        self._origin_code = np.zeros(0, np.float32)  # none
        if optimizer.config.loops:
            assert pair_head is not None
            search = optimizer.config.search
            self._finder = PlaceLoopFinder(pair_head, search, self._block, window, self.graph, self._keys, self._scale)
        self._network_every, self._anneal_every = network_every, anneal_every
        self._shrunk = False  # whether corrections of the last result were shrunk
        self._annealed = 0  # blocks when all loops were judged last
        self._corrections = NetworkCorrections.none()

    @property
    def window_fill(self) -> float:
        """Share of the window that is in use."""
        return min(1.0, self._odometry.steps / (self._window * self._block))

    def checked(self, step: RelativeStep) -> RelativeStep:
        """See ``BackEnd.checked``."""
        codes = None if self._pair_head is None else self._pair_head.config.code_length
        check_step(step, self._optimizer.config.aggregation.motion_feature_size, codes)
        return step

    def begin_at(self, step: RelativeStep) -> None:
        """Take the place code of the first frame, where it is known."""
        if self._pair_head is not None and step.from_place_code is not None:
            self._origin_code = step.from_place_code

    def append(self, step: RelativeStep, joins: bool = False) -> None:
        """Take a step with its motion feature and place code.

        An unfamiliar frame closes no loops, and networks leave the odometry around it as it is. Its variances are
        honest, so that ``covariance_scale`` is not for them. The first one recalls those before it.
        """
        variance, code = np.clip(np.diagonal(step.covariance), *_VARIANCES), step.place_code
        familiar = step.unlikeness <= UNFAMILIAR
        if not familiar:
            code, variance = np.zeros_like(code), variance / self._scale
            if self._odometry.is_familiar:
                self._recall()
        relative = step.relative_xyyaw
        self.graph.append(relative.astype(np.float64), np.diag(variance.astype(np.float64)), joins)
        self._odometry.append(relative, variance, step.motion_feature, familiar)
        if self._finder is not None:
            self._finder.append(code)

    @property
    def _has_new_node(self) -> bool:
        return self._odometry.steps >= (self._odometry.blocks + 1) * self._block

    @property
    def _blocks_before(self) -> np.ndarray:
        """How many blocks lie before each node ``(nodes,)``."""
        blocks: np.ndarray = self.graph.frames.nodes // self._block
        return blocks

    @property
    def _first(self) -> int:
        """Number of the first block of the window."""
        return int(self.graph.frames.nodes[len(self._keys)]) // self._block

    @torch.inference_mode()
    def _take_in(self) -> bool:
        self._guarded("the registration of steps", self._register)
        self._odometry.complete()
        self._guarded("taking in a meta-pose", self._odometry.aggregate)
        self._guarded("the search for loops", self._look_for_loops)
        self._make_room()
        return True

    def _register(self) -> None:
        """Measure the newest block again."""
        if self._finder is None or self._odometry.registrations == 0:
            return
        first = self._odometry.blocks * self._block
        before = self._origin_code if first == 0 else self._finder.codes(first - 1)[0]
        self._odometry.register(self._finder.codes(first), before if len(before) else None)

    @torch.inference_mode()
    def _recall(self) -> None:
        """Take the newest frames back, which were taken for familiar: their loops, and what was registered by them."""
        first = self._odometry.recall()
        if self._finder is not None:
            self._finder.recall(first)

    def _look_for_loops(self) -> None:
        """Look for loops of the newest node."""
        if self._finder is not None:
            self._finder.find(self.graph.unmoved <= _FRESH)

    def _make_room(self) -> None:
        """Let the window slide, and some key frames go."""
        while len(self.graph) - 1 - len(self._keys) > self._window:
            self._keys.add(self._key_frame())
            if self._finder is not None:
                self._finder.leave()
        if self._keys.crowded:
            keep, keys = np.ones(len(self.graph), bool), len(self._keys)
            keep[:keys] = self._keys.thin(self.graph.poses[:keys], self.graph.relative[:keys])
            if self._finder is not None:
                self._finder.thin(keep, keys)
            self.graph.let_go(keep)

    def _key_frame(self) -> KeyFrame:
        """The key frame that the window's first node becomes; the step from it is as the last optimisation had it."""
        first = len(self._keys)
        believed = self._odometry.optimized_std.slice(self._first, self._first + 1)
        self.graph.restate(first, all_between(*self.graph.poses[first : first + 2, None]), believed**2)
        if self._finder is not None:
            return self._finder.key_frame()
        nothing = np.zeros((self._block, 0), np.float32)
        return KeyFrame(nothing, nothing, np.zeros((self._block, 3)))

    @torch.inference_mode()
    def _optimise(self) -> None:
        """Optimise all nodes of the window and the key frames before it."""
        loops, rows, result = PlaceLoops.none(), np.zeros(0, np.int64), None
        if self._finder is not None:
            rows = self._finder.chosen()
            loops = self._finder.loops[rows]
        runs_network = self._optimizer.config.network and self._network_is_due
        if self._finder is None or self._annealing_is_due:
            result = self._anneal(loops)
            solution = Solution.of(result)
        else:
            solution = self._resume(self._finder, loops)
        solution = solution._replace(end=self._scale * solution.end)
        require_sound(solution.poses, solution.end)
        self._apply(solution, loops, rows)
        if result is not None:
            self._annealed = self._odometry.blocks
            if runs_network and self._network_every > 1:
                self._corrections = NetworkCorrections.of(self._first, result.corrections)

    def _anneal(self, loops: PlaceLoops) -> OptimizedMetaPoses:
        """Optimise from the odometry on, with these loops; the network runs if it is due."""
        steps, given, corrections, first = self._meta_steps(), None, None, self._first
        if not self._network_is_due:
            corrections = self._corrections.for_blocks(first, self._odometry.blocks)
        elif self._optimizer.config.network:
            steps = replace(steps, features=torch.from_numpy(self._odometry.features.slice(first)).unsqueeze(0))
        if self._finder is not None:
            given = self._finder.for_optimizer(loops, self._verified(loops))
        *_, result = self._optimizer.iterate(steps, given, corrections)
        return result

    def _resume(self, finder: PlaceLoopFinder, loops: PlaceLoops) -> Solution:
        """Go on from the last solution, with these loops, of which only new ones are judged."""
        valid = self._verified(loops)
        if self._optimizer.config.search.least_belief:  # others must agree with a new one: all are looked at
            judged = self._optimizer.judged(finder.for_optimizer(loops, valid), self._meta_steps())
            valid, logit, log_scale = (of[0].numpy() for of in (judged.valid, judged.logit, judged.log_scale))
            loops = replace(loops, logit=logit, log_scale=log_scale)
        adjustment, stiffness = self._corrections.summed(self._first, self._odometry.blocks)
        if (fixed := self._odometry.fixed.slice(self._first)).any():
            adjustment[fixed] = stiffness[fixed] = 0.0
        new = np.flatnonzero(loops.information[:, 0] < 0.0)
        new_loops = finder.for_optimizer(loops[new], valid[new]).of_single()
        given, odometry = (adjustment, stiffness), (self.graph.relative, self._step_std)
        return self._optimizer.resume(*odometry, given, loops, new_loops, self.graph.poses)

    @property
    def _step_std(self) -> np.ndarray:
        """Deviations ``(nodes - 1, 3)`` of the steps between nodes."""
        std: np.ndarray = np.sqrt(np.diagonal(self.graph.step_covariance, axis1=1, axis2=2))
        return std

    def _meta_steps(self) -> MetaSteps:
        """All steps between nodes as the networks take them, without features."""
        values = self.graph.relative, self._step_std
        relative, std = (torch.from_numpy(of.astype(np.float32)).unsqueeze(0) for of in values)
        fixed = self._odometry.fixed.slice(self._first)
        stays = torch.from_numpy(fixed.copy()).unsqueeze(0) if fixed.any() else None
        return MetaSteps(relative, std, None, len(fixed), fixed=stays)

    def _verified(self, loops: PlaceLoops) -> np.ndarray:
        """Which loops ``(n,)`` may count; none across a blind stretch where place codes alone show them.

        Nothing limits the motion within it, so that each place that looks alike would do.
        """
        search = self._optimizer.config.search
        if search.registrations or search.least_belief or not self._odometry.blind.any():
            return np.ones(len(loops), bool)
        blind = (summed_variances(self._odometry.blind, self._blocks_before) > 0.0).any(axis=1)
        before = np.concatenate(([0], blind.cumsum()))
        verified: np.ndarray = before[loops.end] == before[loops.start]
        return verified

    @property
    def _network_is_due(self) -> bool:
        """Whether what the network gave is too old."""
        known = self._corrections
        return not known.last or is_due(
            self._odometry.blocks - known.last, known.last - known.first, self._network_every
        )

    @property
    def _annealing_is_due(self) -> bool:
        """Whether all loops are to be judged anew, from the odometry on."""
        first = self._first
        # Across blind stretches the poses are not those of the solution, even where the window has left them behind.
        if self._shrunk or self._odometry.blind[first:].any() or self._network_is_due:
            return True
        return is_due(self._odometry.blocks - self._annealed, self._annealed - first, self._anneal_every)

    def _apply(self, solution: Solution, loops: PlaceLoops, rows: np.ndarray) -> None:
        """Take the solution with the loops of these ``rows``; its last node has more variance, by how far it is off."""
        if self._finder is not None:
            std = 1.0 / np.sqrt(np.maximum(solution.information, _LEAST_INFORMATION))
            self.closed = ClosedLoops(*self._finder.edges(loops), std, solution.weights)
            self._finder.weigh(rows, solution.weights, solution.information)
        poses = self._shrink(solution.poses)
        moved = poses[-1] - solution.poses[-1]
        self.graph.move(poses, solution.end + np.outer(moved, moved))
        self._odometry.optimized_std.replace(self._first, solution.step_std[len(self._keys) :])

    def _shrink(self, solution: np.ndarray) -> np.ndarray:
        """Poses of all nodes ``(nodes, 3)``, whose corrections are shrunk across blind stretches."""
        self._shrunk = False
        blind = self._odometry.blind
        if not blind.any():
            return solution
        log = self._log().odometry.values
        odometry = se2.between(log[0], log[self.graph.frames.nodes])
        loops = PlaceLoops.none() if self._finder is None else self._finder.loops
        variances = summed_variances(blind, self._blocks_before)
        shrunk = shrunk_corrections(solution, odometry, variances, loops.pairs, loops.weight)
        self._shrunk = bool(np.abs(shrunk - solution).max() > _SHRUNK)
        return shrunk

    def _forget_solution(self) -> None:
        self._annealed, self._corrections = 0, NetworkCorrections.none()

    def localiser(self, origin: MapOrigin) -> Localiser:
        """Localises by the frames whose place codes are kept; raises ``ValueError`` where none are."""
        if self._finder is None or self._pair_head is None:
            raise ValueError("the optimizer closes no loops, and keeps no place codes; expected one with loops")
        places = self._finder.places(origin.poses(self.graph.frame_poses()))
        return Localiser(PlaceMatcher(self._pair_head, places, self._optimizer.config.search))

    SAVED = (
        "graph", "_keys", "_odometry", "_finder", "_annealed", "_shrunk", "_corrections", "_origin_code",
        "closed",
    )  # fmt: skip

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        frames, blocks, joined = self._odometry.steps, self._odometry.blocks, self.closed.pairs
        window = self.graph.frames.nodes[len(self._keys) :]
        require(
            len(window) > 0 and np.array_equal(window, self._block * np.arange(blocks + 1)[-len(window) :]),
            f"{frames} steps, {blocks} meta-poses and {len(self._keys)} key frames do not belong together",
        )
        require(bool(((joined >= 0) & (joined <= frames)).all()), "loops join frames that are not there")
        given = self._corrections
        shape = self._optimizer.config.iterations if given.last else 0, given.last - given.first
        require(
            0 <= given.first <= given.last <= blocks
            and given.adjustment.shape[:2] == given.stiffness.shape[:2] == shape,
            f"corrections of the blocks {given.first} to {given.last} are given",
        )
        require(0 <= self._annealed <= blocks, f"loops were judged at meta-pose {self._annealed} of {blocks}")


def is_due(since: int, seen: int, every: int) -> bool:
    """Whether to repeat work that saw ``seen`` blocks, ``since`` blocks ago, and is due for each ``every``-th block.

    A short trajectory changes a lot with each block.
    """
    return since >= min(every, 1 + seen // 8)
