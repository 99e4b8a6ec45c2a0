"""Local odometry: frames in, relative poses out (no ROS here)."""

from collections import deque
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from ngo_estimator.checkpoint import PlaceNetworks, load_familiarity, load_local, load_place
from ngo_estimator.data.images import ImageFormat
from ngo_estimator.data.relative_step import RESTART_AFTER_NS, RelativeStep
from ngo_estimator.data.weights_file import CheckpointError
from ngo_estimator.geometry import se2
from ngo_estimator.networks.familiarity import Familiarity
from ngo_estimator.networks.local_pose_network import NO_ACTION, LocalPoseNetwork
from ngo_estimator.odometry.familiarity_watch import FamiliarityWatch
from ngo_estimator.odometry.rejected_frames import DuplicateFrame, LateFrame, UnusableImage


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
    def image_shape(self) -> tuple[int, int, int]:
        """``(height, width, channels)`` of the frames that the networks were trained on."""
        return self._network.config.image.shape

    @property
    def image_dtype(self) -> str:
        """``uint8`` or ``float32``."""
        return self._network.config.image.dtype

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
        self._last_stamp_ns: int | None = None
        self._origin_stamp_ns = 0
        self._last_image = torch.empty(0)
        self._origin_code: np.ndarray | None = None
        self._odom = torch.zeros(3, dtype=torch.float64)
        self._actions = [NO_ACTION] * self._network.config.action_history
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
            image: ``image_shape`` of ``image_dtype``.
            action: the action between the last frame and this one; ignored for the first frame.
            twist: ``(3,)`` mean velocity (m/s, m/s, rad/s) between the two, where the networks take it; likewise.

        Returns:
            The motion since the last frame, or None for the first one, and after the source restarted (a stamp that
            lies ``RESTART_AFTER_NS`` or more in the past).

        Raises:
            RejectedFrame: a frame that cannot be used; the state is as before.
        """
        try:
            self._network.config.image.check(image)
        except ValueError as error:
            raise UnusableImage(str(error)) from error
        frame = torch.from_numpy(np.array(image)).unsqueeze(0)
        last = self._last_stamp_ns
        if last is None or stamp_ns <= last - RESTART_AFTER_NS:
            if last is not None:
                self.reset()
                self.restarts += 1
            self._origin_stamp_ns = stamp_ns
            self._last_stamp_ns, self._last_image = stamp_ns, frame
            with torch.inference_mode():
                self._origin_code = self._encoder(frame)[0].numpy()
            return None
        if stamp_ns == last:
            raise DuplicateFrame(f"frame at {stamp_ns} ns came twice")
        if stamp_ns < last:
            raise LateFrame(f"frame at {stamp_ns} ns is {(last - stamp_ns) / 1e9:.3f} s older than the last one")
        missed = max(0, round((stamp_ns - last) * 1e-9 / self.period_s) - 1)
        actions = None
        if self.uses_action:
            if action is None or not 0 <= action < self._network.config.actions:
                raise UnusableImage(f"action is {action}; expected 0 to {self._network.config.actions - 1}")
            # Of frames that were missed nobody says what the robot did, and what it did before them is longer ago.
            before = [NO_ACTION] * (len(self._actions) - 1) if missed else self._actions[1:]
            actions = torch.tensor([[*before, action]])
        twists = None
        if self.uses_twist:
            if twist is None or np.shape(twist) != (3,) or not np.isfinite(twist).all():
                raise UnusableImage(f"twist is {twist}; expected three finite numbers (m/s, m/s, rad/s)")
            twists = torch.tensor(np.asarray(twist)[None], dtype=torch.float32)
        with torch.inference_mode():
            relative, log_std, feature = self._network(self._last_image, frame, actions, twists)
            early = self._encoder.early(frame)
            code = self._encoder.code_of(frame, early)
            if missed:
                self._steps.clear()
            else:
                self._steps.append((relative, log_std, feature))
                drive = (torch.cat(part) for part in zip(*self._steps, strict=True))
                relative, log_std = (values[-1:] for values in self._network.remembered(*drive))
        variance, unlikeness, repeated = torch.exp(2.0 * log_std[0].double()), 0.0, False
        if self._watch is not None:
            if missed:
                self._watch.forget_actions()
            step = relative, variance.unsqueeze(0), feature
            judged = self._watch.judge((self._last_image, frame), early, (action, twist), step)
            unlikeness, repeated = judged.unlikeness, judged.repeated
            relative, variance = torch.from_numpy(judged.relative).unsqueeze(0), torch.from_numpy(judged.variance)
        # A pair further apart than in training: the network's own belief holds no longer, so a typical step for every
        # missing frame is added to it.
        variance = variance + (missed * self._network.relative_std.double()) ** 2
        self._odom = se2.compose(self._odom, relative[0].double())
        self._actions = [] if actions is None else actions[0].tolist()
        self._last_stamp_ns, self._last_image = stamp_ns, frame
        origin_code, self._origin_code = self._origin_code, None
        return LocalEstimate(
            stamp_ns=stamp_ns,
            from_stamp_ns=last,
            relative_xyyaw=relative[0].double().numpy(),
            covariance=torch.diag(variance).numpy(),
            origin_stamp_ns=self._origin_stamp_ns,
            odom_xyyaw=self._odom.numpy().copy(),
            motion_feature=feature[0].numpy(),
            place_code=code[0].numpy(),
            from_place_code=origin_code,
            missed_frames=missed,
            unlikeness=unlikeness,
            repeated=repeated,
        )
