"""The state of a trajectory that is corrected online: a log of steps, and a back end, whose graph owns all poses."""

import copy
from abc import ABC, abstractmethod
from typing import Any, TypeVar

import numpy as np

from ngo_estimator.data.relative_step import RejectedStep, RelativeStep
from ngo_estimator.data.row_buffers import GrowingRows
from ngo_estimator.data.state_arrays import Arrays, StateError, attributes_of, require, with_attributes
from ngo_estimator.geometry.planar_motion import between, compose
from ngo_estimator.graph.relative_poses import BELIEVED
from ngo_estimator.slam.back_end import BackEnd
from ngo_estimator.slam.bridge import bridged
from ngo_estimator.slam.loop_report import LoopReport, loop_report
from ngo_estimator.slam.map_localisation import MapLocalisation
from ngo_estimator.slam.map_origin import MapOrigin
from ngo_estimator.slam.step_log import StepLog
from ngo_estimator.slam.trajectory_update import Trajectory, TrajectoryUpdate
from ngo_estimator.trajectory.g2o import PlanarGraph, graph_of_frames

AnyTrajectory = TypeVar("AnyTrajectory", bound="CorrectedTrajectory")


class CorrectedTrajectory(ABC):
    """Takes steps into a log and a back end, and reports what each changed.

    A step is answered by the odometry behind the last corrected pose. ``correct`` does the work that it makes due: the
    search for loops, and an optimisation. A live node calls it when it has published the answer, in the time until the
    next step. Where nobody calls it, the next step begins with it. So results do not depend on who calls.

    Args:
        answers_first: False: the work is done before the step is answered.
    """

    SAVED = ("_log", "_back_end", "_online", "_optimized", "_odom")
    _back_end: BackEnd

    def __init__(self, answers_first: bool) -> None:
        self._answers_first = answers_first
        self._log = StepLog()
        self.reset()

    @abstractmethod
    def _new_back_end(self) -> BackEnd:
        """A back end without any frame."""

    @property
    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """What must be the same where a ``state()`` is restored: networks and settings, as JSON has them."""

    def localisation(self, origin: MapOrigin) -> MapLocalisation:
        """Localisation in this trajectory as it is, which lies in ``map`` as ``origin`` says; raises ``ValueError``."""
        return MapLocalisation(self._back_end.localiser(origin), self._back_end.checked)

    def state(self) -> Arrays:
        """Copies of all that later steps depend on, for ``restored``; raises ``StateError`` before the first step.

        Work that is due is done before.
        """
        require(self._log.steps > 0, "the trajectory is empty")
        self._work()
        return attributes_of(self)

    def restored(self: AnyTrajectory, arrays: Arrays) -> AnyTrajectory:
        """Another trajectory with these networks and settings, in a ``state()``; this one stays as it is.

        It goes on as the one that was saved would have, to the last bit.

        Raises:
            StateError: the arrays do not fit these settings, or each other.
        """
        other = copy.copy(self)
        other._log = StepLog()
        other._begin()
        try:
            other._restore(arrays)
        except StateError:
            raise
        except Exception as error:  # of arrays that no ``state()`` gave
            raise StateError(f"the arrays do not belong together ({type(error).__name__}: {error})") from error
        return other

    def _restore(self, arrays: Arrays) -> None:
        with_attributes(self, arrays)
        self._loaded = True
        whole = self.trajectory()
        require(whole is not None, "the trajectory is empty")
        assert whole is not None
        lengths = {len(whole.stamps_ns), len(whole.poses_xyyaw), len(whole.online_xyyaw)}
        require(len(lengths) == 1, f"there are {sorted(lengths)} poses of the same frames")
        newest = self.newest()
        require(
            all(bool(np.isfinite(of).all()) for of in (whole.poses_xyyaw, newest.pose_xyyaw, newest.covariance)),
            "poses are not finite",
        )

    def newest(self) -> TrajectoryUpdate:
        """What the newest step gave, as it is now; raises ``RuntimeError`` before the first step."""
        if self._log.steps == 0:
            raise RuntimeError("the trajectory is empty; expected a step before")
        return self._result(restarted=False, gap=False)

    def reset(self) -> None:
        """Forget everything: the next step begins a new trajectory."""
        self._log.reset()
        self._begin()

    def _begin(self) -> None:
        self._loaded = False  # and no step taken since
        self._online = GrowingRows((3,), np.float64)
        self._back_end = self._new_back_end()
        self._due, self._optimize = False, True  # whether the back end has work, and may optimise
        self._optimized, self._fault = False, ""  # since the last result
        self._odom = np.zeros(3)  # of the newest frame, on TF

    @property
    def fault(self) -> str:
        """What failed in the last step, in ``correct`` or in ``finish``, in words; empty where nothing did."""
        return self._fault

    def update(self, step: RelativeStep, optimize: bool = True) -> TrajectoryUpdate:
        """Take the next step; see ``StepLog`` for gaps (``take``) and new beginnings (``is_restart``).

        Without ``optimize`` the newest frame follows the one before it by odometry alone. The next optimisation takes
        all of them in.

        Raises:
            RejectedStep: values that are not finite, too large or of the wrong shape, a stamp that came already, or one
                that is a little late; after loading, the first step of another odometry. The trajectory is as it was
                before.
        """
        step = self._back_end.checked(step)
        self._begin_result()
        restarted = self._log.is_restart(step)
        if restarted and self._loaded:  # it would replace all that was loaded
            raise RejectedStep(
                f"step to {step.stamp_ns} ns is of an odometry that began at {step.origin_stamp_ns} ns, or older than "
                "the loaded trajectory; expected the odometry of that one to go on, or a reset"
            )
        if restarted:
            self.reset()
        taken = self._log.take(step)
        return self._follow(taken, optimize, restarted=restarted, gap=taken is not step)

    def join(self, step: RelativeStep, pose_xyyaw: np.ndarray, covariance: np.ndarray) -> TrajectoryUpdate:
        """Go on with another odometry, from the frame that ``step`` ends at.

        Nobody knows the motion since the newest frame. A step to the pose that was found stands for it, and loops
        refine it later.

        Args:
            pose_xyyaw: ``(3,)`` of the frame as this trajectory has it, before it is laid into ``map``; covariance:
                ``(3, 3)`` of it.

        Raises:
            RejectedStep: as of ``update``; the stamp is not later than the newest one, or ``may_join`` is false.
        """
        step = self._back_end.checked(step)
        self._work()  # it may move the newest pose
        return self._join_at(step, *bridged(*self._back_end.newest(), pose_xyyaw, covariance))

    def _join_at(
        self, step: RelativeStep, relative: np.ndarray, covariance: np.ndarray, optimize: bool = True
    ) -> TrajectoryUpdate:
        """Go on with another odometry; its first frame is ``relative`` ``(3,)`` to the newest one."""
        if not self.may_join(step):
            raise RejectedStep(f"step to {step.stamp_ns} ns has no key scan; expected one where an odometry begins")
        self._begin_result()
        return self._follow(self._log.join(step, relative, covariance), optimize, joins=True)

    def begins_anew(self, step: RelativeStep) -> bool:
        """Whether a step is of another odometry, so that ``update`` would forget this trajectory.

        Raises ``RejectedStep`` for a step that ``update`` would refuse, whatever came before it.
        """
        return self._log.is_restart(self._back_end.checked(step))

    def may_join(self, step: RelativeStep) -> bool:
        """Whether the trajectory can go on with another odometry from this step's frame."""
        return self._log.steps > 0 and self._back_end.may_join(step)

    def check_later(self, step: RelativeStep) -> None:
        """Raise ``RejectedStep`` if a step of another odometry is not later than the newest frame."""
        self._log.check_later(step)

    def _follow(
        self, step: RelativeStep, optimize: bool, *, restarted: bool = False, gap: bool = False, joins: bool = False
    ) -> TrajectoryUpdate:
        """Let the newest frame follow by a step that the log has taken."""
        self._loaded = False
        if self._log.steps == 1:
            self._back_end.begin_at(step)
            self._online.append(np.zeros(3))
        self._back_end.append(step, joins)
        self._odom = step.tf_odom_xyyaw
        self._due, self._optimize = True, optimize
        if not self._answers_first:
            self._work()
        update = self._result(restarted, gap)
        self._online.append(update.pose_xyyaw)
        return update

    def _begin_result(self) -> None:
        """Forget what the last result reported, and do the work that is left of it."""
        self._optimized, self._fault = False, ""
        self._work()

    def _work(self) -> None:
        """Do the work that is due."""
        if self._due:
            self._due = False
            self._optimized |= self._back_end.work(self._optimize)
            self._fault = self._back_end.fault or self._fault

    def correct(self) -> TrajectoryUpdate | None:
        """Do the work that the newest step made due; None where it changed nothing."""
        self._begin_result()
        return self._result(restarted=False, gap=False) if self._optimized or self._fault else None

    @property
    def unfinished(self) -> bool:
        """Whether there is anything left to optimise, which later steps, or ``finish``, are to do."""
        return self._due or self._back_end.unfinished

    @property
    def optimization_s(self) -> float:
        """Computing time of the last optimisation, and of the search for loops before it."""
        return self._back_end.took_s

    def finish(self) -> TrajectoryUpdate | None:
        """Optimise what is left, when no more steps come; None where there is nothing, or where it failed."""
        self._begin_result()
        if self._log.steps > 0 and self._back_end.finish():
            self._optimized = True
        self._fault = self._back_end.fault or self._fault
        return self._result(restarted=False, gap=False) if self._optimized else None

    def remove_loops(self, first: int, second: int, stretch: bool = False) -> int:
        """Take the loop between two frames out for good, or all that end in a stretch; returns how many there were.

        All poses are optimised without them; ``newest`` tells what that gave.

        Args:
            first, second: the frames; with ``stretch`` the first and the last one of the stretch.

        Raises:
            ValueError: a stretch is to end in another drive.
        """
        low, high = min(first, second), max(first, second)
        if stretch and self.ranks[low] != self.ranks[high]:
            raise ValueError("the stretch begins in one drive and ends in another; expected a single one")

        def which(frames: np.ndarray) -> np.ndarray:
            within = ((frames >= low) & (frames <= high)).any(axis=1)
            exact = (np.sort(frames, axis=1) == (low, high)).all(axis=1)
            return np.asarray(within if stretch else exact)

        self._begin_result()
        removed = self._back_end.remove_loops(which)
        self._optimized |= removed > 0 and not self._back_end.fault
        self._fault = self._back_end.fault or self._fault
        return removed

    @property
    def ranks(self) -> np.ndarray:
        """The rank of each frame's drive ``(frames,)``, by which it is named."""
        return self._back_end.graph.rank_of_frames

    def planar_graph(self) -> PlanarGraph | None:
        """The graph as it is now, with the belief in its loops, or None before the first step."""
        trajectory = self.trajectory()
        return None if trajectory is None else graph_of_frames(trajectory)

    def loop_report(self) -> LoopReport:
        """What the last optimisation thinks of the loops."""
        back_end, closed = self._back_end, self._back_end.closed
        seen = closed.pairs, closed.relative, closed.weight, back_end.waiting_loops
        return loop_report(*seen, self._log.stamps_ns.values, back_end.graph.frame_poses(), back_end.scales)

    def trajectory(self) -> Trajectory | None:
        """The whole trajectory as it is now, or None before the first step."""
        if self._log.steps == 0:
            return None
        graph, log, closed = self._back_end.graph, self._log, self._back_end.closed
        poses, moved = graph.frame_poses(), np.zeros(log.steps + 1)
        if self._optimized:
            before = graph.frame_poses(before=True)
            moved[:-1] = np.linalg.norm((poses - before)[:-1, :2], axis=1)
        arrays = (
            log.stamps_ns.values, poses, log.odometry.values, self._online.values, moved, log.odometry_std.values,
            closed.pairs, closed.weight, closed.relative, closed.std,
        )  # fmt: skip
        return Trajectory(*map(_read_only, arrays))

    def _result(self, restarted: bool, gap: bool) -> TrajectoryUpdate:
        back_end = self._back_end
        pose, covariance = back_end.newest()
        map_from_odom = compose(pose, between(self._odom, np.zeros(3)))
        lost = back_end.lost_since
        return TrajectoryUpdate(
            stamp_ns=int(self._log.stamps_ns.values[-1]),
            pose_xyyaw=_read_only(pose.copy()),
            covariance=_read_only(0.5 * (covariance + covariance.T)),
            map_from_odom_xyyaw=_read_only(map_from_odom),
            frames=self._log.steps + 1,
            optimized=self._optimized,
            restarted=restarted,
            gap=gap,
            largest_move_m=back_end.graph.largest_move_m if self._optimized else 0.0,
            closed_loops=int((back_end.closed.weight > BELIEVED).sum()),
            window_fill=back_end.window_fill,
            fault=self._fault,
            lost_since_ns=None if lost is None else int(self._log.stamps_ns.values[lost]),
        )


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view
