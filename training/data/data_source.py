"""The sensor, the robot and the scale of the training data, from a simulated world or from recordings."""

from dataclasses import dataclass

from ngo_estimator.data.images import ImageFormat
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.optimizer.loop_closure import LoopSearch

TRAIN_STORE = "train"
"""The feature store that smoother and optimizer learn from."""

OTHER_TRAIN_STORE = "train_policy"
"""The one that the optimizer learns from as well, in worlds with an ``optimizer_driver``."""

MIRRORED_ACTIONS = (0, 2, 1)
"""What the actions of ngo_msgs/DiscreteAction become in a mirror: forward stays, left and right change places."""


@dataclass(frozen=True, kw_only=True)
class Domain:
    """The sensor, the robot and the scale of its surroundings.

    ``actions`` is the number of discrete actions (0: networks see images alone), ``mirrored_actions`` what each of them
    becomes in a mirror, ``action_history`` how many of the latest ones the local network is told, ``block_m`` the
    length that errors of positions are measured by (a corridor's width).
    ``place_radius_m`` and ``heading_limit_rad`` say how far two frames of one place may be apart and turned against
    each other, ``loop_views`` between how many pairs of frames a loop is measured, and ``registration`` how frames are
    registered, where ranges are known that are good enough for it. ``reverses`` says that the robot may
    drive backwards. With ``twist`` the networks are told the velocity of each step, which they divide by
    ``twist_scale`` (m/s, m/s, rad/s). ``mirrors`` says that a frame seen in a mirror is a frame that could be.

    What an optimizer here begins with: ``loops_per_pose`` candidates of a meta-pose are more than ``loops_apart``
    meta-poses from each other and ``max_loops`` of a trajectory, ``overlaps`` more are looked for under its poses,
    where ranges are registered, and ``smoothing`` says whether its odometry is smoothed. It is trained for
    ``optimizer_epochs``, and errors count by their square below ``loss_scale``: so many corridor widths, and as many
    fifths of a radian.
    """

    name: str
    image: ImageFormat
    period_s: float
    block_m: float
    place_radius_m: float
    heading_limit_rad: float
    loop_views: int
    registration: RegistrationConfig | None = None
    reverses: bool = False
    actions: int = 3
    mirrored_actions: tuple[int, ...] = MIRRORED_ACTIONS
    action_history: int = 1
    twist: bool = False
    twist_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    mirrors: bool = True
    loops_per_pose: int = LoopSearch.per_pose
    max_loops: int = LoopSearch.most
    loops_apart: int = LoopSearch.min_apart
    overlaps: int = 0
    smoothing: bool = False
    optimizer_epochs: int = 6
    loss_scale: float = 0.1

    @property
    def registers_odometry(self) -> bool:
        """Whether steps of the odometry are measured again by their ranges, and not loops alone."""
        return self.registration is not None and self.registration.odometry

    @property
    def sees_ranges(self) -> bool:
        """Whether the place encoder learns to see the ranges of its pictures, which do not hold them."""
        return self.registration is not None and self.image.height > 1

    @property
    def loss_scale_m(self) -> float:
        """Errors of position below are counted by their square."""
        return self.loss_scale * self.block_m

    @property
    def loss_scale_rad(self) -> float:
        """Errors of heading below are counted by their square."""
        return 0.2 * self.loss_scale

    @property
    def optimizer_stores(self) -> tuple[str, ...]:
        """Names of the feature stores that the optimizer learns from."""
        return (TRAIN_STORE,)

    @property
    def validation_stores(self) -> tuple[str, ...]:
        """Names of the feature stores that smoother and optimizer are measured on while they train."""
        return ("validation",)
