"""The back end of a calibrated camera: a graph of key pictures, and loops that geometry verified."""

from dataclasses import replace

import numpy as np

from ngo_estimator.data.relative_step import RejectedStep, RelativeStep, check_step
from ngo_estimator.data.state_arrays import require
from ngo_estimator.geometry.key_picture import KeyPicture, nothing_seen
from ngo_estimator.geometry.planar_covariance import bounded
from ngo_estimator.graph.corrector import CorrectedGraph, Corrector, GraphProblem
from ngo_estimator.graph.pose_graph import PoseGraph
from ngo_estimator.graph.relative_poses import RelativePoses
from ngo_estimator.graph.robust import Robust
from ngo_estimator.loops.picture_loop_finder import PictureLoopFinder
from ngo_estimator.loops.picture_settings import PictureGraphConfig
from ngo_estimator.slam.back_end import BackEnd, ClosedLoops, require_sound
from ngo_estimator.slam.localisation import LocalisationConfig, Localiser
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.picture_matcher import PictureMatcher

_KEYS_PER_OPTIMISED = 20
"""For each so many nodes an optimisation waits for one more key picture."""


class PictureBackEnd(BackEnd):
    """Takes frames, keeps key pictures and their loops, and optimises all of them together."""

    _finder: PictureLoopFinder

    def __init__(self, config: PictureGraphConfig) -> None:
        super().__init__(PoseGraph())
        self.config = config
        self._finder = PictureLoopFinder(config.loops)
        self._corrector: Corrector = Robust(least_scale=1.0)
        self._is_key = False
        self._loops_from_nothing, self._scale = 0, np.ones(1)

    def checked(self, step: RelativeStep) -> RelativeStep:
        """See ``BackEnd.checked``; covariances are bounded."""
        check_step(step, 0, None)
        for code in (step.place_code, step.from_place_code):
            if code is not None and len(code):
                try:
                    KeyPicture.unpacked(code)
                except ValueError as error:
                    raise RejectedStep(str(error)) from None
        return replace(step, covariance=bounded(step.covariance))

    def begin_at(self, step: RelativeStep) -> None:
        """Take the first frame; where its picture is missing, no loop ends there."""
        code = step.from_place_code
        self._finder.append(nothing_seen() if code is None or not len(code) else KeyPicture.unpacked(code))

    def append(self, step: RelativeStep, joins: bool = False) -> None:
        """Take a step; where it ends at a key picture, that is a node."""
        self.graph.append(step.relative_xyyaw, bounded(step.covariance), joins)
        if len(step.place_code):
            self.graph.add_node(bounded(self.graph.since_covariance))
            self._finder.append(KeyPicture.unpacked(step.place_code))
            self._is_key = True

    def newest(self) -> tuple[np.ndarray, np.ndarray]:
        """See ``BackEnd.newest``. No picture tells by which share all ways are wrong together: the map grows by it."""
        pose, covariance = super().newest()
        grown = np.array((*(self.config.way_share * pose[:2]), 0.0))
        return pose, covariance + np.outer(grown, grown)

    def may_join(self, step: RelativeStep) -> bool:
        """Whether another odometry may go on from this step's frame, which needs a key picture."""
        return len(step.place_code) > 0

    @property
    def _has_new_node(self) -> bool:
        return self._is_key

    def _take_in(self) -> bool:
        self._is_key = False
        self._waiting += self._waiting > 0
        self._guarded("the search for loops", self._look_for_loops)
        return self._waiting > max(self.config.keys_between, len(self.graph) // _KEYS_PER_OPTIMISED)

    def _look_for_loops(self) -> None:
        if self._finder.find(self.graph, self.closed.weight):
            self._waiting = max(self._waiting, 1)

    def _optimise(self) -> None:
        self._waiting = 0
        steps, loops = self.measurements()
        problem = GraphProblem(self.graph.poses, steps, loops, np.ones(len(loops)))
        solution = self._corrector.correct(problem, self._warm_start(problem))
        end = solution.covariance([len(self.graph) - 1]) if len(self.graph) > 1 else self.graph.end
        require_sound(solution.poses, end)
        self._loops_from_nothing, self._scale = solution.loops_from_nothing, np.array((solution.scale,))
        self.scales = solution.step_scale, solution.loop_scale
        self.graph.move(solution.poses, end)
        found, weights = self._finder.loops, solution.loop_weights
        variance = np.diagonal(found.covariance, axis1=1, axis2=2) / np.maximum(weights, 1e-12)[:, None]
        self.closed = ClosedLoops(self.graph.frames.nodes[found.pairs], found.relative, np.sqrt(variance), weights)

    def _warm_start(self, problem: GraphProblem) -> CorrectedGraph | None:
        """The last solution, whose nodes the newer ones follow; None where there is none."""
        if len(self.closed) == 0:
            return None
        sound, scale = np.ones(len(problem.steps)), float(self._scale[0])
        before = self._loops_from_nothing
        return CorrectedGraph(problem, problem.poses, self.closed.weight, sound, 0.0, scale, loops_from_nothing=before)

    def measurements(self) -> tuple[RelativePoses, RelativePoses]:
        """The steps from each node to the next, and all loops."""
        loops = self._finder.loops
        return self.graph.steps, RelativePoses.of_covariances(loops.pairs, loops.relative, loops.covariance)

    def belief(self) -> np.ndarray:
        """Of the last optimisation in each of ``measurements``' loops ``(n,)``; NaN in those that came since."""
        return np.concatenate((self.closed.weight, np.full(self.waiting_loops, np.nan)))

    def _forget_solution(self) -> None:
        self.closed, self._loops_from_nothing = ClosedLoops.none(), 0

    @property
    def waiting_loops(self) -> int:
        """Loops that wait for an optimisation."""
        return len(self._finder.loops) - len(self.closed)

    def finish(self) -> bool:
        """Optimise with all loops; returns whether there were any, and it worked."""
        self.fault = ""
        return len(self._finder.loops) > 0 and self._guarded("an optimisation", self._optimise)

    def localiser(self, origin: MapOrigin) -> Localiser:
        """Localises in the key pictures as they are; raises ``ValueError`` where they are too few.

        No share of the looks must support a pose: where no key picture looked the same way, a look tells nothing.
        """
        matcher = PictureMatcher(self._finder, self.graph, origin.poses(self.graph.poses.copy()))
        return Localiser(matcher, LocalisationConfig(least_share=0.0))

    SAVED = ("graph", "_finder", "_waiting", "closed", "_loops_from_nothing", "_scale")

    def check_state(self) -> None:
        """Raise ``StateError`` about restored arrays that do not belong together."""
        require(len(self._finder) == len(self.graph), f"there are not {len(self.graph)} key pictures")
        require(
            len(self.closed) <= len(self._finder.loops) and self._loops_from_nothing >= 0 and self._scale[0] > 0.0,
            "an optimisation is of loops that are not there",
        )
        require(self._waiting >= 0, f"an optimisation waits for {self._waiting} key pictures")
