"""Local odometry: frames in, relative poses out (no ROS here)."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ngo_estimator.checkpoint import PlaceNetworks, load_familiarity, load_local, load_place
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.relative_step import RESTART_AFTER_NS, RelativeStep
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.frontend.camera.familiarity_watch import FamiliarityWatch
from ngo_estimator.frontend.camera.frame_pairing import PairedFrame
from ngo_estimator.frontend.rejected_frames import DuplicateFrame, LateFrame, RejectedFrame, UnusableImage
from ngo_estimator.geometry import se2
from ngo_estimator.networks.familiarity import Familiarity
from ngo_estimator.networks.local_pose_network import NO_ACTION, LocalPoseNetwork

AT_ONCE = 8
"""Frames for which the networks run at once where so many are there."""


@dataclass(frozen=True)
class LocalEstimate(RelativeStep):
    """Motion between two consecutive frames; ``missed_frames`` counts the frames missing between the two.

    ``repeated``: the newer frame repeats the older one, while actions or wheels tell motion.
    """

    missed_frames: int
    repeated: bool = False


class LocalOdometry:
    """Turns consecutive frames into relative poses, motion features and place codes."""

    def __init__(
        self, network: LocalPoseNetwork, place: PlaceNetworks, world: str, familiarity: Familiarity | None = None
    ) -> None:
        self._network, self._encoder = network.eval(), place.encoder.eval()
        for module in (self._network, self._encoder):
            # As the images lie, so that no convolution has to turn its weights round each time.
            module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._watch = None if familiarity is None else FamiliarityWatch(familiarity, self._encoder)
        self.world = world
        self.restarts = 0
        self.reset()

    @classmethod
    def load(cls, weights: Path, world: str | None = None) -> "LocalOdometry":
        """Load the networks in the folder ``weights``; raises ``CheckpointError``, of one clear line."""
        network, description = load_local(weights, world)
        place, place_description = load_place(weights, description["world"])
        if place.config.image != network.config.image:
            raise CheckpointError(
                f"{weights}: the place encoder takes images {place.config.image.shape}, the local pose network "
                f"{network.config.image.shape}; expected the same"
            )
        return cls(network, place, place_description["world"], load_familiarity(weights, description["world"]))

    @property
    def tells_unlike_input(self) -> bool:
        """Whether the weights say what input they know; without, ``unlikeness`` is 0 and deviations do not grow."""
        return self._watch is not None

    @property
    def image_format(self) -> ImageFormat:
        """What the networks take: frames must be of this format."""
        return self._network.config.image

    @property
    def uses_action(self) -> bool:
        """Whether each frame after the first needs the action that led to it."""
        return self._network.config.actions > 0

    @property
    def uses_twist(self) -> bool:
        """Whether each frame after the first needs the mean velocity that led to it."""
        return self._network.config.twist

    @property
    def period_s(self) -> float:
        """Time between frames in training."""
        return self._network.config.period_s

    def reset(self) -> None:
        """Forget all frames: the next one is the new origin of ``odom``."""
        self._last: _Taken | None = None
        self._origin_stamp_ns = 0
        self._origin_code: np.ndarray | None = None
        self._odom = torch.zeros(3, dtype=torch.float64)
        memory = self._network.config.memory
        self._steps: deque[tuple[torch.Tensor, ...]] = deque(maxlen=1 if memory is None else memory.reach + 1)
        if self._watch is not None:
            self._watch.reset()

    def update(
        self, stamp_ns: int, image: np.ndarray, action: int | None, twist: np.ndarray | None = None
    ) -> LocalEstimate | None:
        """Take the next frame.

        Args:
            stamp_ns: time of the frame.
            image: of ``image_format``.
            action: the action between the last frame and this one; ignored for the first frame.
            twist: ``(3,)`` mean velocity (m/s, m/s, rad/s) between the two, where the networks take it; likewise.

        Returns:
            The motion since the last frame, or None for the first one, and after the source restarted (a stamp that
            lies ``RESTART_AFTER_NS`` or more in the past).

        Raises:
            RejectedFrame: a frame that cannot be used; the state is as before.
        """
        (result,) = self.update_all([PairedFrame(stamp_ns, image, action, twist)])
        if isinstance(result, RejectedFrame):
            raise result
        return result

    def update_all(self, frames: Sequence[PairedFrame]) -> list[LocalEstimate | RejectedFrame | None]:
        """Take the next frames, in order, and run the networks once for all of them.

        Up to ``AT_ONCE`` make each of them cheaper. The results are those of one frame after the other but for the
        rounding of single precision.

        Returns:
            For each frame what ``update`` returns or raises.

        Raises:
            Exception: whatever a network raised; none of the frames was taken then.
        """
        restore = self._restorer()
        try:
            return self._update_all(frames)
        except Exception:
            restore()
            raise

    def _restorer(self) -> Callable[[], None]:
        """Puts the state back to what it is now."""
        kept = self._last, self._origin_stamp_ns, self._origin_code, self._odom, self._steps.copy(), self.restarts
        restore_watch = None if self._watch is None else self._watch.restorer()

        def restore() -> None:
            (
                self._last, self._origin_stamp_ns, self._origin_code, self._odom, self._steps, self.restarts
            ) = kept  # fmt: skip
            if restore_watch is not None:
                restore_watch()

        return restore

    def _update_all(self, frames: Sequence[PairedFrame]) -> list[LocalEstimate | RejectedFrame | None]:
        results: list[LocalEstimate | RejectedFrame | None] = []
        left = deque(frames)
        while left:
            found: list[_Taken | RejectedFrame] = []
            last, begins = self._last, False
            while left and not begins:
                try:
                    taken = self._taken(last, left[0])
                except RejectedFrame as error:
                    found.append(error)
                else:
                    if begins := taken is None:
                        break
                    found.append(taken)
                    last = taken
                left.popleft()
            estimates = self._estimates([each for each in found if isinstance(each, _Taken)])
            results += [next(estimates) if isinstance(each, _Taken) else each for each in found]
            if begins:
                self._begin(left.popleft())
                results.append(None)
        return results

    def _taken(self, last: "_Taken | None", frame: PairedFrame) -> "_Taken | None":
        """The frame that follows the last one, or None where an odometry begins; raises ``RejectedFrame``."""
        try:
            self._network.config.image.check(frame.image)
        except ValueError as error:
            raise UnusableImage(str(error)) from error
        stamp_ns, action, twist = frame.stamp_ns, frame.action, frame.twist
        if last is None or stamp_ns <= last.stamp_ns - RESTART_AFTER_NS:
            return None
        if stamp_ns == last.stamp_ns:
            raise DuplicateFrame(f"frame at {stamp_ns} ns came twice")
        if stamp_ns < last.stamp_ns:
            late_s = (last.stamp_ns - stamp_ns) / 1e9
            raise LateFrame(f"frame at {stamp_ns} ns is {late_s:.3f} s older than the last one")
        missed = max(0, round((stamp_ns - last.stamp_ns) * 1e-9 / self.period_s) - 1)
        actions: list[int] = []
        if self.uses_action:
            if action is None or not 0 <= action < self._network.config.actions:
                raise UnusableImage(f"action is {action}; expected 0 to {self._network.config.actions - 1}")
            # Of frames that were missed nobody says what the robot did, and what it did before them is longer ago.
            before = [NO_ACTION] * (len(last.actions) - 1) if missed else last.actions[1:]
            actions = [*before, action]
        if self.uses_twist and (twist is None or np.shape(twist) != (3,) or not np.isfinite(twist).all()):
            raise UnusableImage(f"twist is {twist}; expected three finite numbers (m/s, m/s, rad/s)")
        return _Taken(stamp_ns, _tensor(frame.image), actions, action, twist, missed)

    def _begin(self, frame: PairedFrame) -> None:
        """Let this frame be the origin of ``odom``."""
        if self._last is not None:
            self.reset()
            self.restarts += 1
        image = _tensor(frame.image)
        with torch.inference_mode():
            self._origin_code = self._encoder(image)[0].numpy()
        self._origin_stamp_ns = frame.stamp_ns
        self._last = _Taken(frame.stamp_ns, image, [NO_ACTION] * self._network.config.action_history)

    def _estimates(self, steps: "list[_Taken]") -> Iterator[LocalEstimate]:
        """Run the networks over the steps to frames that follow the last one; the state is that behind each step."""
        if not steps or self._last is None:
            return
        from_frames = [self._last, *steps[:-1]]
        earlier, later = (torch.cat([frame.image for frame in frames]) for frames in (from_frames, steps))
        actions = torch.tensor([step.actions for step in steps]) if self.uses_action else None
        twists = (
            torch.tensor(np.array([step.twist for step in steps]), dtype=torch.float32) if self.uses_twist else None
        )
        with torch.inference_mode():
            relative, log_std, features = self._network(earlier, later, actions, twists)
            early = self._encoder.early(later)
            codes = self._encoder.code_of(later, early).numpy()
            if self._network.memory is not None:
                relative, log_std = self._remembered(steps, relative, log_std, features)
        variance, unlike = torch.exp(2.0 * log_std.double()), [(0.0, False)] * len(steps)
        if self._watch is not None:
            taken, gaps = [step.action for step in steps], [step.missed > 0 for step in steps]
            motions = relative, variance, features
            judged = self._watch.judge((earlier, later), early, taken, twists, gaps, motions)
            unlike = [(each.unlikeness, each.repeated) for each in judged]
            relative = torch.from_numpy(np.array([each.relative for each in judged]))
            variance = torch.from_numpy(np.array([each.variance for each in judged]))
        # A pair further apart than in training: the network's own belief holds no longer, so a typical step for every
        # missing frame is added to it.
        missed = torch.tensor([[step.missed] for step in steps])
        variance, relative = variance + (missed * self._network.relative_std.double()) ** 2, relative.double()
        for k, step in enumerate(steps):
            self._odom = se2.compose(self._odom, relative[k])
            self._last = step
            origin_code, self._origin_code = self._origin_code, None
            yield LocalEstimate(
                stamp_ns=step.stamp_ns,
                from_stamp_ns=from_frames[k].stamp_ns,
                relative_xyyaw=relative[k].numpy().copy(),
                covariance=torch.diag(variance[k]).numpy(),
                origin_stamp_ns=self._origin_stamp_ns,
                odom_xyyaw=self._odom.numpy().copy(),
                motion_feature=features[k].numpy().copy(),
                place_code=codes[k].copy(),
                from_place_code=origin_code,
                missed_frames=step.missed,
                unlikeness=unlike[k][0],
                repeated=unlike[k][1],
            )

    def _remembered(
        self, steps: "list[_Taken]", relative: torch.Tensor, log_std: torch.Tensor, features: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Steps ``(n, 3)`` and the logarithms of their deviations, corrected by those before them, up to a gap."""
        corrected = []
        for k, step in enumerate(steps):
            own = relative[k : k + 1], log_std[k : k + 1]
            if step.missed:
                self._steps.clear()
            else:
                self._steps.append((*own, features[k : k + 1]))
                drive = (torch.cat(part) for part in zip(*self._steps, strict=True))
                mean, deviation = self._network.remembered(*drive)
                own = mean[-1:], deviation[-1:]
            corrected.append(own)
        means, deviations = (torch.cat(part) for part in zip(*corrected, strict=True))
        return means, deviations


@dataclass(frozen=True)
class _Taken:
    """A frame ``(1, height, width, channels)`` of the odometry, the latest actions up to it, and what led to it.

    ``missed`` counts the frames missing before it.
    """

    stamp_ns: int
    image: torch.Tensor
    actions: list[int]
    action: int | None = None
    twist: np.ndarray | None = None
    missed: int = 0


def _tensor(image: np.ndarray) -> torch.Tensor:
    """A copy of an image ``(1, height, width, channels)``: callers may use theirs again."""
    return torch.from_numpy(np.array(image)).unsqueeze(0)
