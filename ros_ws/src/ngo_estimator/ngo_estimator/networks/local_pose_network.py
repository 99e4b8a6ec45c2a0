"""The Local Pose Estimation network (paper, section "Local Pose Estimation Network")."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

from ngo_estimator.data.configuration import check, check_positive
from ngo_estimator.data.images import ImageFormat, to_network
from ngo_estimator.networks.flownet import FlowNetConvolutions
from ngo_estimator.networks.odometry_smoothing import OdometrySmoother, SmootherConfig

NO_ACTION = -1  # In place of an action that was not taken, or that nobody knows.


@dataclass(frozen=True)
class LocalPoseConfig:
    """What a local pose network is made of.

    ``relative_mean`` and ``relative_std`` (m, m, rad) normalise the output: the network works on poses of mean 0 and
    deviation 1, and gives SI units. ``relative_bias`` (m, m, rad) is added to what it gives, in a symmetric network
    too, where means to the sides cancel: a robot may turn a little more one way than its mirror image would. ``width``
    scales the channels of FlowNetS; ``actions`` is the number of discrete actions, 0 for none, and ``action_history``
    how many of the latest ones the network takes: in how a robot with momentum moves, what it did before goes on.
    More than one of them pass through ``fusion_size`` hidden units. With ``twist`` the network takes the mean
    velocity between the frames, which it divides by ``twist_scale`` (m/s, m/s, rad/s). ``period_s`` is the time between
    frames in training. With ``symmetric`` the estimate is the mean of that of the frames and that of their mirror
    images, in which action ``k`` becomes ``mirrored_actions[k]``. ``deviation_scale`` multiplies the standard
    deviations that the heads give. With ``memory``, a causal smoother, steps are corrected by those before them.
    """

    image: ImageFormat
    width: float
    actions: int
    period_s: float
    feature_size: int = 64
    hidden_size: int = 256
    relative_mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    relative_std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    symmetric: bool = False
    mirrored_actions: tuple[int, ...] = ()
    deviation_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    relative_bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    twist: bool = False
    twist_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    action_history: int = 1
    fusion_size: int = 128
    memory: SmootherConfig | None = None

    def __post_init__(self) -> None:
        check(self, "width", "over 0 and at most 2 (1 is FlowNetS)", lambda x: 0.0 < x <= 2.0)
        check(self, "actions", "at least 0", lambda x: x >= 0)
        check(self, "feature_size hidden_size action_history fusion_size", "at least 1", lambda x: x >= 1)
        check_positive(self, "period_s relative_std deviation_scale twist_scale")
        if self.symmetric and sorted(self.mirrored_actions) != list(range(self.actions)):
            raise ValueError(
                f"mirrored_actions is {self.mirrored_actions}; expected each of the {self.actions} actions once"
            )
        memory = self.memory
        if memory is not None and not (memory.causal and memory.motion_feature_size == self.feature_size):
            raise ValueError(
                f"memory is {memory}; expected causal=True and motion_feature_size {self.feature_size}, as the "
                "network's features are"
            )


@dataclass(frozen=True)
class StepEstimates:
    """What a network makes of steps, ``fused``, and before its earlier actions are taken into account, ``visual``.

    Both are relative poses ``(batch, 3)`` (m, m, rad), and the logarithm of their standard deviations. The two are one
    where it takes none. ``feature`` ``(batch, feature_size)`` is the motion feature.
    """

    visual: tuple[Tensor, Tensor]
    fused: tuple[Tensor, Tensor]
    feature: Tensor


class LocalPoseNetwork(nn.Module):
    """Relative pose of a frame with respect to the one before, from the two and what is known of the step between.

    Two frames are stacked and passed through the convolutions of FlowNetS; one fully connected layer takes these and
    the action or the velocity; a translational and a rotational head read it. Beyond the paper each head also gives the
    logarithm of its standard deviation, and the input of the heads is the motion feature that the pose aggregation
    reads. A network that takes several of the latest actions corrects what the heads say: two layers see it, the
    feature and the actions. No gradient passes from there into the rest, which learns to see as if it knew nothing of
    earlier actions: taken at once, they explain so much that little is learned from the frames. A symmetric network
    estimates both the frames and their mirror image, in evaluation mode: errors to the left and to the right then
    cancel wherever the two differ.

    Beyond the paper, too: ``remembered`` corrects the steps of a drive by those before them. A robot has momentum, and
    two frames of a wall without marks tell nothing that the frames before them have not shown.
    """

    def __init__(self, config: LocalPoseConfig) -> None:
        super().__init__()
        self.config = config
        image = config.image
        self.convolutions = FlowNetConvolutions(2 * image.channels, (image.height, image.width), config.width)
        controls = config.actions + 3 * config.twist
        self.hidden = nn.Linear(self.convolutions.output_size + controls, config.hidden_size)
        self.feature = nn.Linear(config.hidden_size, config.feature_size)
        self.translation = nn.Linear(config.feature_size + controls, 4)
        self.rotation = nn.Linear(config.feature_size + controls, 2)
        if config.action_history > 1:
            known = 6 + config.feature_size + config.actions * config.action_history + 3 * config.twist
            self.fusion = nn.Sequential(
                nn.Linear(known, config.fusion_size),
                nn.ReLU(),
                nn.Linear(config.fusion_size, config.fusion_size),
                nn.ReLU(),
                nn.Linear(config.fusion_size, 6),
            )
            for parameter in self.fusion[-1].parameters():
                nn.init.zeros_(parameter)  # it begins with what is seen
        self.memory = None if config.memory is None else OdometrySmoother(config.memory)
        self.register_buffer("relative_mean", torch.tensor(config.relative_mean), persistent=False)
        self.register_buffer("relative_std", torch.tensor(config.relative_std), persistent=False)
        self.register_buffer("relative_bias", torch.tensor(config.relative_bias), persistent=False)
        self.register_buffer("log_deviation_scale", torch.tensor(config.deviation_scale).log(), persistent=False)
        self.register_buffer("mirrored_actions", torch.tensor((*config.mirrored_actions, NO_ACTION)), persistent=False)
        self.register_buffer("twist_scale", torch.tensor(config.twist_scale), persistent=False)
        self.relative_mean: Tensor
        self.relative_std: Tensor
        self.relative_bias: Tensor
        self.log_deviation_scale: Tensor
        self.mirrored_actions: Tensor
        self.twist_scale: Tensor

    def forward(
        self, earlier: Tensor, later: Tensor, actions: Tensor | None = None, twist: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Estimate relative poses.

        Args:
            earlier, later: observations ``(batch, height, width, channels)`` as the sensor gives them.
            actions: ``(batch, n)`` int64, the latest actions, last the one between the two; ``NO_ACTION`` where the
                robot stood or nobody knows. A network reads as many as its configuration says, the others are of no
                account. ``(batch,)`` where it reads one; None for a network without actions.
            twist: ``(batch, 3)`` mean velocity (m/s, m/s, rad/s) between the two, or None for a network without.

        Returns:
            Relative pose ``(batch, 3)`` of the later frame in the earlier one (m, m, rad), the logarithm of its
            standard deviations ``(batch, 3)``, and the motion feature ``(batch, feature_size)``.
        """
        actions = self._checked(actions, twist)
        if self.training or not self.config.symmetric:
            estimates = self._estimates(earlier, later, actions, twist)
            mean, log_std = estimates.fused
            return mean + self.relative_bias, log_std, estimates.feature
        both = [torch.cat((frames, frames.flip(-2))) for frames in (earlier, later)]
        actions = actions if actions is None else torch.cat((actions, self.mirrored_actions[actions]))
        flip = self.relative_std.new_tensor([1.0, -1.0, -1.0])
        twist = twist if twist is None else torch.cat((twist, twist * flip))
        estimates = self._estimates(both[0], both[1], actions, twist)
        means, log_stds, features = (values.chunk(2) for values in (*estimates.fused, estimates.feature))
        return 0.5 * (means[0] + means[1] * flip) + self.relative_bias, 0.5 * (log_stds[0] + log_stds[1]), features[0]

    def remembered(self, relative: Tensor, log_std: Tensor, features: Tensor) -> tuple[Tensor, Tensor]:
        """Steps of drives and the logarithms of their deviations, ``(..., steps, 3)``, corrected by those before them.

        Arguments are what ``forward`` gives for steps that follow each other: all from the first one on, or the latest
        ``memory.reach + 1``, of which the last one comes out as it would of all. Without a memory they come back.
        """
        if self.memory is None:
            return relative, log_std
        corrected: tuple[Tensor, Tensor] = self.memory(relative, log_std, features)
        return corrected

    def estimates(
        self, earlier: Tensor, later: Tensor, actions: Tensor | None = None, twist: Tensor | None = None
    ) -> StepEstimates:
        """What is estimated with and without the earlier actions, of the frames as they are and without the bias.

        Arguments as of ``forward``.
        """
        return self._estimates(earlier, later, self._checked(actions, twist), twist)

    def _checked(self, actions: Tensor | None, twist: Tensor | None) -> Tensor | None:
        """The actions that the network reads, where it is given what it wants."""
        if (actions is None) != (self.config.actions == 0):
            given = "no actions were given" if actions is None else "actions were given"
            raise ValueError(f"{given} to a network trained with {self.config.actions} actions")
        if actions is not None:
            actions = self._latest(actions)
        if (twist is None) == self.config.twist:
            raise ValueError(f"twist is {'not ' * (twist is None)}given to a network with twist={self.config.twist}")
        return actions

    def _latest(self, actions: Tensor) -> Tensor:
        """The actions ``(batch, action_history)`` that the network reads."""
        given = actions.unsqueeze(1) if actions.ndim == 1 else actions
        if given.ndim != 2 or given.shape[1] < self.config.action_history:
            raise ValueError(
                f"actions are of shape {tuple(actions.shape)}; expected the latest {self.config.action_history} of each"
            )
        return given[:, -self.config.action_history :]

    def _estimates(self, earlier: Tensor, later: Tensor, actions: Tensor | None, twist: Tensor | None) -> StepEstimates:
        frames = torch.cat([to_network(frame, self.config.image) for frame in (earlier, later)], dim=1)
        inputs = [self.convolutions(frames)]
        controls, history = [], []
        if actions is not None:
            # NO_ACTION becomes zeros.
            one_of_each = one_hot(actions - NO_ACTION, self.config.actions + 1)[..., 1:].to(frames.dtype)
            controls.append(one_of_each[:, -1])
            history.append(one_of_each.flatten(1))
        if twist is not None:
            controls.append(twist.to(frames.dtype) / self.twist_scale)
            history.append(controls[-1])
        hidden = torch.relu(self.hidden(torch.cat(inputs + controls, dim=1)))
        feature = torch.relu(self.feature(hidden)).float()
        heads_input = torch.cat([feature, *controls], dim=1)
        translation, rotation = self.translation(heads_input).float(), self.rotation(heads_input).float()
        mean = torch.cat((translation[:, :2], rotation[:, :1]), dim=1)
        log_std = torch.cat((translation[:, 2:], rotation[:, 1:]), dim=1)
        visual = fused = self._in_units(mean, log_std)
        if self.config.action_history > 1:
            seen = torch.cat((mean, log_std), dim=1).detach()
            correction = self.fusion(torch.cat([seen, feature.detach(), *history], dim=1)).float()
            corrected, corrected_log_std = (seen + correction).split(3, dim=1)
            fused = self._in_units(corrected, corrected_log_std)
        return StepEstimates(visual, fused, feature)

    def _in_units(self, mean: Tensor, log_std: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised relative poses and logarithms of their deviations ``(batch, 3)`` in SI units."""
        scale = self.relative_std.log() + self.log_deviation_scale
        return mean * self.relative_std + self.relative_mean, log_std.clamp(-7.0, 3.0) + scale
