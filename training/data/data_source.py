"""The sensor, the robot and the scale of the training data, from a simulated world or from recordings."""

from dataclasses import dataclass

from ngo_estimator.data.images import ImageFormat
from ngo_estimator.geometry.scan_registration import RegistrationConfig
from ngo_estimator.loops.loop_closure import LoopSearch

TRAIN_STORE = "train"  # The feature store that smoother and optimizer learn from.

OTHER_TRAIN_STORE = "train_policy"
"""The one that the optimizer learns from as well, in worlds with an ``optimizer_driver``."""

MIRRORED_STORE = "train_mirrored"
"""The trajectories of ``TRAIN_STORE`` as a mirror shows them, where that was asked for."""

MIRRORED_ACTIONS = (0, 2, 1)
"""Mirror image of each action of ngo_msgs/DiscreteAction: forward stays, left and right change places."""


@dataclass(frozen=True, kw_only=True)
class Domain:
    """The sensor, the robot and the scale of its surroundings, and the defaults of an optimizer for them."""

    name: str  # Name of the world or the robot, and of its folders.
    image: ImageFormat  # Format of the frames.
    period_s: float  # Time between two frames.
    block_m: float  # Length by which errors of positions are measured: the width of a corridor.
    place_radius_m: float  # Largest distance between two frames of one place.
    heading_limit_rad: float  # Largest turn between two frames of one place.
    loop_views: int  # Pairs of frames between which a loop is measured.
    registration: RegistrationConfig | None = None
    """Registration of frames; None where ranges are unknown or not good enough."""
    reverses: bool = False  # Whether the robot may drive backwards.
    actions: int = 3  # Number of discrete actions; 0: networks see images alone.
    mirrored_actions: tuple[int, ...] = MIRRORED_ACTIONS  # Mirror image of each action.
    action_history: int = 1  # Number of latest actions that the local network takes.
    twist: bool = False  # Whether networks take the velocity of each step.
    twist_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)  # Velocity by which networks divide it (m/s, m/s, rad/s).
    mirrors: bool = True  # Whether the mirror image of a frame could be a frame.
    loops_per_pose: int = LoopSearch.per_pose  # Loop candidates of a meta-pose.
    max_loops: int = LoopSearch.most  # Loop candidates of a trajectory.
    loops_apart: int = LoopSearch.min_apart
    """Two candidates of one meta-pose are more than this number of meta-poses apart."""
    overlaps: int = 0  # Further loops that are searched under the poses, where ranges are registered.
    smoothing: bool = False  # Whether the odometry is smoothed.
    optimizer_epochs: int = 6  # Epochs of an optimizer's training.
    loss_scale: float = 0.1  # Errors below this count by their square: in corridor widths, and in fifths of a radian.
    error_windows: tuple[int, ...] = (1,)
    """Lengths of the windows of steps over which losses sum errors: errors that last make the sum drift."""
    deviation_steps: int = 1  # Number of steps over whose sums the deviations of the local network are fitted.

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
